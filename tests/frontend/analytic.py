"""Images of an analytic texture, shifted and sheared to any fraction of a pixel."""

import numpy as np

from gvo.types import FloatArray, ImageArray

SHAPE = (120, 240)
MIDDLE = np.array([119.5, 59.5])
_N_WAVES = 60
_RNG = np.random.default_rng(4)
_ANGLES = _RNG.uniform(0, np.pi, _N_WAVES)
_WAVE_NUMBERS = 2 * np.pi / _RNG.uniform(6.0, 40.0, _N_WAVES)
_PHASES = _RNG.uniform(0, 2 * np.pi, _N_WAVES)


def image(
    shift_u: FloatArray | float = 0.0, shift_v: float = 0.0, *, gain: float = 1.0
) -> ImageArray:
    """Return the texture moved to the right and down; `shift_u` may differ by row."""
    u, v = np.arange(SHAPE[1])[:, np.newaxis], np.arange(SHAPE[0])[:, np.newaxis]
    shifts = np.broadcast_to(np.asarray(shift_u, dtype=float), SHAPE[0])[:, np.newaxis]
    along_u, along_v = _WAVE_NUMBERS * np.cos(_ANGLES), _WAVE_NUMBERS * np.sin(_ANGLES)
    rows = np.exp(1j * (along_v * (v - shift_v) - along_u * shifts + _PHASES))
    waves = np.real(rows @ np.exp(1j * along_u * u).T)
    grey = 120.0 + gain * 67.0 * waves / np.sqrt(_N_WAVES)
    return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def grid(border: int = 30, step: int = 11) -> FloatArray:
    """Return whole pixels away from the border, shape (n, 2)."""
    v, u = np.mgrid[border : SHAPE[0] - border : step, border : SHAPE[1] - border : step]
    return np.column_stack([u.ravel(), v.ravel()]).astype(float)


def warped_image(warp: FloatArray, shift: FloatArray) -> ImageArray:
    """Return the texture turned, stretched and sheared about the middle, and moved."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    seen = np.stack([u.ravel(), v.ravel()], axis=1) - MIDDLE - shift
    u, v = (seen @ np.linalg.inv(warp).T + MIDDLE).T
    along_u, along_v = _WAVE_NUMBERS * np.cos(_ANGLES), _WAVE_NUMBERS * np.sin(_ANGLES)
    waves = np.sum(
        [np.cos(a * u + b * v + c) for a, b, c in zip(along_u, along_v, _PHASES, strict=True)],
        axis=0,
    )
    grey = 120.0 + 67.0 * waves / np.sqrt(_N_WAVES)
    return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(SHAPE))


def slanted_pair(
    disparity: float, slopes: tuple[float, float]
) -> tuple[tuple[ImageArray, ImageArray], FloatArray]:
    """Return left and right of a slanted plane, and its disparities at all pixels of the left.

    The disparity is that of the middle; slopes are per pixel, along rows and columns.
    """
    warp = np.array([[1.0 - slopes[0], -slopes[1]], [0.0, 1.0]])
    right = warped_image(warp, np.array([-disparity, 0.0]))
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    offsets = np.stack([u, v], axis=2) - MIDDLE
    return (image(), right), disparity + offsets @ np.array(slopes)
