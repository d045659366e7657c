"""The trajectory value: checks, frames, interpolation."""

from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory, format_stamp
from gvo.types import FloatArray
from tests.trajectory.paths import random_trajectory, seeds, unturned


def test_arrays_are_copies_that_nobody_can_write_to() -> None:
    stamps, poses, covariances = np.arange(3), np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 6, 6))
    trajectory = Trajectory(stamps_ns=stamps, T_world_frame=poses, covariances=covariances)
    stamps[0], poses[0, 0, 3], covariances[0, 0, 0] = -1, 7.0, 7.0
    assert trajectory.stamps_ns[0] == trajectory.positions[0, 0] == 0
    assert trajectory.covariances is not None
    assert trajectory.covariances[0, 0, 0] == 0
    for array in (trajectory.stamps_ns, trajectory.T_world_frame, trajectory.covariances):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def at(place: tuple[int, int, int], value: float) -> FloatArray:
    array = np.zeros((3, 4, 4))
    array[place] = value
    return array


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"stamps_ns": np.array([0, 2, 2])}, "after index 1"),
        ({"stamps_ns": np.array([0, 3, 2])}, "after index 1"),
        ({"stamps_ns": np.array([0.0, 1.0, 2.0])}, "integers"),
        ({"stamps_ns": np.array([[0, 1, 2]])}, "shape"),
        ({"stamps_ns": np.array([0, 1])}, "T_world_frame must have shape"),
        ({"covariances": np.zeros((3, 3, 3))}, "covariances must have shape"),
        ({"covariances": np.zeros((3, 6, 6)), "has_rotations": False}, "identities and no cov"),
        (
            {"T_world_frame": se3.exp(np.full((3, 6), 0.1)), "has_rotations": False},
            "identities and",
        ),
        *(
            ({"T_world_frame": np.tile(np.eye(4), (3, 1, 1)) + at(place, value)}, match)
            for place, value, match in [
                ((1, 0, 3), np.nan, "finite"),
                ((1, 0, 3), np.inf, "finite"),
                ((1, 0, 0), -2.0, r"\[1\] holds no rotation"),
                ((1, 0, 0), 0.1, r"\[1\] holds no rotation"),
                ((1, 3, 3), 1.0, r"\[1\] must have .* last row"),
            ]
        ),
    ],
)
def test_what_is_no_trajectory_is_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Trajectory(
            **{"stamps_ns": np.arange(3), "T_world_frame": np.tile(np.eye(4), (3, 1, 1))} | changes
        )


@given(st.integers(min_value=-(2**63) + 1, max_value=2**63 - 1))
def test_a_stamp_is_written_without_loss(stamp_ns: int) -> None:
    text = format_stamp(stamp_ns)
    assert Decimal(text) * 10**9 == stamp_ns
    assert len(text.partition(".")[2]) == 9


def test_the_covariance_of_another_frame_is_that_of_moved_samples() -> None:
    rng = np.random.default_rng(5)
    covariance = np.diag([1.0, 4.0, 9.0, 2.0, 3.0, 5.0]) * 1e-6
    T_world_cam, T_cam_body = se3.exp(rng.normal(size=(2, 6)))
    samples = rng.multivariate_normal(np.zeros(6), covariance, size=40_000)
    moved = T_world_cam @ se3.exp(samples) @ T_cam_body
    twists = se3.log(se3.invert(T_world_cam @ T_cam_body) @ moved)
    trajectory = Trajectory(
        stamps_ns=np.array([0]), T_world_frame=T_world_cam[None], covariances=covariance[None]
    ).transformed(T_cam_body)
    assert trajectory.covariances is not None
    np.testing.assert_allclose(trajectory.covariances[0], np.cov(twists.T), atol=6e-7)


@given(seeds, st.floats(min_value=0.0, max_value=1.0))
def test_interpolation_follows_a_screw_about_a_fixed_axis(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    axis, velocity = rng.normal(size=3), rng.normal(size=3)
    axis *= rng.uniform(0.0, 3.0) / np.linalg.norm(axis)
    start = Rotation.random(rng=rng)
    span = int(rng.integers(1, 10**10))

    def pose(at: float) -> np.ndarray:
        return se3.make_transform(
            np.asarray((start * Rotation.from_rotvec(at * axis)).as_matrix()), at * velocity
        )

    trajectory = Trajectory(
        stamps_ns=np.array([7, 7 + span]), T_world_frame=np.stack([pose(0.0), pose(1.0)])
    )
    wanted = round(share * span)
    between = trajectory.interpolate(np.array([7 + wanted]))
    np.testing.assert_allclose(between.T_world_frame[0], pose(wanted / span), atol=1e-9)


def test_nothing_is_extrapolated() -> None:
    trajectory = random_trajectory(0)
    first, last = trajectory.stamps_ns[0], trajectory.stamps_ns[-1]
    inside = trajectory.interpolate(np.array([first - 1, first, first + 1, last, last + 1]))
    assert inside.stamps_ns.tolist() == [first, first + 1, last]
    assert len(trajectory.interpolate(np.array([last + 1]))) == 0


def positions_only(seed: int = 0, n: int = 5) -> Trajectory:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return Trajectory.of_positions(np.arange(n) * 10, points, stamps_from="topic")


@given(seeds)
def test_positions_without_rotations_stay_so_wherever_they_go(seed: int) -> None:
    found = positions_only(seed)
    T = se3.exp(np.random.default_rng(seed).normal(size=6))
    moved = found.moved(T)
    np.testing.assert_allclose(moved.positions, se3.transform_points(T, found.positions))
    middles = found.interpolate(np.arange(5, 40, 10))
    expected = 0.5 * (found.positions[1:] + found.positions[:-1])
    np.testing.assert_allclose(middles.positions, expected)
    for other in (found, moved, middles, found.select([1, 3]), found.interpolate(np.array([99]))):
        assert not other.has_rotations
        assert other.stamps_from == "topic"
        unturned = np.tile(np.eye(3), (len(other), 1, 1))
        np.testing.assert_array_equal(other.T_world_frame[:, :3, :3], unturned)


def test_without_rotations_only_the_point_itself_is_known() -> None:
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        Trajectory.of_positions(np.arange(2), np.zeros((2, 2)))
    found = positions_only()
    turned = found.transformed(se3.exp(np.array([0.3, 0.2, 0.1, 0.0, 0.0, 0.0])))
    np.testing.assert_array_equal(turned.T_world_frame, found.T_world_frame)
    with pytest.raises(ValueError, match="positions of another point are not known"):
        found.transformed(se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])))


