"""Trajectories that the tests measure."""

import numpy as np
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from gvo.types import FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)


def random_trajectory(seed: int, n: int = 12, *, size_m: float = 1.0) -> Trajectory:
    """Return poses with covariances, at stamps of this century."""
    rng = np.random.default_rng(seed)
    factors = 1e-3 * rng.normal(size=(n, 6, 6))
    return Trajectory(
        stamps_ns=1_305_031_101_000_000_000 + np.cumsum(rng.integers(1, 10**9, n)),
        T_world_frame=se3.exp(rng.normal(size=(n, 6)) * np.repeat([1.0, size_m], 3)),
        covariances=factors @ factors.transpose(0, 2, 1),
    )


def unturned(positions: FloatArray) -> FloatArray:
    return se3.make_transform(np.tile(np.eye(3), (len(positions), 1, 1)), positions)


def straight(n: int, step_m: float = 1.0) -> Trajectory:
    positions = step_m * np.outer(np.arange(n), [0.0, 0.0, 1.0])
    return Trajectory(stamps_ns=np.arange(n) * 100_000_000, T_world_frame=unturned(positions))


def still(stamps_ns: list[int], stamps_from: StampsFrom = "file") -> Trajectory:
    poses = unturned(np.zeros((len(stamps_ns), 3)))
    return Trajectory(
        stamps_ns=np.array(stamps_ns, dtype=np.int64), T_world_frame=poses, stamps_from=stamps_from
    )


def circle(n: int, seed: int = 0) -> Trajectory:
    twist = np.array([0.0, 0.02, 0.0, 0.1, 0.0, 1.0])
    T = np.array([se3.exp(k * twist) for k in range(n)])
    start = se3.exp(np.random.default_rng(seed).normal(size=6))
    return Trajectory(stamps_ns=np.arange(n) * 100_000_000, T_world_frame=start @ T)
