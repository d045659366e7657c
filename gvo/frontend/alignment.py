"""Patches of a reference aligned with another image, seen there through the predicted motion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.frontend.stereo.patches import cut_patches, steps_around
from gvo.geometry.camera import StereoCamera
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Half size of the patches.
RADIUS_PX = 4
# Variance of a gradient that is noise, grey values squared: keeps flat patches from dividing by
# nothing.
_NOISE = 1.0
# Distance to a plane, as a share of the source's, below which the target is at it or behind it; and
# the steepest slope that a surface has in the target.
_MIN_DISTANCE = 0.05
_MAX_SLOPE = 0.75
# A step of the alignment moves a patch by at most so much; it is at rest below so much.
_MAX_STEP_PX = 1.0
_MAX_LAST_STEP_PX = 0.2
# Largest variance of the difference of matching patches: a share of the patch's variance, plus the
# noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.5
_UNLIKE_NOISE = 25.0


def patch_warps(
    uvd: FloatArray, slopes: FloatArray, T_target_source: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return by how much patches of surfaces are turned, stretched and sheared by a motion.

    The surface at a pixel is a plane: its inverse depth is linear in the pixel. Then a pixel x,
    in coordinates of the ray, goes to R x + t (n . x), divided by its third component.

    Parameters
    ----------
    uvd : ndarray of float64, shape (n, 3)
        Pixels of the source and their disparities.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparity per pixel, along rows and columns; zero where a surface faces the
        camera.
    T_target_source : ndarray of float64, shape (4, 4)
        Motion, metres.
    camera : StereoCamera
        Of both.

    Returns
    -------
    ndarray of float64, shape (n, 2, 2)
        Derivative of the target's pixel (u, v) by the source's.
    """
    f = np.array([camera.fx, camera.fy])
    rays = np.ones((len(uvd), 3))
    rays[:, :2] = (uvd[:, :2] - [camera.cx, camera.cy]) / f
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    inverse_depths = uvd[:, 2] / (camera.fx * camera.baseline)
    points = rays @ R.T + inverse_depths[:, np.newaxis] * t
    inverse_slopes = slopes / (camera.fx * camera.baseline)
    # Of the points by the pixels, shape (n, 3, 2).
    derivatives = R[:, :2] / f + t[:, np.newaxis] * inverse_slopes[:, np.newaxis]
    z = points[:, 2, np.newaxis, np.newaxis]
    directions = points[:, :2, np.newaxis] / z
    warps = (derivatives[:, :2] - directions * derivatives[:, 2:]) / z
    return np.asarray(warps * f[:, np.newaxis])


