"""Bags as people have them, on the command line: split, cut, with tf and truth; bags of runs."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.geometry import se3
from gvo.geometry.se3 import make_transform
from gvo.trajectory.formats import read_trajectory
from gvo.types import FloatArray
from tests.conftest import Command, assert_same_files, refused
from tests.make.bags import ODOMETRY
from tests.make.rendered_walk import (
    CAMERA,
    N_FRAMES,
    STAMPS_NS,
    T_BASE_CAM,
    TRAJECTORIES,
    Walk,
    ate_by_hand,
    copy_messages,
    moved_by_hand,
    on_a_robot,
    read_bag,
    true_poses,
    truth_stamps,
)


def poses(folder: Path, name: str) -> FloatArray:
    return read_trajectory(folder / f"{name}.txt").T_world_frame


@pytest.fixture(scope="module")
def robot_bag(walk_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return one bag of everything: images, tf with map -> base_link, wheel odometry."""
    folder = tmp_path_factory.mktemp("robot")
    bag = on_a_robot(folder / "frames.mcap")
    stamps_ns = truth_stamps()
    T_map_base = robot_poses(stamps_ns)
    for stamp_ns, T in zip(stamps_ns.tolist(), T_map_base, strict=True):
        bag.tf(stamp_ns, "map", "base_link", T)
        bag.pose("/odom", ODOMETRY, stamp_ns, np.eye(4), child="base_link")
    return copy_messages([walk_bag, bag.write()], folder / "robot.mcap")


def robot_poses(stamps_ns: Any) -> FloatArray:
    T_map_world = se3.exp(np.array([0.1, 0.2, 2.0, 30.0, -20.0, 1.0]))
    return np.asarray(T_map_world @ true_poses(stamps_ns) @ np.linalg.inv(T_BASE_CAM))


def test_a_run_in_the_frame_of_the_robot_lies_on_its_truth(
    command: Command, robot_bag: Path, walk_run: Path, tmp_path: Path
) -> None:
    options = ["--frame", "base_link", "--ground-truth", "tf:map:base_link"]
    answer = command(
        "run", "--no-report", robot_bag, "--out", tmp_path, *options, "--initial-pose", "truth"
    )
    assert (answer.code, answer.err) == (0, "")
    assert "frame: base_link" in answer.out
    assert "ground truth: tf map -> base_link" in answer.out
    exact = robot_poses(STAMPS_NS)
    for entry in json.loads((tmp_path / "summary.json").read_text())["errors"]:
        found = poses(tmp_path, entry["name"])
        # the same motion as that of the camera's run, from the true pose
        wanted = moved_by_hand(poses(walk_run, entry["name"]), T_BASE_CAM, found[0])
        np.testing.assert_allclose(found, wanted, atol=1e-8)
        np.testing.assert_allclose(found[0], exact[0], atol=1e-4)
        by_hand = ate_by_hand(found[:, :3, 3], exact[:, :3, 3])
        assert entry["ate_m"] == pytest.approx(by_hand, abs=5e-5)
    estimates = [tmp_path / "raw.txt", "--align", "none", "--json"]
    compared = command("compare", f"{robot_bag}#tf:map:base_link", *estimates)
    assert json.loads(compared.out)["estimates"][0]["ate_m"] < 0.02


