"""A run folder holds what it promises, and the same run gives the same bytes."""

import json
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError, SmoothingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.poses.inputs import read_truth
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.graph import RunGraph
from gvo.runs.loop import Output, RunLoop
from gvo.runs.outputs.bag import RunBag
from gvo.testing import FaultySource
from gvo.trajectory.formats import write_kitti
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Optimum, Progress
from tests import faults as made
from tests.conftest import run_of
from tests.make.rendered_walk import (
    GLOBAL,
    STAMPS_NS,
    T_BASE_CAM,
    TRAJECTORIES,
    ate_by_hand,
    geodetic,
    on_a_robot,
    true_poses,
    truth_stamps,
)

UNREADABLE = made.Unloadable(message="the image is of zero size")


@pytest.fixture(scope="module")
def room() -> SyntheticRecording:
    return SyntheticRecording("handheld", "rgbd", n_frames=12, scale=0.3)


@pytest.fixture(scope="module")
def run_dir(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    result = run_of(drive_bag, out)
    assert result.is_complete
    assert result.warnings == ()
    return out


def test_summary_tells_frames_times_errors_and_configuration(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["frames"] == summary["tracked"] == 20
    assert summary["coverage_percent"] == 100.0
    assert summary["status_counts"]["ok"] == 20
    assert {"read", "extract", "register", "links", "window"} <= set(summary["median_ms"])
    assert [entry["name"] for entry in summary["errors"]] == [*TRAJECTORIES, GLOBAL]
    # no noisy recording is measured without an error
    assert all(1e-4 < entry["ate_m"] < 0.05 for entry in summary["errors"])
    assert summary["configuration"] == gvo.Config().model_dump()


def test_summary_tells_the_path_and_how_the_covariances_fit(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    truth = gvo.read_trajectory(run_dir / "ground_truth.txt")
    assert summary["path_m"] == pytest.approx(truth.distances()[-1], rel=0.01)
    assert summary["extent_m"] == pytest.approx(summary["path_m"], rel=0.1)
    assert 0.0 <= summary["truth_jump_m"] < 1e-3  # it is exact
    assert summary["reference"] == "too short to fit"
    assert summary["heading_deg"] < 5.0  # the camera looks along the road
    for name, n in (("window", 1), ("raw", 10)):
        assert summary["nees"][name]["5s"] == {}
        row = summary["nees"][name]["1s"]["bare"]
        assert row["n"] == n
        assert all(0.001 < row[key] < 5.0 for key in ("rotation", "translation"))
        assert 0.0 < row["along"] < 5.0
        assert 0.0 < row["error_m"] < 0.05


def test_another_number_of_threads_gives_the_same_bytes(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    for out, threads in ((tmp_path / "a", 1), (tmp_path / "b", 2)):
        config = gvo.load_configuration(settings=[f"runtime.threads={threads}"])
        run_of(room, out, config=config)
    names = {path.name for path in (tmp_path / "a").glob("*.[tcg][xs2][tvo]")} - {"timings.csv"}
    assert len(names) == 13
    for path in sorted(tmp_path / "a" / name for name in names):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_a_truth_of_another_time_is_a_warning(room: SyntheticRecording, tmp_path: Path) -> None:
    truth = room.ground_truth()
    late = Trajectory(stamps_ns=truth.stamps_ns + 10**12, T_world_frame=truth.T_world_frame)
    result = run_of(room, tmp_path, ground_truth=late)
    assert result.evaluations == ()
    assert "not compared" in result.warnings[0]


class TruthlessSource(FaultySource):
    """A source whose ground truth cannot be read."""

    def ground_truth(self) -> Trajectory | None:
        raise TrajectoryError("groundtruth.txt: line 3: expected 8 numbers, got 2")


def test_a_malformed_recorded_truth_is_a_warning(room: SyntheticRecording, tmp_path: Path) -> None:
    result = run_of(TruthlessSource(room), tmp_path)
    assert result.is_complete
    assert "line 3" in result.warnings[0]
    assert (tmp_path / "summary.json").exists()


def test_a_run_without_poses_leaves_nothing_also_not_of_an_earlier_one(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    (tmp_path / "summary.json").write_text("{}")
    (tmp_path / "trajectories.png").write_text("")
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(RecordingError, match=r"no usable frame.*zero size"):
        gvo.run_recording(FaultySource(room, UNREADABLE), tmp_path, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_poses_without_stamps_belong_to_the_frames_in_their_order(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    write_kitti(tmp_path / "poses.txt", room.ground_truth())
    expected = run_of(room, tmp_path / "a").evaluations
    poses = gvo.read_trajectory(tmp_path / "poses.txt")
    found = run_of(room, tmp_path / "b", ground_truth=poses).evaluations
    assert found[0].ate_m == pytest.approx(expected[0].ate_m, abs=1e-9)
    short = run_of(room, tmp_path / "c", ground_truth=poses.select(slice(0, 9)))
    assert not short.is_complete
    assert "not compared" in short.warnings[0]


def test_a_run_in_which_nothing_could_be_registered_says_so(tmp_path: Path) -> None:
    drive = SyntheticRecording("handheld", "stereo", n_frames=4, scale=0.4)
    result = run_of(FaultySource(drive, made.Black()), tmp_path)
    assert not result.is_complete
    assert "no frame could be registered" in result.warnings[0]
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 4


def _poses(folder: Path, name: str) -> np.ndarray:
    return gvo.read_trajectory(folder / f"{name}.txt").T_world_frame


def test_an_antenna_on_a_lever_arm_gives_the_errors_of_its_place(
    walk_bag: Path, walk_run: Path, tmp_path: Path
) -> None:
    bag, lever = on_a_robot(tmp_path / "fix.mcap"), np.array([-0.6, 0.2, 0.9])
    bag.tf(0, "base_link", "gps", se3.make_transform(np.eye(3), lever), is_static=True)
    p_cam = (np.linalg.inv(T_BASE_CAM) @ [*lever, 1.0])[:3]
    stamps_ns = truth_stamps(rate_hz=50)
    T_map_cam = T_BASE_CAM @ true_poses(stamps_ns)  # z up
    antenna = T_map_cam[:, :3, :3] @ p_cam + T_map_cam[:, :3, 3]
    for stamp_ns, place in zip(stamps_ns.tolist(), geodetic(antenna), strict=True):
        bag.fix(stamp_ns, place)
    source = gvo.open_recording([walk_bag, bag.write()])
    result = run_of(source, tmp_path / "out", ground_truth=read_truth(source, "/fix"))
    assert result.warnings == ()
    exact = true_poses(STAMPS_NS)
    points = exact[:, :3, :3] @ p_cam + exact[:, :3, 3]
    for name, evaluation in zip([*TRAJECTORIES, GLOBAL], result.evaluations, strict=True):
        poses = _poses(walk_run, name)
        found = poses[:, :3, :3] @ p_cam + poses[:, :3, 3]
        # interpolation over 20 ms leaves a tenth of a millimetre
        assert evaluation.ate_m == pytest.approx(ate_by_hand(found, points), abs=2e-4)
        assert evaluation.rpe_deg is None
        assert evaluation.ate_m < 4 * ate_by_hand(poses[:, :3, 3], exact[:, :3, 3]) < 0.02


def test_global_poses_that_fail_in_the_middle_are_no_fault_at_the_end(
    room: SyntheticRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saves: list[Callable[[], Future[int]]] = []

    def on_start(_: RunLoop, save: Callable[[], Future[int]]) -> list[Output]:
        saves.append(save)
        return []

    def fail(_: RunGraph) -> Optimum:
        raise SmoothingError("GTSAM: not now")

    def save_badly(progress: Progress) -> None:
        if progress.n_done == 6:
            with monkeypatch.context() as patch:
                patch.setattr(RunGraph, "optimize", fail)
                with pytest.raises(SmoothingError, match="not now"):
                    saves[0]().result()
            assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 6

    result = run_of(room, tmp_path, on_start=on_start, on_progress=save_badly)
    assert result.is_complete
    assert result.warnings == ()
    assert len(gvo.read_trajectory(tmp_path / "global.txt")) == 12


def test_a_report_that_cannot_be_drawn_is_told_in_the_summary_too(
    room: SyntheticRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("no space")

    monkeypatch.setattr("gvo.viz.plots.plot_trajectories", fail)
    result = run_of(room, tmp_path, outputs=gvo.RunOutputs())
    assert result.report is None
    assert result.warnings == ("not all was drawn: no space",)
    assert not result.is_complete
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["state"], summary["is_complete"]) == ("complete", False)
    assert summary["warnings"] == list(result.warnings)


def test_all_files_that_are_not_whole_are_named(
    room: SyntheticRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = RunBag.close

    def tear(bag: RunBag) -> None:
        close(bag)
        raise RecordingError("run.mcap: torn")

    monkeypatch.setattr(RunBag, "close", tear)
    monkeypatch.setattr("gvo.viz.video.count_pictures", lambda _: 0)
    bag, film = tmp_path / "run.mcap", tmp_path / "film.webm"
    outputs = gvo.RunOutputs(bag=bag, overlay=film, report=False)
    result = gvo.run_recording(room, tmp_path / "out", outputs=outputs)
    assert not result.is_complete
    assert sum("run.mcap: torn" in warning for warning in result.warnings) == 1
    assert sum("film.webm: was not written whole" in warning for warning in result.warnings) == 1
