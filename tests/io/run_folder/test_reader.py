"""Run folders read back: whole, cut off at any byte, damaged."""

import json
import shutil
from collections.abc import Sized
from pathlib import Path

import numpy as np
import pytest

from gvo.errors import GvoError, RecordingError, TrajectoryError
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.run_folder.reader import RunRecord, loop_ends, read_run
from gvo.io.synthetic import SyntheticRecording
from gvo.trajectory.formats import read_covariances, read_trajectory
from gvo.types import FloatArray
from tests.conftest import run_of
from tests.make.blind_walk import BLIND, blind_walk, stamps_of, true_twists, true_ups
from tests.make.rendered_walk import T_BASE_CAM

N = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run")
    run_of(SyntheticRecording("handheld", "rgbd", n_frames=N, scale=0.25), path)
    return path


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_a_folder_is_read_as_its_files_say(folder: Path) -> None:
    record = read_run(folder)
    assert record.is_finished
    assert record.summary == json.loads((folder / "summary.json").read_text())
    for name, trajectory in record.trajectories.items():
        other = read_trajectory(folder / f"{name}.txt")
        stamps_ns, covariances = read_covariances(folder / f"{name}_covariance.csv")
        assert np.array_equal(trajectory.stamps_ns, stamps_ns)
        np.testing.assert_allclose(trajectory.T_world_frame, other.T_world_frame, atol=1e-12)
        assert trajectory.covariances is not None
        np.testing.assert_array_equal(trajectory.covariances, covariances)
    assert record.frames["status"].tolist() == ["ok"] * N
    assert len(record.edges["chi2"]) == len((folder / "edges.csv").read_text().splitlines()) - 1
    stages = ("read", "extract", "register", "links", "window", "loops")
    assert [*record.timings] == ["stamp_ns", *(f"{stage}_ms" for stage in stages)]
    assert record.truth is not None


def test_files_cut_off_at_any_byte_are_read_as_far_as_they_go(copy: Path) -> None:
    (copy / "summary.json").unlink()
    for name in ("causal.txt", "causal_covariance.csv", "frames.csv", "edges.csv", "timings.csv"):
        content = (copy / name).read_bytes()
        for n_bytes in range(0, len(content), 149):
            (copy / name).write_bytes(content[:n_bytes])
            record = read_run(copy)
            assert not record.is_finished
        n_lines = content[:n_bytes].count(b"\n")
        assert len(_part(record, name)) == n_lines - (not name.endswith(".txt"))
        (copy / name).write_bytes(content)


def _part(record: RunRecord, name: str) -> Sized:
    parts: dict[str, Sized] = {
        "causal.txt": record.trajectories["causal"].stamps_ns,
        "causal_covariance.csv": record.trajectories["causal"].stamps_ns,
        "frames.csv": record.frames.get("stamp_ns", ()),
        "edges.csv": record.edges.get("stamp_ns", ()),
        "timings.csv": record.timings.get("stamp_ns", ()),
    }
    return parts[name]


def test_what_shared_errors_do_to_raw_poses_is_read(copy: Path) -> None:
    effects = np.load(copy / "effects.npy")
    raw = read_run(copy).trajectories["raw"]
    assert raw.effects is not None
    np.testing.assert_array_equal(raw.effects, effects)
    alone = read_trajectory(copy / "raw.txt")
    np.testing.assert_array_equal(alone.motion(1, 4).covariance, raw.motion(1, 4).covariance)
    assert effects.shape == (N, 6, 9)
    assert not effects[0].any()
    assert effects[1:].any(axis=(1, 2)).all()
    # Numpy's own file is the same, byte by byte.
    np.save(copy / "again.npy", effects)
    assert (copy / "again.npy").read_bytes() == (copy / "effects.npy").read_bytes()
    # The covariance contains them.
    covariances = np.array(raw.covariances) - effects @ np.swapaxes(effects, 1, 2)
    assert np.linalg.eigvalsh(covariances[1:]).min() > 0.0
    (copy / "effects.npy").unlink()
    assert read_run(copy).trajectories["raw"].effects is None


@pytest.mark.parametrize("content", [b"", b"a", b"half", b"scalar", b"pickle"])
def test_a_damaged_file_of_effects_is_refused(copy: Path, content: bytes) -> None:
    path = copy / "effects.npy"
    if content == b"half":
        content = path.read_bytes()[:-8]
    elif content in (b"scalar", b"pickle"):
        value = 1.0 if content == b"scalar" else np.array([{}] * N)
        np.save(path, value, allow_pickle=True)
        content = path.read_bytes()
    path.write_bytes(content)
    with pytest.raises(TrajectoryError, match=r"effects.npy: .* run again"):
        read_run(copy)


def columns(record: RunRecord, form: str) -> np.ndarray:
    return np.stack([record.inertial[form.format(axis)] for axis in "xyz"], axis=1)


