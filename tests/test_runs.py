"""A run folder holds what it promises, and the same run gives the same bytes."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.sources.recording import RecordingInfo, Source, StampedImage
from gvo.sources.synthetic import SyntheticRecording
from gvo.trajectory import Trajectory
from gvo.trajectory_files import read_covariances, write_kitti

TRAJECTORIES = ("raw", "causal", "smoothed")


class FaultySource:
    """A source of which some images cannot be read, or which breaks off."""

    def __init__(self, source: Source, *, faulty: set[int], end: int | None = None) -> None:
        self._source = source
        self._faulty = faulty
        self._end = end

    @property
    def info(self) -> RecordingInfo:
        return self._source.info

    def images(self) -> Iterator[StampedImage]:
        for index, image in enumerate(self._source.images()):
            if self._end is not None and index // 2 >= self._end:
                raise RecordingError("the file ends in the middle of a message")
            is_faulty = index // 2 in self._faulty
            yield replace(image, load=_fail) if is_faulty else image

    def ground_truth(self) -> Trajectory | None:
        return self._source.ground_truth()


def _fail() -> np.ndarray:
    raise RecordingError("the image is of zero size")


@pytest.fixture(scope="module")
def room() -> SyntheticRecording:
    return SyntheticRecording("handheld", "rgbd", n_frames=12, scale=0.5)


@pytest.fixture(scope="module")
def run_dir(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    result = gvo.run_recording(gvo.open_recording(drive_bag), out)
    assert result.exit_code == 0
    assert result.warnings == ()
    return out


def test_each_trajectory_has_a_pose_and_a_covariance_for_each_frame(run_dir: Path) -> None:
    for name in TRAJECTORIES:
        trajectory = gvo.read_trajectory(run_dir / f"{name}.txt")
        stamps_ns, covariances = read_covariances(run_dir / f"{name}_covariance.csv")
        assert len(trajectory) == 20
        np.testing.assert_array_equal(stamps_ns, trajectory.stamps_ns)
        assert np.all(np.linalg.eigvalsh(covariances[1:]) > 0)


def test_stamps_have_nine_decimals(run_dir: Path) -> None:
    for line in (run_dir / "smoothed.txt").read_text().splitlines():
        assert len(line.split()[0].split(".")[1]) == 9


def test_smoothed_poses_lie_in_the_order_of_their_stamps(run_dir: Path) -> None:
    stamps = [line.split()[0] for line in (run_dir / "smoothed.txt").read_text().splitlines()]
    assert stamps == sorted(stamps)


def test_frames_table_has_a_row_for_each_frame(run_dir: Path) -> None:
    with (run_dir / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * 20
    assert all(int(row["n_inliers"]) <= int(row["n_matches"]) for row in rows)
    assert all(int(row["n_inliers"]) > 50 for row in rows[1:])


def test_summary_tells_frames_times_errors_and_configuration(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["frames"] == summary["tracked"] == 20
    assert summary["coverage"] == 1.0
    assert summary["status_counts"]["ok"] == 20
    assert {"read", "extract", "register", "links", "window"} <= set(summary["median_ms"])
    assert [entry["name"] for entry in summary["errors"]] == list(TRAJECTORIES)
    assert summary["configuration"] == gvo.Config().model_dump()


def test_trajectories_are_close_to_the_exact_truth(run_dir: Path) -> None:
    summary = json.loads((run_dir / "summary.json").read_text())
    for entry in summary["errors"]:
        assert entry["ate_m"] < 0.05
        # no noisy recording is measured without an error
        assert entry["ate_m"] > 1e-4


def test_the_world_is_the_first_camera_pose(run_dir: Path) -> None:
    for name in TRAJECTORIES:
        first = gvo.read_trajectory(run_dir / f"{name}.txt").T_world_cam[0]
        np.testing.assert_allclose(first, np.eye(4), atol=1e-4)


def test_a_picture_is_drawn(run_dir: Path) -> None:
    assert (run_dir / "trajectories.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("threads", [1, 2])
def test_running_again_gives_the_same_bytes(room_bag: Path, tmp_path: Path, threads: int) -> None:
    config = gvo.load_configuration(settings=[f"runtime.threads={threads}"])
    for out in (tmp_path / "a", tmp_path / "b"):
        gvo.run_recording(gvo.open_recording(room_bag), out, config=config)
        config = gvo.Config()
    for path in sorted((tmp_path / "a").glob("*.[tc][xs][tv]")):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_a_faulty_frame_is_skipped_and_counted(room: SyntheticRecording, tmp_path: Path) -> None:
    result = gvo.run_recording(FaultySource(room, faulty={3, 4}), tmp_path)
    assert result.exit_code == 3
    assert result.summary["status_counts"]["skipped"] == 2
    assert len(gvo.read_trajectory(tmp_path / "raw.txt")) == 10
    assert "zero size" in result.warnings[0]
    rows = (tmp_path / "frames.csv").read_text().splitlines()[1:]
    assert len(rows) == 12


def test_what_was_computed_before_the_recording_broke_off_is_written(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    result = gvo.run_recording(FaultySource(room, faulty=set(), end=8), tmp_path)
    assert result.exit_code == 3
    assert "in the middle of a message" in result.warnings[0]
    for name in TRAJECTORIES:
        assert len(gvo.read_trajectory(tmp_path / f"{name}.txt")) == 8


def test_a_recording_without_a_usable_frame_is_refused(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=r"no usable frame.*zero size"):
        gvo.run_recording(FaultySource(room, faulty=set(range(12))), tmp_path)


def test_interrupting_a_run_leaves_all_poses_on_disk(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    def interrupt(progress: object) -> None:
        if progress.n_done == 7:  # type: ignore[attr-defined]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gvo.run_recording(room, tmp_path, on_progress=interrupt)
    for name in TRAJECTORIES:
        assert len(gvo.read_trajectory(tmp_path / f"{name}.txt")) == 7


def test_a_folder_that_cannot_be_written_is_one_line(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        gvo.run_recording(room, tmp_path / "file")


def test_a_truth_of_another_time_is_a_warning(room: SyntheticRecording, tmp_path: Path) -> None:
    truth = room.ground_truth()
    late = Trajectory(stamps_ns=truth.stamps_ns + 10**12, T_world_cam=truth.T_world_cam)
    result = gvo.run_recording(room, tmp_path, ground_truth=late)
    assert result.evaluations == ()
    assert "not compared" in result.warnings[0]


def test_the_errors_do_not_depend_on_the_frame_of_the_truth(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    truth = room.ground_truth()
    T_map_world = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, 6.0, 7.0]))
    moved = Trajectory(stamps_ns=truth.stamps_ns, T_world_cam=T_map_world @ truth.T_world_cam)
    first = gvo.run_recording(room, tmp_path / "a").evaluations
    second = gvo.run_recording(room, tmp_path / "b", ground_truth=moved).evaluations
    for a, b in zip(first, second, strict=True):
        assert a.ate_m == pytest.approx(b.ate_m, abs=1e-9)


class TruthlessSource(FaultySource):
    """A source whose ground truth cannot be read."""

    def ground_truth(self) -> Trajectory | None:
        raise TrajectoryError("groundtruth.txt: line 3: expected 8 numbers, got 2")


class OneEyedSource(FaultySource):
    """A stereo source that lost some images of its right camera."""

    def images(self) -> Iterator[StampedImage]:
        for index, image in enumerate(self._source.images()):
            if image.stream == 0 or index // 2 not in self._faulty:
                yield image


def test_a_malformed_truth_of_the_recording_is_a_warning(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    result = gvo.run_recording(TruthlessSource(room, faulty=set()), tmp_path)
    assert result.exit_code == 0
    assert "line 3" in result.warnings[0]
    assert (tmp_path / "summary.json").exists()
    assert (tmp_path / "trajectories.png").exists()


def test_a_left_image_without_a_right_one_is_a_loss(tmp_path: Path) -> None:
    drive = SyntheticRecording("driving", "stereo", n_frames=8, scale=0.4)
    result = gvo.run_recording(OneEyedSource(drive, faulty={2, 5}), tmp_path)
    assert result.exit_code == 3
    assert result.summary["status_counts"]["skipped"] == 2
    assert result.summary["coverage"] == 0.75


def test_colour_without_depth_makes_no_frame(room: SyntheticRecording, tmp_path: Path) -> None:
    result = gvo.run_recording(OneEyedSource(room, faulty={2, 5}), tmp_path)
    assert result.exit_code == 0
    assert result.summary["frames"] == 10
    assert result.summary["unpaired_images"] == 2
    assert "2 images have no partner" in result.warnings[0]


def test_a_run_that_fails_leaves_no_summary_of_an_earlier_one(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    (tmp_path / "summary.json").write_text("{}")
    (tmp_path / "trajectories.png").write_text("")
    with pytest.raises(RecordingError):
        gvo.run_recording(FaultySource(room, faulty=set(range(12))), tmp_path)
    assert not (tmp_path / "summary.json").exists()
    assert not (tmp_path / "trajectories.png").exists()


def test_poses_without_stamps_belong_to_the_frames_in_their_order(
    room: SyntheticRecording, tmp_path: Path
) -> None:
    truth = room.ground_truth()
    write_kitti(tmp_path / "poses.txt", truth)
    expected = gvo.run_recording(room, tmp_path / "a").evaluations
    poses = gvo.read_trajectory(tmp_path / "poses.txt")
    found = gvo.run_recording(room, tmp_path / "b", ground_truth=poses).evaluations
    assert found[0].ate_m == pytest.approx(expected[0].ate_m, abs=1e-9)
    short = gvo.run_recording(room, tmp_path / "c", ground_truth=poses.select(slice(0, 9)))
    assert short.exit_code == 3
    assert "not compared" in short.warnings[0]


def test_a_run_in_which_nothing_could_be_registered_says_so(tmp_path: Path) -> None:
    class Black(FaultySource):
        def images(self) -> Iterator[StampedImage]:
            for image in self._source.images():
                yield replace(image, load=lambda: np.zeros((192, 256), np.uint8))

    drive = SyntheticRecording("handheld", "stereo", n_frames=4, scale=0.4)
    result = gvo.run_recording(Black(drive, faulty=set()), tmp_path)
    assert result.exit_code == 3
    assert "no frame could be registered" in result.warnings[0]
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 4
