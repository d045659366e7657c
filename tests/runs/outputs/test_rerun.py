"""Runs as files of the Rerun viewer, read back by rerun's own reader."""

import csv
import resource
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rerun")
import pyarrow as pa  # type: ignore[import-untyped]
from rerun.chunk import RrdReader

from gvo.config import Config
from gvo.errors import GvoError, RecordingError
from gvo.geometry.camera import StereoCamera
from gvo.geometry.se3 import make_transform
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.run_folder.writer import RunFolder
from gvo.io.synthetic import SyntheticRecording
from gvo.runs.loop import RunLoop
from gvo.runs.outputs.frames import RunFrames
from gvo.runs.outputs.rerun import RunRerun
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import (
    FaultyFrame,
    FloatArray,
    FrameResult,
    StereoFrame,
)
from gvo.viz.palette import COUNTS, LINKS, STAGES
from tests.make.results import estimate_at, loop_of, optimum_of, result_of
from tests.make.tracked import MOUNTED, N_FRAMES, START_NS, moved

pytestmark = pytest.mark.rerun

_ESTIMATES = ("raw", "causal", "smoothed", "global")
_CAMERA_ENTITY = "/world/causal/frame/camera"
# Up 1, down 2, right 3, left 4, forward 5, back 6.
_RIGHT_DOWN_FORWARD, _FORWARD_LEFT_UP = [3, 2, 5], [5, 4, 1]
_CAMERA = StereoCamera(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48, baseline=0.1)


class _Row(NamedTuple):
    frame: int
    stamp_ns: int
    values: dict[str, Any]


class _Read:
    """What a file holds, by entity."""

    def __init__(self, path: Path) -> None:
        self.stamp_types: set[pa.DataType] = set()
        self.fixed: dict[str, dict[str, Any]] = {}
        self.rows: dict[str, list[_Row]] = {}
        reader = RrdReader(path)
        (entry,) = reader.recordings()
        self.application = entry.application_id
        self.n_blueprints = len(reader.blueprints())
        for chunk in reader.stream():
            self._take(chunk.entity_path, chunk.to_record_batch())
        for rows in self.rows.values():
            rows.sort(key=lambda row: row.frame)  # keeps the order of those of one frame

    def _take(self, entity: str, batch: pa.RecordBatch) -> None:
        columns = {name: batch.column(name) for name in batch.schema.names}
        columns.pop("rerun.controls.RowId")
        if "frame" not in columns:
            values = {name: column[0].as_py() for name, column in columns.items()}
            self.fixed.setdefault(entity, {}).update(values)
            return
        indices = columns.pop("frame").to_pylist()
        stamps = columns.pop("stamp")
        self.stamp_types.add(stamps.type)
        stamps_ns = stamps.cast(pa.int64()).to_pylist()
        for k, (index, stamp_ns) in enumerate(zip(indices, stamps_ns, strict=True)):
            values = {name: column[k].as_py() for name, column in columns.items()}
            self.rows.setdefault(entity, []).append(_Row(index, stamp_ns, values))

    def poses(self, entity: str) -> dict[int, FloatArray]:
        """Return T_parent_entity by stamp."""
        return {row.stamp_ns: _matrix(row.values) for row in self.rows[entity]}

    def latest(self, entity: str, frame: int) -> dict[str, Any]:
        """Return what the viewer shows of an entity at a frame."""
        return [row for row in self.rows[entity] if row.frame <= frame][-1].values

    def numbers(self, entity: str) -> dict[int, float]:
        return {row.stamp_ns: row.values["Scalars:scalars"][0] for row in self.rows[entity]}

    def colour(self, entity: str) -> str:
        (number,) = self.fixed[entity]["SeriesLines:colors"]
        return f"#{number >> 8:06X}"


def _matrix(values: dict[str, Any]) -> FloatArray:
    R = Rotation.from_quat(values["Transform3D:quaternion"][0]).as_matrix()
    return make_transform(np.asarray(R), np.array(values["Transform3D:translation"][0]))


def _strip(values: dict[str, Any]) -> list[list[float]]:
    strips = values["LineStrips3D:strips"]
    return strips[0] if strips else []


@dataclass(frozen=True)
class _Run:
    """A run folder, and the Rerun file of the same run."""

    folder: Path
    read: _Read
    results: list[FrameResult]
    frames: RunFrames

    def trajectory(self, name: str) -> Trajectory:
        return read_trajectory(self.folder / f"{name}.txt")

    def table(self, name: str) -> list[dict[str, str]]:
        with (self.folder / name).open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    def causal(self) -> dict[int, FloatArray]:
        trajectory = self.trajectory("causal")
        return dict(zip(trajectory.stamps_ns.tolist(), trajectory.T_world_frame, strict=True))


class _Kept:
    """Keeps the results of a run."""

    def __init__(self) -> None:
        self.results: list[FrameResult] = []

    def add_frame(self, frame: object, result: FrameResult) -> None:
        self.results.append(result)

    def add_faulty(self, frame: object) -> None:
        """Nothing is kept."""

    def add_smoothed(self, estimates: object) -> None:
        """Nothing is kept."""

    def add_optimum(self, optimum: object) -> None:
        """Nothing is kept."""