def move_slopes(
    uvd: FloatArray, slopes: FloatArray, T_target_source: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return the slopes of the disparities of surfaces in the target's image, shape (n, 2).

    A plane n . p = 1, whose inverse depth is n . x for a ray x, becomes R n / (1 + t . R n).

    Parameters
    ----------
    uvd : ndarray of float64, shape (n, 3)
        Pixels of the source and their disparities.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparity per pixel in the source, along rows and columns.
    T_target_source : ndarray of float64, shape (4, 4)
        Motion, metres.
    camera : StereoCamera
        Of both.
    """
    scales = np.array([1.0, camera.fy / camera.fx]) / camera.baseline
    rays = (uvd[:, :2] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    normals = np.empty((len(uvd), 3))
    normals[:, :2] = slopes * scales
    inverse_depths = uvd[:, 2] / (camera.fx * camera.baseline)
    normals[:, 2] = inverse_depths - np.einsum("ni,ni->n", normals[:, :2], rays)
    normals = normals @ T_target_source[:3, :3].T
    distances = 1.0 + normals @ T_target_source[:3, 3]
    moved = normals[:, :2] / np.maximum(distances, _MIN_DISTANCE)[:, np.newaxis]
    return np.clip(moved / scales, -_MAX_SLOPE, _MAX_SLOPE)


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Square patches of a reference image, prepared for inverse compositional alignment.

    Gradients and Hessian are those of the reference, computed once. Means are subtracted, so that
    a difference of exposure has no effect.

    Parameters
    ----------
    values : ndarray of float32, shape (n, s * s)
        Grey values less their mean.
    gradients : ndarray of float32, shape (n, 2, s * s)
        Along rows and columns.
    inverses : ndarray of float32, shape (n, 2, 2)
        Inverse Hessians.

    References
    ----------
    S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd.
    """

    values: NDArray[np.float32]
    gradients: NDArray[np.float32]
    inverses: NDArray[np.float32]

    @classmethod
    def of(cls, image: ImageArray, pixels: FloatArray) -> Templates:
        """Cut patches around whole pixels, shape (n, 2), out of an image."""
        return cls.of_patches(cut_patches(image, pixels, RADIUS_PX + 1))

    @classmethod
    def of_patches(cls, patches: NDArray[np.uint8]) -> Templates:
        """Prepare patches (n, 11, 11), which are one pixel wider on all sides."""
        n, size = len(patches), 2 * RADIUS_PX + 1
        wide = patches.astype(np.float32)
        along = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2])
        across = 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1])
        gradients = np.stack([along, across], axis=1).reshape(n, 2, size * size)
        gradients -= gradients.mean(axis=2, keepdims=True)
        values = wide[:, 1:-1, 1:-1].reshape(n, size * size)
        hessians = np.matmul(gradients, np.swapaxes(gradients, 1, 2)) + _NOISE * np.eye(2)
        return cls(
            values=values - values.mean(axis=1, keepdims=True),
            gradients=gradients,
            inverses=np.linalg.inv(hessians).astype(np.float32),
        )

    def take(self, chosen: IntArray) -> Templates:
        """Select patches by index."""
        return Templates(self.values[chosen], self.gradients[chosen], self.inverses[chosen])

    def align(
        self, image: ImageArray, start: FloatArray, warps: FloatArray, *, n_steps: int
    ) -> tuple[FloatArray, BoolArray]:
        """Find the patches in another image, near the start.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
        start : ndarray of float64, shape (n, 2)
            Pixels (u, v).
        warps : ndarray of float64, shape (n, 2, 2)
            See `patch_warps`.
        n_steps : int
            At least one.

        Returns
        -------
        pixels : ndarray of float64, shape (n, 2)
        is_found : ndarray of bool, shape (n,)
            False where the search does not come to rest, or what it finds is unlike the patch.
        """
        pixels = start.copy()
        for _ in range(n_steps):
            seen = sample_warped(image, pixels, warps)
            seen -= seen.mean(axis=1, keepdims=True)
            seen -= self.values
            slopes = np.matmul(self.gradients, seen[:, :, np.newaxis])
            steps = np.matmul(self.inverses, slopes)
            clipped = np.clip(steps, -_MAX_STEP_PX, _MAX_STEP_PX)
            moves = np.matmul(warps, clipped)[:, :, 0]
            pixels -= moves
        # What the last step explains of the difference is gone.
        n_pixels = self.values.shape[1]
        left = np.einsum("ni,ni->n", seen, seen) - np.einsum("nij,nij->n", slopes, steps)
        variances = np.einsum("ni,ni->n", self.values, self.values) / n_pixels
        are_alike = left / n_pixels <= _MAX_UNLIKE * variances + _UNLIKE_NOISE
        return pixels, are_alike & (np.hypot(*moves.T) < _MAX_LAST_STEP_PX)


def sample_warped(image: ImageArray, pixels: FloatArray, warps: FloatArray) -> NDArray[np.float32]:
    """Return warped patches around pixels, shape (n, s * s), interpolated."""
    if len(pixels) == 0:  # refused by OpenCV
        return np.zeros((0, (2 * RADIUS_PX + 1) ** 2), dtype=np.float32)
    places = np.matmul(warps.astype(np.float32), steps_around(RADIUS_PX, RADIUS_PX))
    places += pixels.astype(np.float32)[:, :, np.newaxis]
    seen = cv2.remap(
        image, places[:, 0], places[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return seen.astype(np.float32)