@pytest.mark.parametrize("T_base_cam", [None, T_BASE_CAM])
def test_what_the_imu_tells_of_a_frame_is_a_row_and_true(
    T_base_cam: FloatArray | None, tmp_path: Path
) -> None:
    run_of(blind_walk(), tmp_path, base_frame=BaseFrame("base_link", T_base_cam))
    T_base_cam = np.eye(4) if T_base_cam is None else T_base_cam
    record, stamps_ns = read_run(tmp_path), stamps_of(blind_walk())
    start = int(np.searchsorted(stamps_ns, record.inertial["stamp_ns"][0]))
    assert 10 < start < 30
    np.testing.assert_array_equal(record.inertial["stamp_ns"], stamps_ns[start:])
    frames = np.arange(start, len(stamps_ns))
    np.testing.assert_array_equal(record.inertial["is_carried"], np.isin(frames, BLIND))
    times_s = 1e-9 * (stamps_ns - stamps_ns[0])[start:]
    twists = true_twists(times_s, T_base_cam)
    errors_mps = np.linalg.norm(columns(record, "v{}_mps") - twists[:, 3:], axis=1)
    assert np.linalg.norm(twists[:, 3:], axis=1).mean() > 0.1
    assert np.all(errors_mps < 4.0 * record.inertial["sigma_v_mps"])
    assert np.median(errors_mps) < 0.02
    cosines = np.sum(columns(record, "up_{}") * true_ups(times_s, T_base_cam), axis=1)
    angles = np.arccos(np.minimum(cosines, 1.0))
    assert np.all(angles < 4.0 * record.inertial["sigma_up_rad"])
    assert angles[-1] < np.radians(1.5)
    grown = record.inertial["sigma_v_mps"][np.isin(frames, BLIND)]
    assert np.all(np.diff(grown) > 0.0)
    # drawn by a normal distribution of 0.05 rad/s and 0.1 m/s^2
    for form, most in (("gyro_bias_{}_radps", 0.2), ("acceleration_bias_{}_mps2", 0.4)):
        biases = columns(record, form)
        assert np.all(np.abs(biases) < most)
        assert np.abs(biases).max() > 0.1 * most
    assert np.all(np.diff(record.inertial["sigma_gyro_bias_radps"][[0, -1]]) < 0.0)


def test_without_an_imu_there_is_no_such_file(folder: Path) -> None:
    assert not (folder / "inertial.csv").exists()
    assert read_run(folder).inertial == {}


def test_loops_are_lines_between_their_poses(copy: Path) -> None:
    trajectory = read_run(copy).trajectories["global"]
    stamps_ns = trajectory.stamps_ns.tolist()
    rows = [(5, 1, ""), (4, 0, "odd"), (5, 2, "")]
    table = [f"{stamps_ns[end]},{stamps_ns[start]},9,1.5,{why}" for end, start, why in rows]
    header = "stamp_ns,reference_ns,n_inliers,residual,reason"
    (copy / "loops.csv").write_text("\n".join([header, *table, ""]))
    loops = read_run(copy).loops
    assert loops["reason"].tolist() == ["", "odd", ""]
    assert loops["n_inliers"].tolist() == [9, 9, 9]
    lines, at = loop_ends(loops, trajectory), trajectory.positions
    np.testing.assert_array_equal(lines["loops"], [at[[1, 5]], at[[2, 5]]])
    np.testing.assert_array_equal(lines["refused loops"], [at[[0, 4]]])
    # Up to the fifth frame.
    until = loop_ends(loops, trajectory.select(slice(0, 5)))
    assert {name: len(ends) for name, ends in until.items()} == {"loops": 0, "refused loops": 1}
    assert [len(ends) for ends in loop_ends(loops, trajectory.select(slice(0, 0))).values()] == [
        0,
        0,
    ]


def test_positions_are_read_as_such_and_estimates_moved_to_their_point(copy: Path) -> None:
    (copy / "ground_truth.txt").unlink()
    (copy / "ground_truth_positions.csv").write_text("stamp_ns,x_m,y_m,z_m\n0,1,2,3\n9,1,2,4\n")
    summary = json.loads((copy / "summary.json").read_text())
    T = np.eye(4)
    T[:3, 3] = (1.0, 0.0, 2.0)
    (copy / "summary.json").write_text(json.dumps(summary | {"T_base_truth": T.tolist()}))
    record = read_run(copy)
    assert record.truth is not None
    assert not record.truth.has_rotations
    moved, raw = record.comparable()["raw"], record.trajectories["raw"]
    np.testing.assert_allclose(moved.T_world_frame, raw.T_world_frame @ T)


@pytest.mark.parametrize(
    ("name", "text", "error", "message"),
    [
        ("summary.json", "{", RecordingError, "is damaged"),
        ("summary.json", "[]", RecordingError, "holds no object"),
        ("frames.csv", "stamp_ns,reason\n", RecordingError, "no column status"),
        ("edges.csv", "stamp_ns\n1\n", RecordingError, "no column reference_ns"),
        ("timings.csv", "stamp_ns,read_ms\n1,fast\n", RecordingError, "fast"),
        ("timings.csv", "stamp_ns,read_ms\n1\n", RecordingError, "1 columns"),
        ("loops.csv", "stamp_ns,reference_ns\n1,2\n", RecordingError, "no column n_inliers"),
        ("inertial.csv", "stamp_ns\n1\n", RecordingError, "no column is_carried"),
        ("summary.json", '{"imu": {"name": "/imu"}}', RecordingError, "is damaged"),
        ("raw.txt", "0.000000000 1 2 3\n", TrajectoryError, "raw.txt:1: expected 8 columns, got 4"),
        ("raw.txt", "a b\n", TrajectoryError, "raw.txt:1"),
        ("raw.txt", "0.000000000 0 0 0 0 0 0 0\n", TrajectoryError, "raw.txt"),
    ],
)
def test_damaged_files_are_refused_in_one_line(
    copy: Path, name: str, text: str, error: type[GvoError], message: str
) -> None:
    (copy / name).write_text(text)
    with pytest.raises(error) as caught:
        read_run(copy)
    assert message in str(caught.value)
    assert name.split(".")[0] in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_run_folder_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RecordingError, match="is not a run folder"):
            read_run(path)