@given(seeds)
def test_another_world_changes_neither_steps_nor_covariances(seed: int) -> None:
    trajectory = random_trajectory(seed)
    moved = trajectory.moved(se3.exp(np.random.default_rng(seed).normal(size=6)))
    steps = [se3.invert(T[:-1]) @ T[1:] for T in (trajectory.T_world_frame, moved.T_world_frame)]
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-9)
    assert moved.covariances is not None
    assert trajectory.covariances is not None
    np.testing.assert_array_equal(moved.covariances, trajectory.covariances)


def test_a_trajectory_prints_as_one_line() -> None:
    stamps_ns = np.array([1, 3]) * 500_000_000
    positions = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])
    known = Trajectory.of_positions(stamps_ns, positions)
    assert str(known) == "Trajectory(2 poses, 1.0 s from 0.500000000, 5.00 m, positions alone)"
    covariances = np.tile(np.eye(6), (2, 1, 1))
    whole = Trajectory(
        stamps_ns=stamps_ns, T_world_frame=unturned(positions), covariances=covariances
    )
    assert repr(whole).endswith("5.00 m, with covariances)")
    assert str(known.select([])) == "Trajectory(no poses)"


def shared_chain(n: int = 30) -> tuple[Trajectory, FloatArray]:
    """Return a chain with noise and an error that its steps share, and what one step's noise is."""
    rng = np.random.default_rng(4)
    noise, shared = np.diag(np.repeat([1e-8, 1e-6], 3)), 1e-2 * rng.normal(size=(6, 2))
    T, N, S = [np.eye(4)], [np.zeros((6, 6))], [np.zeros((6, 2))]
    for _ in range(n - 1):
        step = se3.exp(rng.normal(size=6))
        back = se3.adjoint(se3.invert(step))
        T.append(T[-1] @ step)
        N.append(back @ N[-1] @ back.T + noise)
        S.append(back @ S[-1] + shared)
    covariances = [a + b @ b.T for a, b in zip(N, S, strict=True)]
    chain = Trajectory(
        stamps_ns=10 * np.arange(n),
        T_world_frame=np.array(T),
        covariances=np.array(covariances),
        effects=np.array(S),
    )
    return chain, noise + shared @ shared.T


def test_the_motion_over_one_step_is_as_certain_as_the_step() -> None:
    chain, expected = shared_chain()
    for k in (0, 7, 28):
        motion = chain.motion(k, k + 1)
        assert motion.reference_id == 10 * k
        T = se3.invert(chain.T_world_frame[k]) @ chain.T_world_frame[k + 1]
        np.testing.assert_allclose(motion.T_reference_frame, T)
        np.testing.assert_allclose(motion.covariance, expected, rtol=1e-6, atol=1e-12)


def test_from_the_start_a_motion_is_as_certain_as_the_pose() -> None:
    chain, _ = shared_chain()
    found, expected = chain.motion(0, 29).covariance, chain.covariances
    assert expected is not None
    np.testing.assert_allclose(found, expected[29], rtol=1e-6, atol=1e-9)


def test_motions_of_another_frame_and_of_a_part_are_those_of_the_whole() -> None:
    chain, _ = shared_chain()
    part = chain.select(slice(5, 20))
    np.testing.assert_allclose(part.motion(2, 9).covariance, chain.motion(7, 14).covariance)
    T_frame_other = se3.exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -1.0]))
    moved = chain.transformed(T_frame_other).motion(7, 14).covariance
    back = se3.adjoint(se3.invert(T_frame_other))
    expected = back @ chain.motion(7, 14).covariance @ back.T
    np.testing.assert_allclose(moved, expected, rtol=1e-6, atol=1e-12)


def test_without_covariances_a_motion_has_none() -> None:
    chain, _ = shared_chain()
    with pytest.raises(ValueError, match="without covariances"):
        replace(chain, covariances=None).motion(0, 1)
