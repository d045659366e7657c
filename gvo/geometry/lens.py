"""Lens distortion: projection, undistortion maps, and rectification of stereo pairs.

The models and the order of their coefficients are OpenCV's, which are those of `CameraInfo`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.types import FloatArray

DistortionModel: TypeAlias = Literal["plumb_bob", "rational_polynomial", "equidistant"]

N_COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "plumb_bob": (5,),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
"""Numbers of distortion coefficients: 12 with a thin prism, 14 with a tilted sensor."""

RectificationMaps: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]

_ZOOMS = np.linspace(1.0, 2.0, 101)
_N_BORDER = 33


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lens:
    """A raw camera: a pinhole behind a lens.

    Parameters
    ----------
    width, height : int
        Image size, pixels.
    K : ndarray of float64, shape (3, 3)
        Intrinsics, pixels.
    D : ndarray of float64
        As many coefficients as `N_COEFFICIENTS` says.
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        `equidistant` is the model of Kannala and Brandt with four coefficients.

    References
    ----------
    J. Kannala, S. S. Brandt, "A generic camera model and calibration method for conventional,
    wide-angle, and fish-eye lenses", 2006, doi:10.1109/TPAMI.2006.153
    """

    width: int
    height: int
    K: FloatArray
    D: FloatArray
    model: DistortionModel

    def project(self, points_raw: FloatArray) -> FloatArray:
        """Project points in front of the camera.

        Parameters
        ----------
        points_raw : ndarray of float64, shape (n, 3)
            Points in the frame of the raw camera, metres, with positive depth.

        Returns
        -------
        ndarray of float64, shape (n, 2)
            Pixels (u, v) of the raw image.
        """
        points, zero = np.array(points_raw, dtype=np.float64)[:, np.newaxis], np.zeros(3)
        if self.model == "equidistant":
            pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, self.K, self.D)
        else:
            pixels, _ = cv2.projectPoints(points, zero, zero, self.K, self.D)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def unproject_centre(self) -> FloatArray:
        """Return the ray of depth one through the middle of the raw image, shape (3,)."""
        centre = np.array([[[(self.width - 1) / 2, (self.height - 1) / 2]]])
        if self.model == "equidistant":
            ray = cv2.fisheye.undistortPoints(centre, self.K, self.D)
        else:
            ray = cv2.undistortPoints(centre, self.K, self.D)
        return np.append(np.asarray(ray, dtype=np.float64).ravel(), 1.0)

    def maps(self, R: FloatArray, K_rectified: FloatArray) -> RectificationMaps:
        """Return the undistortion and rectification maps for `cv2.remap`.

        Parameters
        ----------
        R : ndarray of float64, shape (3, 3)
            Rotation from the raw camera to the rectified one.
        K_rectified : ndarray of float64, shape (3, 3)
            Intrinsics of the rectified image, pixels.

        Returns
        -------
        tuple of two ndarrays of float32, shape (height, width)
            u and v in the raw image for each rectified pixel.
        """
        size = (self.width, self.height)
        make = cv2.initUndistortRectifyMap
        if self.model == "equidistant":
            make = cast(Any, cv2.fisheye.initUndistortRectifyMap)
        map_u, map_v = make(self.K, self.D, R, K_rectified, size, cv2.CV_32FC1)
        return np.asarray(map_u, dtype=np.float32), np.asarray(map_v, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectification:
    """Rotations and projections that make the epipolar lines of a raw pair rows.

    Parameters
    ----------
    R_left, R_right : ndarray of float64, shape (3, 3)
        Rotations from the raw cameras to the rectified ones.
    P_left, P_right : ndarray of float64, shape (3, 4)
        Projections of the rectified images, pixels; P_right[0, 3] = -fx * baseline.
    """

    R_left: FloatArray
    R_right: FloatArray
    P_left: FloatArray
    P_right: FloatArray


def bouguet(left: Lens, right: Lens, T_right_left: FloatArray) -> Rectification:
    """Rectify a pair by OpenCV's version of Bouguet's algorithm, without empty borders.

    Parameters
    ----------
    left, right : Lens
        Of one size; not `equidistant`.
    T_right_left : ndarray of float64, shape (4, 4)
        Maps coordinates of the left raw camera to the right one, metres.
    """
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        left.K,
        left.D,
        right.K,
        right.D,
        (left.width, left.height),
        T_right_left[:3, :3],
        T_right_left[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return Rectification(
        R_left=np.asarray(R_left),
        R_right=np.asarray(R_right),
        P_left=np.asarray(P_left),
        P_right=np.asarray(P_right),
    )


def bouguet_wide(left: Lens, right: Lens, T_right_left: FloatArray) -> Rectification:
    """Rectify a pair of wide lenses by Bouguet's rotations, at the resolution of the centre.

    A plane image cannot hold the whole view of a fisheye: the focal length is that of the raw
    centre, or up to twice as long if that removes the empty borders.

    Parameters
    ----------
    left, right : Lens
        Of one size, of any model.
    T_right_left : ndarray of float64, shape (4, 4)
        Maps coordinates of the left raw camera to the right one, metres.
    """
    R_left, R_right = _common_rotations(T_right_left)
    views = ((left, R_left), (right, R_right))
    centres = [R @ lens.unproject_centre() for lens, R in views]
    centre = np.mean([ray[:2] / ray[2] for ray in centres], axis=0)
    focal = min(lens.K[axis, axis] for lens, _ in views for axis in (0, 1))
    candidates = [_looking_at(centre, zoom * focal, left) for zoom in _ZOOMS]
    is_full = (all(_is_full(lens, R, K) for lens, R in views) for K in candidates)
    K = next((K for K, full in zip(candidates, is_full, strict=True) if full), candidates[0])
    t_rectified = R_right @ T_right_left[:3, 3]
    return Rectification(
        R_left=R_left,
        R_right=R_right,
        P_left=np.hstack([K, np.zeros((3, 1))]),
        P_right=np.hstack([K, [[K[0, 0] * t_rectified[0]], [0.0], [0.0]]]),
    )


def _common_rotations(T_right_left: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Split the relative rotation in half, then turn x onto the baseline."""
    half = Rotation.from_matrix(T_right_left[:3, :3]).as_rotvec() / 2
    R_half_left = Rotation.from_rotvec(half)
    t = Rotation.from_rotvec(-half).apply(T_right_left[:3, 3])
    x_axis = np.array([np.copysign(1.0, t[0]), 0.0, 0.0])
    axis = np.cross(t, x_axis)
    sine, cosine = float(np.linalg.norm(axis)), float(t @ x_axis)
    turn = axis * (np.arctan2(sine, cosine) / sine if sine > 0 else 0.0)
    R_common = Rotation.from_rotvec(turn)
    return (
        np.asarray((R_common * R_half_left).as_matrix()),
        np.asarray((R_common * Rotation.from_rotvec(-half)).as_matrix()),
    )


def _looking_at(centre: FloatArray, focal: float, lens: Lens) -> FloatArray:
    """Return intrinsics whose principal ray passes through a point at depth one."""
    cx = (lens.width - 1) / 2 - focal * centre[0]
    cy = (lens.height - 1) / 2 - focal * centre[1]
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def _is_full(lens: Lens, R: FloatArray, K_rectified: FloatArray) -> bool:
    """Tell whether the border of the rectified image lies inside the raw one."""
    u = np.linspace(0.0, lens.width - 1.0, _N_BORDER)
    v = np.linspace(0.0, lens.height - 1.0, _N_BORDER)
    border = np.vstack(
        [
            *(np.stack([u, np.full_like(u, row)], axis=1) for row in (v[0], v[-1])),
            *(np.stack([np.full_like(v, column), v], axis=1) for column in (u[0], u[-1])),
        ]
    )
    rays = np.linalg.solve(K_rectified, np.hstack([border, np.ones((len(border), 1))]).T)
    points_raw = (R.T @ rays).T
    if np.any(points_raw[:, 2] <= 0):
        return False
    pixels = lens.project(points_raw)
    return bool(np.all((pixels >= 0) & (pixels <= [lens.width - 1, lens.height - 1])))
