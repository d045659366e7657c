"""Errors against the truth: zero for the truth itself, the known ones for a known mistake."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.geometry import se3
from gvo.geometry.se3 import make_transform
from gvo.io.poses.base_frame import find_base_frame
from gvo.io.poses.inputs import read_truth
from gvo.io.poses.truth import Truth, TruthComparison
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from tests.make.bags import ODOMETRY, STAMPED, TRANSFORM, WITH_COVARIANCE
from tests.make.rendered_walk import (
    STAMPS_NS,
    T_BASE_CAM,
    Walk,
    ate_by_hand,
    geodetic,
    on_a_robot,
    true_poses,
    truth_stamps,
)

LEVER = np.array([0.4, -1.1, 0.7])


def estimate(T_world_frame: FloatArray) -> Trajectory:
    return Trajectory(stamps_ns=STAMPS_NS, T_world_frame=T_world_frame)


def spoilt(poses: FloatArray, seed: int = 0) -> FloatArray:
    """Return the poses with a mistake of its own at each: a degree, a centimetre."""
    twists = np.random.default_rng(seed).normal(size=(len(poses), 6)) * [*[0.02] * 3, *[0.01] * 3]
    return np.asarray(poses @ se3.exp(twists))


def test_a_truth_that_stands_while_the_estimate_moves_is_doubted() -> None:
    poses = Walk().true_poses().T_world_frame
    standing = Truth(
        trajectory=estimate(np.tile(np.eye(4), (len(poses), 1, 1))),
        T_base_point=np.eye(4),
        decision="",
    )
    found = TruthComparison.of(standing, {"raw": estimate(poses)})
    assert found.evaluations[0].path_ratio is None
    (warning,) = found.warnings()
    assert "exchanged?" in warning
    moving = Truth(trajectory=estimate(poses), T_base_point=np.eye(4), decision="")
    assert TruthComparison.of(moving, {"raw": estimate(poses)}).warnings() == []


@pytest.fixture(scope="module")
def truth_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of the same exact motion in all ways, at 100 Hz between the frames."""
    bag = on_a_robot(tmp_path_factory.mktemp("truth") / "truth.mcap")
    bag.tf(0, "base_link", "gps", make_transform(np.eye(3), LEVER), is_static=True)
    stamps_ns = truth_stamps()
    T_map_cam = se3.exp(np.array([0.0, 0.0, 2.0, 5.0, -3.0, 1.0])) @ true_poses(stamps_ns)
    T_map_base = T_map_cam @ np.linalg.inv(T_BASE_CAM)
    antenna = T_map_base[:, :3, :3] @ LEVER + T_map_base[:, :3, 3]
    rows = zip(stamps_ns.tolist(), T_map_base, T_map_cam, geodetic(antenna), strict=True)
    for stamp_ns, T_base, T_cam, place in rows:
        bag.tf(stamp_ns, "map", "base_link", T_base)
        bag.pose("/base", ODOMETRY, stamp_ns, T_base, child="base_link")
        bag.pose("/transform", TRANSFORM, stamp_ns, T_base, child="base_link")
        bag.pose("/cam", STAMPED, stamp_ns, T_cam)
        bag.pose("/spread", WITH_COVARIANCE, stamp_ns, T_cam)
        bag.fix(stamp_ns, place)
    return bag.write()


@pytest.mark.parametrize(
    ("asked", "text"),
    [
        *((None, text) for text in ("/cam", "/spread")),
        *product((None, "base_link"), ("tf:map:base_link", "/base", "/transform", "/fix")),
    ],
)
def test_a_truth_of_its_own_rate_form_and_frame_gives_the_errors_of_the_exact_one(
    walk_bag: Path, truth_bag: Path, asked: str | None, text: str
) -> None:
    source = gvo.open_recording([walk_bag, truth_bag])
    frame = find_base_frame(source, asked)
    T_cam_frame = np.eye(4) if asked is None else np.linalg.inv(T_BASE_CAM)
    poses = true_poses(STAMPS_NS) @ T_cam_frame
    wrong = spoilt(poses)
    truth = read_truth(source, text, base_frame=frame)
    assert truth.warning == ""
    right, mistaken = TruthComparison.of(
        truth, {"right": estimate(poses), "wrong": estimate(wrong)}
    ).evaluations
    assert right.n == mistaken.n == len(STAMPS_NS)
    # what interpolation over 10 ms leaves
    assert right.ate_m < 5e-5
    assert (right.rpe_m is None) == (text == "/fix")
    assert right.rpe_m is None or right.rpe_m < 1e-4
    p_cam = (np.linalg.inv(T_BASE_CAM) @ [*LEVER, 1.0])[:3]
    p_frame = (np.linalg.inv(T_cam_frame) @ [*p_cam, 1.0])[:3] if text == "/fix" else np.zeros(3)
    points = [T[:, :3, :3] @ p_frame + T[:, :3, 3] for T in (wrong, poses)]
    assert mistaken.ate_m == pytest.approx(ate_by_hand(points[0], points[1]), abs=5e-5)