def _run(folder: Path, source: SyntheticRecording, names: RunFrames) -> _Run:
    frame = BaseFrame() if names.is_camera else BaseFrame("base_link", names.mount(0))
    loop, kept = RunLoop(source, Config(), frame), _Kept()
    path = folder / "run.rrd"
    with (
        RunFolder(folder) as tables,
        RunRerun(path, source.info.camera, names, config=Config()) as file,
    ):
        loop.run([tables, file, kept], None)
        assert loop.optimize() is not None
    return _Run(folder=folder, read=_Read(path), results=kept.results, frames=names)


@pytest.fixture(scope="module")
def room_run(tmp_path_factory: pytest.TempPathFactory) -> _Run:
    """Return a run with an RGB-D camera, whose own poses are asked for."""
    source = SyntheticRecording("handheld", "rgbd", n_frames=N_FRAMES, scale=0.5)
    return _run(tmp_path_factory.mktemp("room"), source, RunFrames(is_world_optical=True))


@pytest.fixture(scope="module")
def robot_run(tmp_path_factory: pytest.TempPathFactory) -> _Run:
    """Return a run with a stereo camera on a robot, whose poses are asked for."""
    source = SyntheticRecording("handheld", "stereo", n_frames=N_FRAMES, scale=0.5)
    return _run(tmp_path_factory.mktemp("robot"), source, MOUNTED)


@pytest.fixture(scope="module", params=["room_run", "robot_run"])
def any_run(request: pytest.FixtureRequest) -> _Run:
    run = request.getfixturevalue(request.param)
    assert isinstance(run, _Run)
    return run


@pytest.mark.parametrize("name", _ESTIMATES)
def test_poses_and_paths_are_those_of_the_run_folder(any_run: _Run, name: str) -> None:
    trajectory, rows = any_run.trajectory(name), any_run.read.rows[f"/world/{name}/frame"]
    stamps_ns = any_run.trajectory("raw").stamps_ns.tolist()
    assert trajectory.stamps_ns.tolist() == stamps_ns
    # Both timelines name the same frames.
    assert [(row.frame, row.stamp_ns) for row in rows] == list(enumerate(stamps_ns))
    placed = np.stack([_matrix(row.values) for row in rows])
    np.testing.assert_allclose(placed, trajectory.T_world_frame, atol=2e-6)
    path = _strip(any_run.read.latest(f"/world/{name}/path", N_FRAMES))
    np.testing.assert_allclose(path, trajectory.positions, atol=2e-6)


def test_matched_points_project_to_where_they_were_seen(any_run: _Run) -> None:
    K = np.array(any_run.read.fixed[f"{_CAMERA_ENTITY}/image"]["Pinhole:image_from_camera"][0])
    rows = any_run.read.rows[f"{_CAMERA_ENTITY}/points"]
    for row, result in zip(rows, any_run.results, strict=True):
        if result.registration is None:
            assert row.values["Points3D:positions"] == []
            continue
        points = np.array(row.values["Points3D:positions"])
        pixels = (points @ K.reshape(3, 3, order="F").T)[:, :2] / points[:, 2:]
        # Points are as of the middle of the exposure, whose readout time is being learnt.
        np.testing.assert_allclose(pixels, result.registration.pixels_current, atol=1.5)
        colours = set(row.values["Points3D:colors"])
        assert len(colours) == len(set(result.registration.inliers.tolist()))


def test_numbers_are_those_of_the_tables_in_the_colours_of_the_report(any_run: _Run) -> None:
    counted, timed = any_run.table("frames.csv"), any_run.table("timings.csv")
    for name in ("matches", "inliers", "points"):
        expected = {int(row["stamp_ns"]): float(row[f"n_{name}"]) for row in counted}
        assert any_run.read.numbers(f"/counts/{name}") == expected
        assert any_run.read.colour(f"/counts/{name}") == COUNTS[name]
    for stage, code in STAGES.items():
        drawn = any_run.read.numbers(f"/milliseconds/{stage}")
        values = [float(row[f"{stage}_ms"]) for row in timed]
        np.testing.assert_allclose(list(drawn.values()), values, atol=1e-3)
        assert any_run.read.colour(f"/milliseconds/{stage}") == code
    accepted: dict[int, list[float]] = {}
    for edge in any_run.table("edges.csv"):
        if edge["kind"] == "keyframe" and edge["is_accepted"] == "1" and edge["chi2"]:
            accepted.setdefault(int(edge["stamp_ns"]), []).append(float(edge["chi2"]))
    means = {stamp_ns: np.mean(values) for stamp_ns, values in accepted.items()}
    assert any_run.read.numbers("/chi2/keyframe") == pytest.approx(means, rel=1e-3)
    assert any_run.read.colour("/chi2/keyframe") == LINKS["keyframe"]
    assert means


def test_up_is_where_the_frame_has_it(room_run: _Run, robot_run: _Run) -> None:
    axes = [run.read.fixed["/world"]["ViewCoordinates:xyz"][0] for run in (room_run, robot_run)]
    assert axes == [_RIGHT_DOWN_FORWARD, _FORWARD_LEFT_UP]


