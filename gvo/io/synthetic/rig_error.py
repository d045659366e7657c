"""Images of a rig that is not what its calibration says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.types import DepthArray, FloatArray

# Constants with their size relative to that of the others, and the powers of x and y that they are
# seen with at the border: of all cameras, of stereo cameras besides, and others.
_COMMON = {
    **{"d0": (0.3, 0, 0), "dx": (1.0, 1, 0), "dy": (1.0, 0, 1)},
    **{"dxx": (1.0, 2, 0), "dxy": (1.0, 1, 1), "dyy": (1.0, 0, 2)},
    **{"k1": (2.0, 3, 0), "f": (3.0, 1, 0), "baseline": (1.0, 0, 0)},
}
_STEREO = {
    **{"tx": (1.0, 2, 0), "ty": (1.0, 1, 1), "p1": (1.0, 2, 0), "p2": (1.0 / 3.0, 2, 0)},
    **{"r0": (1.0, 0, 0), "rx": (1.0, 1, 0), "ry": (1.0, 0, 1)},
    **{"rxx": (1.0, 2, 0), "rxy": (1.0, 1, 1), "ryy": (1.0, 0, 2)},
}
_OTHERS = {
    **{"k2": (1.0, 5, 0), "k1_right": (1.0, 3, 0), "cx": (1.0, 0, 0)},
    **{"skew": (1.0, 0, 1), "aspect": (1.0, 0, 1), "ddx": (1.0, 1, 0), "ddy": (1.0, 0, 1)},
}
_PIXELS = "d0", "r0", "cx"
_RATIOS = "baseline", "ddx", "ddy"
_Fields: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigError:
    """What the calibration of a rig does not know: it is that of an ideal rig.

    Constants change (u, v, disparity) smoothly; x, y, D are the same less the principal point, over
    the focal length f; and r^2 = x^2 + y^2. In pixels: d0, cx, r0. Times f: dx, dy, dxx, dxy, dyy,
    of the disparity, times x, y, x^2, x y, y^2; rx ... ryy the same of rows in the right image; of
    both lenses f (x, y), skew (y, 0), aspect (0, y), k1 r^2 (x, y), k2 r^4 (x, y), tx x (x, y),
    ty y (x, y), p1 (2 x y, r^2 + 2 y^2), p2 (r^2 + 2 x^2, 2 x y); k1_right of the right one alone;
    and of the disparity baseline D, ddx x D, ddy y D.

    Parameters
    ----------
    size_px : float
        Standard deviation of what is drawn, of each constant: pixels at the middle of the left
        border (of the upper one, or in the corner, where it vanishes there), for those of the
        disparity that grow with it per cent per pixel.
    seed : int
        Of the draws.
    others : bool
        Draw k2, cx, skew, aspect, k1_right, ddx and ddy, too.
    constants : mapping of str to float
        Constants that are known, in place of draws; with `size_px` 0 the only ones.

    Raises
    ------
    ValueError
        For an unknown constant.
    """

    size_px: float = 0.0
    seed: int = 0
    others: bool = False
    constants: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse unknown constants."""
        if unknown := {*self.constants} - {*_COMMON, *_STEREO, *_OTHERS}:
            raise ValueError(f"unknown constants of a rig: {sorted(unknown)}")

    def draw(self, camera: PinholeCamera, *, is_stereo: bool) -> dict[str, float]:
        """Return the constants of a rig, in the units of the fields of measurements."""
        drawn, rng = {}, np.random.default_rng(self.seed)
        f, x, y = camera.fx, camera.width / 2 / camera.fx, camera.height / 2 / camera.fx
        chosen = _COMMON | (_STEREO if is_stereo else {}) | (_OTHERS if self.others else {})
        for name, (share, of_x, of_y) in chosen.items():
            unit = 1.0 if name in _PIXELS else 0.01 if name in _RATIOS else 1.0 / f
            size = share * self.size_px * unit / (x**of_x * y**of_y)
            drawn[name] = size * rng.standard_normal()
        return drawn | {**self.constants}