def test_the_initial_pose_moves_all_poses(
    command: Command, walk_bag: Path, walk_run: Path, tmp_path: Path
) -> None:
    quaternion_xyzw = [0.1, -0.2, 0.3, 0.9273618495495704]
    numbers = ",".join(map(str, [4.0, -5.0, 6.0, *quaternion_xyzw]))
    answer = command("run", "--no-report", walk_bag, "--out", tmp_path, "--initial-pose", numbers)
    assert answer.code == 0, answer.err
    R = np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix())
    T_initial = make_transform(R, np.array([4.0, -5.0, 6.0]))
    for name in TRAJECTORIES:
        expected = T_initial @ poses(walk_run, name)
        np.testing.assert_allclose(poses(tmp_path, name), expected, atol=1e-8)
        covariances = f"{name}_covariance.csv"
        mine, theirs = (
            np.loadtxt(folder / covariances, delimiter=",", skiprows=1)
            for folder in (tmp_path, walk_run)
        )
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--start", "nan"], ["--start", "nan"]),
        (["--start", "60"], ["no frame at 60 s", "1.5 s long"]),
        (["--duration", "0"], ["--duration", "0"]),
        (["--every", "0"], ["--every", "0"]),
        (["--initial-pose", "1,2"], ["--initial-pose", "X,Y,Z"]),
        (["--initial-pose", "0,0,0,1,1,1,1"], ["--initial-pose", "length 2"]),
        (["--initial-pose", "truth"], ["--initial-pose truth", "no ground truth"]),
        (["--gravity-aligned"], ["--gravity-aligned", "robot", "no IMU is used"]),
        (["--frame", "gripper"], ["--frame gripper", CAMERA]),
        (["--ground-truth", "tf:map"], ["tf:map", "two frames"]),
        (["--ground-truth", "tf:map:gripper"], ["gripper", "map"]),
        (["--ground-truth", "/odometry"], ["/odometry", "/odom"]),
        (["--bag", "run.db3"], ["run.db3", ".mcap"]),
        (["--bag", "{robot}"], ["robot.mcap", "exists already"]),
        (["--calibration", "none.yaml"], ["none.yaml"]),
    ],
)
def test_nonsense_gets_one_line_and_exit_code_2(
    command: Command, robot_bag: Path, here: Path, options: list[str], words: list[str]
) -> None:
    Path("taken.mcap").write_text("mine")
    given = [option.format(robot=robot_bag) for option in options]
    said = refused(command("run", "--no-report", robot_bag, "--out", "out", *given))
    for word in words:
        assert word in said
    assert not list(Path().glob("out/*.png"))
    assert Path("taken.mcap").read_text() == "mine"


def in_halves(bag: Path, folder: Path) -> list[Path]:
    middle_ns = int(STAMPS_NS[N_FRAMES // 2])
    return [
        copy_messages([bag], folder / "b.mcap", lambda _, log_ns: log_ns >= middle_ns),
        copy_messages([bag], folder / "a.mcap", lambda _, log_ns: log_ns < middle_ns),
    ]


def by_camera(bag: Path, folder: Path) -> list[Path]:
    return [
        copy_messages([bag], folder / "left.mcap", lambda topic, _: "/left/" in topic),
        copy_messages([bag], folder / "right.mcap", lambda topic, _: "/right/" in topic),
    ]


@pytest.mark.parametrize("split", [in_halves, by_camera])
def test_split_bags_give_the_same_bytes_as_the_whole(
    command: Command, walk_bag: Path, walk_run: Path, tmp_path: Path, split: Callable[..., Any]
) -> None:
    parts = split(walk_bag, tmp_path)
    answer = command("run", "--no-report", *parts, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert_same_files(tmp_path / "out", walk_run)


@pytest.mark.parametrize("is_folder", [True, False])
def test_bags_of_two_recordings_are_refused_with_what_to_type(
    command: Command, walk_bag: Path, tmp_path: Path, *, is_folder: bool
) -> None:
    bags = [tmp_path / "first.mcap", tmp_path / "second.mcap"]
    for bag in bags:
        shutil.copy(walk_bag, bag)
    said = refused(command("check", *([tmp_path] if is_folder else bags)))
    assert "before first.mcap ends" in said
    assert f"{bags[0]}, {bags[1]}; give one of them" in said
    assert f"`gvo batch {tmp_path if is_folder else bags[0]}" in said


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_of_a_cut_bag_what_can_be_read_is_run(
    command: Command, walk_run: Path, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"cut{suffix}"
    gvo.convert(Walk(), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(0.7 * len(content))])
    answer = command(
        "run", "--no-report", path, "--out", tmp_path / "out", "--bag", tmp_path / "out.mcap"
    )
    assert answer.code == 3, answer.err
    assert all(line.startswith("gvo: warning: ") for line in answer.err.splitlines())
    assert f"cut{suffix}" in answer.err
    assert "%" in answer.err
    n = len(read_trajectory(tmp_path / "out/raw.txt"))
    assert N_FRAMES // 3 < n < N_FRAMES
    for name in ("raw", "causal"):
        np.testing.assert_array_equal(poses(tmp_path / "out", name), poses(walk_run, name)[:n])
    assert len(poses(tmp_path / "out", "smoothed")) == n
    assert len(read_bag(tmp_path / "out.mcap")["/gvo/raw/odometry"]) == n


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec * 10**9 + header.stamp.nanosec)
