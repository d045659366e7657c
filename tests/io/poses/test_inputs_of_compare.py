"""What `gvo compare` is given: files, and chains and topics of bags."""

from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.poses.inputs import read_compared
from gvo.io.poses.inputs import read_ground_truth as read_poses
from gvo.trajectory.evaluation import Evaluation, evaluate
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory
from tests.make import bags as camera_bags
from tests.make.bags import ODOMETRY, STAMPED, PoseBag

T_BASE_CAM = se3.exp(np.array([0.4, -0.8, 1.0, 0.3, 0.1, 0.5]))
RUN_NAMES = ("raw", "causal", "smoothed", "global", "odom")
MOTION = se3.exp(np.outer(np.arange(8), [0.1, 0.0, -0.2, 1.0, 0.5, 0.1]))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    bag = PoseBag(tmp_path / "a.bag")
    bag.tf(0, "base", "cam", T_BASE_CAM, is_static=True)
    for n, T in enumerate(MOTION):
        bag.tf(n * 10**8, "map", "base", T)
        bag.pose("/odom", ODOMETRY, n * 10**8, T, child="base")
        bag.pose("/slam", ODOMETRY, n * 10**8, T @ T_BASE_CAM, child="cam")
        bag.pose("/gt", STAMPED, n * 10**8, T)
        bag.fix(n * 10**8, [48.0, 11.0, float(n)], frame="gps")
    return bag.write()


@pytest.fixture
def run_bag(tmp_path: Path) -> Path:
    """Return what a run with `--frame base` writes: frames of its own for each estimate."""
    bag = PoseBag(tmp_path / "run.bag")
    for name in RUN_NAMES:
        bag.tf(0, f"gvo/{name}/base", f"gvo/{name}/cam", T_BASE_CAM, is_static=True)
        for n, T in enumerate(MOTION):
            child = f"gvo/{name}/base"
            bag.pose(f"/gvo/{name}/odometry", ODOMETRY, n * 10**8, T, child=child)
    return bag.write()


def measures(found: Evaluation) -> list[float]:
    values = [found.ate_m, found.ate_max_m, found.rpe_m, found.rpe_deg]
    return [np.inf if value is None else value for value in values]


def test_a_chain_has_no_error_against_itself_nor_against_its_topic(bag: Path) -> None:
    chain = read_poses(f"{bag}#tf:map:base")
    for text in (f"{bag}#tf:map:base", f"{bag}#/odom", f"{bag}#odom", f"{bag}#topic:/odom"):
        found = evaluate(chain, read_poses(text), name="same")
        assert found.n == 8
        assert measures(found) == pytest.approx([0.0] * 4, abs=1e-5)


def test_python_evaluates_trajectories_files_and_what_is_in_bags(bag: Path, tmp_path: Path) -> None:
    chain = read_poses(f"{bag}#tf:map:base")
    chain.write(tmp_path / "chain.txt")
    for reference, estimate, name in (
        (chain, tmp_path / "chain.txt", "chain"),
        (str(tmp_path / "chain.txt"), chain, "estimate"),
        # brought to the frame of the reference, as by `gvo compare`
        (f"{bag}#/odom", f"{bag}#tf:map:cam", "tf:map:cam"),
    ):
        found = gvo.evaluate(reference, estimate)
        assert (found.name, found.n) == (name, 8)
        assert measures(found) == pytest.approx([0.0] * 4, abs=1e-5)
    assert gvo.evaluate(chain, chain, name="mine").name == "mine"


def test_poses_are_brought_to_the_frame_of_the_reference(bag: Path) -> None:
    texts = [f"{bag}#tf:map:cam", f"{bag}#/slam"]
    reference, estimates, warnings = read_compared(f"{bag}#/odom", texts)
    assert (len(estimates), warnings) == (2, [])
    for text, brought in zip(texts, estimates.values(), strict=True):
        assert measures(evaluate(reference, read_poses(text), name="apart"))[2] > 0.05
        found = evaluate(reference, brought, name="brought")
        assert measures(found) == pytest.approx([0.0] * 4, abs=1e-5)


@pytest.mark.parametrize("name", RUN_NAMES)
def test_estimates_of_a_run_are_brought_by_the_frames_of_their_own(
    run_bag: Path, bag: Path, name: str
) -> None:
    for reference, wanted in (("/odom", MOTION), ("/slam", MOTION @ T_BASE_CAM)):
        topic = f"/gvo/{name}/odometry"
        _, estimates, warnings = read_compared(f"{bag}#{reference}", [f"{run_bag}#{topic}"])
        assert warnings == []
        np.testing.assert_allclose(estimates[topic].T_world_frame, wanted, atol=1e-9)


@pytest.fixture(params=["folder", "bag"])
def of_camera(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Return a recording whose truth is that of its camera, and which names no frame of it."""
    stamps_ns, T_world_cam = np.arange(8) * 10**8, MOTION @ T_BASE_CAM
    if request.param == "folder":
        path = tmp_path / "tum" / "groundtruth.txt"
        path.parent.mkdir()
        write_tum(path, Trajectory(stamps_ns=stamps_ns, T_world_frame=T_world_cam))
        return path.parent
    bag = PoseBag(tmp_path / "truth.bag")
    for stamp_ns, T in zip(stamps_ns.tolist(), T_world_cam, strict=True):
        bag.tf(stamp_ns, "world", "ground_truth", T)
    return bag.write()


def test_a_run_of_the_base_is_brought_to_the_camera_of_the_truth(
    of_camera: Path, run_bag: Path
) -> None:
    names = [f"{run_bag}#/gvo/{name}/odometry" for name in RUN_NAMES]
    truth, estimates, warnings = read_compared(str(of_camera), names)
    assert (len(estimates), warnings) == (5, [])
    for estimate in estimates.values():
        np.testing.assert_allclose(estimate.T_world_frame, truth.T_world_frame, atol=1e-8)


def test_what_is_not_of_the_camera_of_the_truth_is_compared_with_a_warning(
    of_camera: Path, bag: Path
) -> None:
    texts = [f"{bag}#/odom", f"{bag}#/slam", f"{bag}#/fix"]
    _, estimates, warnings = read_compared(str(of_camera), texts)
    assert warnings == [
        "/odom is of base, the reference of camera_optical: tf does not connect the two",
        "/slam is of cam, the reference of camera_optical: tf does not connect the two",
        "/fix is of gps, the reference of camera_optical: positions without rotations cannot be "
        "moved",
    ]
    np.testing.assert_allclose(estimates["/odom"].T_world_frame, MOTION, atol=1e-9)


def test_a_bag_by_itself_gives_the_truth_that_it_names(bag: Path) -> None:
    _, estimates, _ = read_compared(str(bag), [str(bag)])
    np.testing.assert_allclose(estimates["a"].T_world_frame, MOTION, atol=1e-12)


def test_a_bag_that_names_no_truth_lists_what_can_be_asked_for(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "b.bag")
    bag.pose("/odom", ODOMETRY, 0, np.eye(4))
    path = bag.write()
    with pytest.raises(RecordingError, match=r"name the poses: \S*b.bag#/odom$"):
        read_poses(str(path))
    bag = PoseBag(tmp_path / "c.bag")
    bag.tf(0, "map", "odom", np.eye(4))
    with pytest.raises(RecordingError, match=r"name the poses: \S*c.bag#tf:PARENT:CHILD$"):
        read_poses(str(bag.write()))
    path = camera_bags.write(tmp_path / "d.bag", [camera_bags.camera_info("/info")])
    with pytest.raises(RecordingError, match=r"d.bag: holds no poses: neither tf nor"):
        read_poses(str(path))
