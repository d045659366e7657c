"""The record of a long drive, made up: noise on a winding road, a few gaps and refused links."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.geometry.se3 import make_transform
from gvo.io.run_folder.reader import RunRecord
from gvo.trajectory.trajectory import Trajectory
from gvo.types import IntArray

_SIGMAS = np.array([0.002, 0.002, 0.002, 0.05, 0.05, 0.05])
STAGES = ("read", "extract", "register", "links", "window")


def _trajectory(
    stamps_ns: IntArray, rng: np.random.Generator, *, noise_m: float, has_covariances: bool
) -> Trajectory:
    n = len(stamps_ns)
    s = np.arange(n) / n
    headings = 6.0 * np.sin(5.0 * np.pi * s)
    steps = np.column_stack([np.sin(headings), 0.02 * np.cos(40.0 * s), np.cos(headings)])
    positions = np.cumsum(steps + noise_m * rng.normal(size=(n, 3)), axis=0)
    R = np.asarray(Rotation.from_rotvec(np.outer(headings, [0.0, 1.0, 0.0])).as_matrix())
    growing = _SIGMAS**2 * np.linspace(1.0, 20.0, n)[:, np.newaxis]
    return Trajectory(
        stamps_ns=stamps_ns,
        T_world_frame=make_transform(R, positions),
        covariances=growing[:, :, np.newaxis] * np.eye(6) if has_covariances else None,
    )


def make_long_run(folder: Path, n_frames: int) -> RunRecord:
    """Return the record of as many frames, about a metre apart, ten a second."""
    rng = np.random.default_rng(1)
    stamps_ns: IntArray = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(n_frames)
    is_lost = np.arange(n_frames) % 997 == 500
    counts = {
        f"n_{name}": rng.poisson(mean, n_frames).astype(np.int64)
        for name, mean in zip(
            ("keypoints", "points", "matches", "inliers", "links"),
            (800, 600, 300, 250, 3),
            strict=True,
        )
    }
    references = np.repeat(stamps_ns[:-1], 3)
    has_all = {"raw": 0.05, "causal": 0.02, "smoothed": 0.01}
    return RunRecord(
        folder=folder,
        summary={},
        frames={
            "stamp_ns": stamps_ns,
            "status": np.where(is_lost, "lost", "ok").astype(np.object_),
            "reason": np.where(is_lost, "too few matches", "").astype(np.object_),
            **counts,
        },
        edges={
            "stamp_ns": np.repeat(stamps_ns[1:], 3),
            "reference_ns": references,
            "kind": np.tile(np.array(["step", "keyframe", "keyframe"]), n_frames - 1),
            "is_accepted": rng.random(len(references)) > 0.02,
            "chi2": rng.chisquare(6, len(references)),
        },
        loops={},
        timings={
            "stamp_ns": stamps_ns,
            **{f"{name}_ms": rng.gamma(8.0, 0.5, n_frames) for name in STAGES},
        },
        trajectories={
            name: _trajectory(stamps_ns, rng, noise_m=noise, has_covariances=True)
            for name, noise in has_all.items()
        },
        truth=_trajectory(stamps_ns, rng, noise_m=0.0, has_covariances=False),
    )