@dataclass(frozen=True, slots=True)
class BentRig:
    """A rig with such errors, which bend its images.

    Parameters
    ----------
    camera : PinholeCamera
        The ideal one, of all images.
    baseline_m : float
        Metres.
    constants : mapping of str to float
        See `RigError`.
    """

    camera: PinholeCamera
    baseline_m: float
    constants: Mapping[str, float]

    def bend(self, image: DepthArray, depth: DepthArray | None) -> DepthArray:
        """Return a left image as this rig shows it, or with the depth of its pixels a right one."""
        u, v = _pixels(image)
        du, dv = self._of_lens(u, v, k1=self._of("k1_right") if depth is not None else 0.0)
        if depth is not None:
            inverse_depth = np.asarray(np.nan_to_num(1.0 / depth), dtype=np.float64)
            disparity = self.camera.fx * self.baseline_m * inverse_depth
            du -= self._of_disparity(u + disparity, v, disparity)
            dv += self._polynomial("r", u + disparity, v)
        return _moved(image, u - du, v - dv, cv2.INTER_LANCZOS4)

    def bend_depth(self, depth: DepthArray) -> DepthArray:
        """Return a depth image, registered to the colour image, as this rig shows it."""
        u, v = _pixels(depth)
        du, dv = self._of_lens(u, v)
        moved = _moved(depth, u - du, v - dv, cv2.INTER_NEAREST)
        disparity = np.asarray(self.camera.fx * self.baseline_m / moved, dtype=np.float64)
        error = self._of_disparity(u, v, disparity)
        return np.asarray(moved / (1.0 + error / disparity), dtype=np.float32)

    def _of(self, name: str) -> float:
        return self.constants.get(name, 0.0)

    def _polynomial(self, of: str, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return that of the disparity (d) or of the rows (r), pixels."""
        x, y = self._rays(u, v)
        c0, cx, cy, cxx, cxy, cyy = (
            self._of(of + power) for power in ("0", "x", "y", "xx", "xy", "yy")
        )
        return c0 + self.camera.fx * (cx * x + cy * y + cxx * x * x + cxy * x * y + cyy * y * y)

    def _of_disparity(self, u: FloatArray, v: FloatArray, disparity: FloatArray) -> FloatArray:
        """Return by how much disparities at pixels of the left image are too large, pixels."""
        x, y = self._rays(u, v)
        ratio = self._of("baseline") + self._of("ddx") * x + self._of("ddy") * y
        return self._polynomial("d", u, v) + ratio * disparity

    def _of_lens(self, u: FloatArray, v: FloatArray, *, k1: float = 0.0) -> _Fields:
        """Return by how much u and v are too large, pixels; a right lens may have k1 besides."""
        x, y = self._rays(u, v)
        r2, f, tilt = x * x + y * y, self.camera.fx, self._of("tx") * x + self._of("ty") * y
        along_ray = self._of("f") + (self._of("k1") + k1 + self._of("k2") * r2) * r2 + tilt
        p1, p2 = self._of("p1"), self._of("p2")
        along = along_ray * x + self._of("skew") * y + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        across = along_ray * y + self._of("aspect") * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return f * along + self._of("cx"), f * across

    def _rays(self, u: FloatArray, v: FloatArray) -> _Fields:
        return (u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fx


def _pixels(image: DepthArray) -> _Fields:
    """Return the columns and rows of all pixels."""
    height, width = image.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return u, v


def _moved(image: DepthArray, u: FloatArray, v: FloatArray, interpolation: int) -> DepthArray:
    """Return an image whose pixels come from other places; the border is continued."""
    places, border = (u.astype(np.float32), v.astype(np.float32)), cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, *places, interpolation, borderMode=border), np.float32)
