"""What frames give, made up: where a test does not ask about a number, it is nothing."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from gvo.types import Estimate, FloatArray, FrameResult, Loop, Observations, Optimum, Status


def estimate_at(stamp_ns: int, T: FloatArray | None = None, **changes: Any) -> Estimate:
    """Return a pose, by default the identity with a covariance of one."""
    T = np.eye(4) if T is None else T
    given: dict[str, Any] = {"stamp_ns": stamp_ns, "T_world_frame": T, "covariance": np.eye(6)}
    return Estimate(**given | changes)


def result_of(raw: Estimate, **changes: Any) -> FrameResult:
    counts = dict.fromkeys(("n_keypoints", "n_points", "n_matches", "n_inliers", "n_links"), 0)
    poses = {"raw": raw, "causal": raw, "finished": (), "status": Status.OK, "reason": ""}
    given: dict[str, Any] = poses | counts | changes
    return FrameResult(**given)


def loop_of(stamp_ns: int, reference_ns: int, reason: str = "") -> Loop:
    """Return a loop between two frames at one place, of 87 inliers."""
    return Loop(
        stamp_ns=stamp_ns,
        reference_ns=reference_ns,
        T_reference_frame=np.eye(4),
        covariance=np.eye(6),
        n_matches=90,
        n_inliers=87,
        reason=reason,
    )


def optimum_of(estimates: Iterable[Estimate], *loops: Loop) -> Optimum:
    """Return global poses, and what became of the loops."""
    return Optimum(
        estimates=tuple(estimates),
        frames_ns=(),
        edges=(),
        loops=loops,
        residuals=np.zeros(len(loops)),
        error_before=1.0,
        error=0.5,
        n_iterations=3,
    )


def observations_of(stamp_ns: int, points: FloatArray, **changes: Any) -> Observations:
    """Return points of the left camera, without descriptors."""
    n = len(points)
    given: dict[str, Any] = {
        "keypoints": np.zeros((n, 2)),
        "disparities": np.ones(n),
        "points_cam": points,
        "sigmas": np.ones((n, 3)),
        "descriptors_left": np.zeros((n, 32), dtype=np.uint8),
    }
    return Observations(stamp_ns=stamp_ns, **given | changes)