def _made(stamp_ns: int, T_world_cam: FloatArray | None = None) -> FrameResult:
    """Make the result of a frame that was not tracked."""
    return result_of(estimate_at(stamp_ns, T_world_cam))


def _frame(stamp_ns: int) -> StereoFrame:
    grey = np.full((_CAMERA.height, _CAMERA.width), 90, dtype=np.uint8)
    return StereoFrame(stamp_ns=stamp_ns, left=grey, right=grey)


def _write_made(folder: Path, results: list[FrameResult], names: RunFrames | None = None) -> _Read:
    path = folder / "made.rrd"
    with RunRerun(path, _CAMERA, names) as file:
        for result in results:
            file.add_frame(_frame(result.stamp_ns), result)
    return _Read(path)


@pytest.mark.parametrize(
    ("start_ns", "kind"), [(0, pa.duration("ns")), (START_NS, pa.timestamp("ns"))]
)
def test_stamps_are_dates_if_they_can_be(tmp_path: Path, start_ns: int, kind: pa.DataType) -> None:
    read = _write_made(tmp_path, [_made(start_ns), _made(start_ns + 1)])
    assert read.stamp_types == {kind}
    assert [row.stamp_ns for row in read.rows["/status"]] == [start_ns, start_ns + 1]


def test_a_camera_that_moves_in_the_frame_is_placed_at_each_stamp(tmp_path: Path) -> None:
    def mount(stamp_ns: int) -> FloatArray:
        return moved(y=1e-3 * stamp_ns, z=1.0)

    names = RunFrames(base="base_link", camera="pan", T_base_cam=mount)
    poses = _write_made(tmp_path, [_made(5), _made(9)], names).poses(_CAMERA_ENTITY)
    assert {ns: pytest.approx(mount(ns)[1, 3]) for ns in (5, 9)} == {
        ns: pose[1, 3] for ns, pose in poses.items()
    }


def test_loops_run_between_causal_poses_and_at_the_end_between_global_ones(tmp_path: Path) -> None:
    results = [_made(10 * k, moved(float(k))) for k in (1, 2, 3)]
    # The place of the second is not known.
    results[2] = replace(results[2], loops=(loop_of(30, 10), loop_of(30, 15)))
    ends = [replace(r.causal, T_world_frame=moved(0.5 * k)) for k, r in enumerate(results)]
    optimum = optimum_of(ends, loop_of(30, 10), loop_of(30, 20, "contradicts the others"))
    path = tmp_path / "made.rrd"
    with RunRerun(path, _CAMERA) as file:
        for result in results:
            file.add_frame(_frame(result.stamp_ns), result)
        file.add_optimum(optimum)
    read = _Read(path)
    for entity, places in (("/world/loops", [3.0, 1.0]), ("/world/global/loops", [1.0, 0.0])):
        (row,) = read.rows[entity]
        assert row.stamp_ns == 30
        (strip,) = row.values["LineStrips3D:strips"]
        assert [point[0] for point in strip] == places
    assert [point[0] for point in _strip(read.latest("/world/global/path", 2))] == [0.0, 0.5, 1.0]


def test_faulty_frames_are_told_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "made.rrd"
    with RunRerun(path, _CAMERA) as file:
        file.add_faulty(FaultyFrame(stamp_ns=1, reason="black"))
        file.add_frame(_frame(2), _made(2))
        file.add_faulty(FaultyFrame(stamp_ns=3, reason="torn"))
        file.add_frame(_frame(4), _made(4))
        file.add_smoothed([_made(2).causal])
    read = _Read(path)
    rows = [
        (row.frame, row.stamp_ns, row.values["TextLog:text"][0]) for row in read.rows["/status"]
    ]
    assert [row[:2] for row in rows] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert [row[2] for row in rows][::2] == ["skipped: black", "skipped: torn"]
    assert [row.frame for row in read.rows["/world/causal/frame"]] == [1, 3]
    assert [(r.frame, r.stamp_ns) for r in read.rows["/world/smoothed/frame"]] == [(1, 2)]


@pytest.fixture
def small_disk() -> Iterator[None]:
    """Let no file grow beyond 100 kB, as a full disk would."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.usefixtures("small_disk")
def test_a_full_disk_is_told_and_no_file_taken_for_whole(tmp_path: Path) -> None:
    path = tmp_path / "made.rrd"
    noise = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    file = RunRerun(path, replace(_CAMERA, width=640, height=480))
    for k in range(3):
        file.add_frame(StereoFrame(stamp_ns=k, left=noise, right=noise), _made(k))
    with pytest.raises(RecordingError, match="cannot be written"):
        file.close()
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "made.rrd"
    path.write_bytes(b"mine")
    with pytest.raises(RecordingError, match="exists already"):
        RunRerun(path, _CAMERA)
    assert path.read_bytes() == b"mine"
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(GvoError, match="RERUN"):
        RunRerun(tmp_path / "other.rrd", _CAMERA)
    assert list(tmp_path.iterdir()) == [path]
