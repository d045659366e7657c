"""Random matches as kernels take them, and plain sums over them."""

from dataclasses import dataclass

import numpy as np

from gvo.types import BoolArray, FloatArray
from tests.geometry.scenes import (
    CAMERA,
    derivative,
    project,
    random_motion,
    random_points,
    seen_from,
)

PARAMETERS = CAMERA.parameters
LOWER = np.tril_indices(3)


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Motion, points of the reference, measurements, factors, and which are used."""

    T: FloatArray
    points: FloatArray
    uvd: FloatArray
    factors: FloatArray
    is_used: BoolArray

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        return self.points, self.uvd, self.factors, self.is_used


def random_matches(rng: np.random.Generator, n: int, *, errors: float = 1.0) -> Matches:
    """Return matches with residuals of about as many sigmas, most of them used."""
    T, points = random_motion(rng, 0.05, 0.2), random_points(rng, n)
    factors = np.where(np.isin(LOWER[0], (0, 1, 2)), rng.normal(size=(n, 6)), 0.0)
    for diagonal in (0, 2, 5):
        factors[:, diagonal] = rng.uniform(1.0, 3.0, n)
    uvd = project(seen_from(T, points)) + 0.4 * errors * rng.normal(size=(n, 3))
    return Matches(T=T, points=points, uvd=uvd, factors=factors, is_used=rng.random(n) < 0.8)


def whitening(factors: FloatArray) -> FloatArray:
    """Return the factor of one match as a matrix."""
    W = np.zeros((3, 3))
    W[LOWER] = factors
    return W


def by_reference(T: FloatArray, point: FloatArray) -> FloatArray:
    """Return the derivative of what the current frame sees by what the reference measured."""
    fx, fy, baseline = CAMERA.fx, CAMERA.fy, CAMERA.baseline
    depth = point[2]
    by_uvd = np.column_stack(
        [[depth / fx, 0, 0], [0, depth / fy, 0], -point * depth / (fx * baseline)]
    )
    return np.asarray(derivative(seen_from(T, point))[:, 3:] @ T[:3, :3].T @ by_uvd)


def rows_of(matches: Matches, T: FloatArray, huber: float) -> tuple[list[FloatArray], ...]:
    """Return Jacobian (3, 6), residual, and W times the root of its weight, of those used."""
    Js, rs, Ws = [], [], []
    for point, uvd, factors, is_used in zip(*matches.arrays, strict=True):
        if not is_used:
            continue
        seen, W = seen_from(T, point), whitening(factors)
        r = W @ (uvd - project(seen))
        W = W * min(1.0, huber / float(np.linalg.norm(r))) ** 0.5
        Js.append(-W @ derivative(seen))
        rs.append(W @ (uvd - project(seen)))
        Ws.append(W)
    return Js, rs, Ws
