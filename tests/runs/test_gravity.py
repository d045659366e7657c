"""Worlds that are turned by gravity."""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.config import Config
from gvo.errors import ConfigurationError
from gvo.geometry import se3
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import ChosenImages, StampedImage
from gvo.io.run_folder.reader import read_run
from gvo.runs.gravity import align_with_gravity
from gvo.runs.loop import RunLoop
from gvo.types import FloatArray
from tests.conftest import run_of
from tests.make.blind_walk import BLIND, N_FRAMES, blind_walk, stamps_of, true_ups
from tests.make.rendered_walk import GLOBAL, T_BASE_CAM, TRAJECTORIES, read_bag

_ALL = (*TRAJECTORIES, GLOBAL)
UP = np.array([0.0, 0.0, 1.0])
SURE = np.radians(0.5)
WITHIN = 3.0 * SURE


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a run that is not aligned, and one that is, with a bag beside it."""
    plain, turned = (tmp_path_factory.mktemp(name) / "out" for name in ("plain", "turned"))
    run_of(blind_walk(), plain)
    outputs = gvo.RunOutputs(report=False, bag=turned.parent / "run.mcap")
    assert run_of(blind_walk(), turned, gravity_aligned=True, outputs=outputs).is_complete
    return plain, turned


def poses(folder: Path, name: str) -> FloatArray:
    return gvo.read_trajectory(folder / f"{name}.txt").T_world_frame


def true_up(T_base_cam: FloatArray) -> FloatArray:
    """Return the direction upwards in the axes of the first frame."""
    return np.asarray(true_ups(np.zeros(1), T_base_cam)[0])


def test_all_poses_are_turned_alike_so_that_z_points_up(folders: tuple[Path, Path]) -> None:
    plain, turned = folders
    R = poses(turned, "raw")[0][:3, :3]
    np.testing.assert_allclose(R @ true_up(np.eye(4)), UP, atol=WITHIN)
    # the camera looks along x
    np.testing.assert_allclose(R[:2, 2] / np.linalg.norm(R[:2, 2]), [1.0, 0.0], atol=1e-9)
    T = se3.make_transform(R, np.zeros(3))
    for name in _ALL:
        np.testing.assert_allclose(poses(turned, name), T @ poses(plain, name), atol=1e-8)
        first, second = (
            np.loadtxt(folder / f"{name}_covariance.csv", delimiter=",", skiprows=1)
            for folder in folders
        )
        np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-15)
    assert (plain / "inertial.csv").read_bytes() == (turned / "inertial.csv").read_bytes()


def test_the_beginning_is_tracked_until_the_direction_is_known_well(
    folders: tuple[Path, Path],
) -> None:
    walk, n_read = blind_walk(), 0

    def images() -> Iterator[StampedImage]:
        nonlocal n_read
        for image in walk.images():
            n_read += image.stream == 0
            yield image

    loop = RunLoop(ChosenImages(info=walk.info, images=images), Config(), BaseFrame())
    align_with_gravity(loop)
    table = read_run(folders[0]).inertial
    is_known = (table["sigma_up_rad"] < SURE) & ~table["is_carried"]
    n = np.searchsorted(stamps_of(walk), table["stamp_ns"][np.argmax(is_known)]) + 1
    assert n <= n_read <= n + 4  # some are read ahead
    assert not is_known[:10].any()


def test_the_bag_is_in_the_same_world(folders: tuple[Path, Path]) -> None:
    _, turned = folders
    messages = read_bag(turned.parent / "run.mcap")
    assert "/tf_static" not in messages  # which would place the world in one with z up
    for name in _ALL:
        found = sorted(
            ((m.header.stamp.sec, m.header.stamp.nanosec), m.pose.pose.position)
            for _, m in messages[f"/gvo/{name}/odometry"]
        )
        positions = [(p.x, p.y, p.z) for _, p in found]
        np.testing.assert_allclose(positions, poses(turned, name)[:, :3, 3], atol=1e-8)


def test_the_summary_tells_what_the_imu_did(folders: tuple[Path, Path]) -> None:
    plain, turned = (json.loads((each / "summary.json").read_text()) for each in folders)
    assert plain["imu"] == turned["imu"]
    assert plain["run"]["recording"] == turned["run"]["recording"]
    assert plain["run"] != turned["run"]
    imu = plain["imu"]
    assert (imu["name"], imu["has_started"], imu["reason"]) == ("rendered", True, "")
    assert (imu["n_gaps"], imu["n_carried"], imu["n_restarts"]) == (1, len(BLIND), 0)
    assert imu["carried_s"] == imu["longest_s"] == pytest.approx(len(BLIND) / 30.0, abs=1e-3)
    given = blind_walk().info.imu
    assert given is not None
    np.testing.assert_array_equal(imu["T_camera_imu"], given.imu.T_camera_imu)
    assert (imu["delay_ms"], imu["is_delay_learnt"], imu["is_rotation_learnt"]) == (0, False, False)
    last = (folders[0] / "inertial.csv").read_text().splitlines()[-1].split(",")
    biases = [float(text) for text in last[8:14]]
    np.testing.assert_allclose([*imu["gyro_bias"], *imu["acceleration_bias"]], biases, rtol=1e-6)
    assert plain["status_counts"]["coasting"] == len(BLIND)
    assert plain["tracked"] == N_FRAMES - len(BLIND)


@cache
def first_pose(T_base_cam: Any, T_initial: Any) -> FloatArray:
    mount = None if T_base_cam is None else np.reshape(T_base_cam, (4, 4))
    initial = None if T_initial is None else np.reshape(T_initial, (4, 4))
    loop = RunLoop(blind_walk(), Config(), BaseFrame("base", mount, T_initial=initial))
    align_with_gravity(loop)
    assert loop.first_pose is not None
    return loop.first_pose(int(stamps_of(blind_walk())[0]))


def turned(axis: str, deg: float | list[float]) -> FloatArray:
    R = np.asarray(Rotation.from_euler(axis, deg, degrees=True).as_matrix())
    return se3.make_transform(R, np.zeros(3))


@pytest.mark.parametrize(
    ("turn", "axis"),
    [
        (turned("x", 0.0), 0),  # z up
        (turned("x", 180.0), 0),  # z down
        (turned("y", -90.0), 2),  # x up: z is ahead
        (turned("xz", [35.0, 140.0]), 0),  # anyhow
    ],
)
def test_a_body_heads_along_x_however_it_is_mounted(turn: FloatArray, axis: int) -> None:
    T_base_cam = turn @ T_BASE_CAM
    T = first_pose(tuple(T_base_cam.ravel()), None)
    assert se3.transform_fault(T) == ""
    np.testing.assert_allclose(T[:3, :3] @ true_up(T_base_cam), UP, atol=WITHIN)
    assert T[0, axis] > 0.4
    assert T[1, axis] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(T[:3, 3], np.zeros(3))


def test_position_and_heading_that_were_asked_for_stay() -> None:
    asked = turned("ZY", [130.0, 5.0])  # tilted by mistake
    asked[:3, 3] = 4.0, -5.0, 6.0
    T = first_pose(tuple(T_BASE_CAM.ravel()), tuple(asked.ravel()))
    np.testing.assert_allclose(T[:3, :3] @ true_up(T_BASE_CAM), UP, atol=WITHIN)
    assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(130.0, abs=1e-6)
    np.testing.assert_array_equal(T[:3, 3], [4.0, -5.0, 6.0])
    # a camera at a place without a rotation has no heading yet
    place = se3.make_transform(np.eye(3), np.array([1.0, 2.0, 3.0]))
    T = first_pose(None, tuple(place.ravel()))
    np.testing.assert_allclose(T[:3, :3], first_pose(None, None)[:3, :3], atol=1e-9)


def test_an_imu_that_never_starts_turns_nothing_and_is_told(tmp_path: Path) -> None:
    silent = blind_walk(share_missing=1.0)
    excerpt = gvo.Excerpt(duration_s=1.0)
    run_of(blind_walk(), tmp_path / "plain", excerpt=excerpt)
    result = run_of(silent, tmp_path / "out", gravity_aligned=True, excerpt=excerpt)
    assert not result.is_complete
    (warning,) = result.warnings
    hole = "it has no samples at some frames: a hole, or another clock"
    why = f"the IMU was not used: {hole}"
    assert warning == f"--gravity-aligned: the world is not turned, {why}"
    imu = result.summary["imu"]
    assert (imu["has_started"], imu["reason"]) == (False, hole)
    assert f"the IMU rendered was not used: {hole}" in str(result)
    assert not (tmp_path / "out" / "inertial.csv").exists()
    for name in TRAJECTORIES:
        np.testing.assert_array_equal(poses(tmp_path / "out", name)[0], np.eye(4))


def test_without_an_imu_it_is_refused(tmp_path: Path) -> None:
    without = gvo.SyntheticRecording("driving", n_frames=3, scale=0.2)
    off = Config.model_validate({"imu": {"enabled": False}})
    for source, config, why in (
        (without, Config(), "driving-stereo: no IMU is used"),
        (blind_walk(), off, "handheld-stereo: imu.enabled is false"),
    ):
        with pytest.raises(ConfigurationError, match=f"--gravity-aligned: {why}"):
            run_of(source, tmp_path / "out", config=config, gravity_aligned=True)
    assert not (tmp_path / "out").exists()
