"""Pinhole and rectified stereo cameras, and the maps that rectify raw images.

Pixel (0, 0) is the centre of the first pixel; x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import cv2
import numpy as np

from gvo.errors import CalibrationError
from gvo.geometry.lens import DistortionModel, Lens, RectificationMaps, bouguet, bouguet_wide
from gvo.geometry.rig import LearntRig
from gvo.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeCamera:
    """A pinhole camera without distortion.

    Parameters
    ----------
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels.
    width, height : int
        Image size, pixels.
    rig : LearntRig, optional
        What was learnt of the camera before; `Odometry` starts from it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    rig: LearntRig | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the intrinsics."""
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(
                "focal lengths must be positive and all values finite, got "
                f"fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}"
            )
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(f"image size must be positive, got {self.width}x{self.height}")

    @property
    def K(self) -> FloatArray:  # noqa: N802 - the field's name
        """The calibration matrix, shape (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_cam: FloatArray) -> FloatArray:
        """Project points in front of the camera.

        Parameters
        ----------
        points_cam : ndarray of float64, shape (..., 3)
            Points in the `cam` frame, metres, with positive depth.

        Returns
        -------
        ndarray of float64, shape (..., 2)
            Pixels (u, v).
        """
        x, y, z = points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]
        u = self.fx * x / z + self.cx
        pixels = np.empty((*u.shape, 2), dtype=u.dtype)
        pixels[..., 0], pixels[..., 1] = u, self.fy * y / z + self.cy
        return pixels

    def is_in_view(self, pixels: FloatArray) -> BoolArray:
        """Tell which pixels (u, v), shape (n, 2), lie within the image; shape (n,)."""
        u, v = pixels.T
        return np.asarray((u >= 0) & (u <= self.width - 1) & (v >= 0) & (v <= self.height - 1))

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Return the rays with unit depth through pixels.

        Parameters
        ----------
        pixels : ndarray of float64, shape (..., 2)
            Pixels (u, v).

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Points of depth one in the `cam` frame.
        """
        x = (pixels[..., 0] - self.cx) / self.fx
        rays = np.ones((*x.shape, 3), dtype=x.dtype)
        rays[..., 0], rays[..., 1] = x, (pixels[..., 1] - self.cy) / self.fy
        return rays


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoCamera(PinholeCamera):
    """A rectified stereo pair, or an RGB-D camera with a virtual baseline.

    Parameters
    ----------
    baseline : float
        Distance of the right camera along the left camera's x axis, metres.

    Attributes
    ----------
    parameters : ndarray of float64, shape (7,)
        The camera as kernels take it: fx, fy, cx, cy, baseline, width, height.

    Examples
    --------
    >>> camera = StereoCamera(fx=700, fy=700, cx=600, cy=180, width=1226, height=370, baseline=0.5)
    >>> float(camera.depth_to_disparity(10.0))
    35.0
    """

    baseline: float
    parameters: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the intrinsics and the baseline."""
        PinholeCamera.__post_init__(self)
        if not np.isfinite(self.baseline) or self.baseline <= 0:
            raise CalibrationError(
                f"the baseline must be positive, got {self.baseline:g} m "
                "(are left and right exchanged?)"
            )
        values = self.fx, self.fy, self.cx, self.cy, self.baseline, self.width, self.height
        parameters = np.array(values, dtype=np.float64)
        parameters.flags.writeable = False
        object.__setattr__(self, "parameters", parameters)

    @classmethod
    def from_pinhole(cls, pinhole: PinholeCamera, baseline: float) -> StereoCamera:
        """Return the stereo camera of this left camera and a baseline in metres."""
        intrinsics = {each.name: getattr(pinhole, each.name) for each in fields(PinholeCamera)}
        return cls(**intrinsics, baseline=baseline)

    def depth_to_disparity(self, depths: FloatArray | float) -> FloatArray:
        """Return the disparity in pixels of depths in metres, any shape."""
        return np.asarray(self.fx * self.baseline / np.asarray(depths))

    def disparity_to_depth(self, disparities: FloatArray | float) -> FloatArray:
        """Return the depth in metres of disparities in pixels, any shape."""
        return np.asarray(self.fx * self.baseline / np.asarray(disparities))

    def project_stereo(self, points_cam: FloatArray) -> FloatArray:
        """Project points to (u, v, disparity).

        Parameters
        ----------
        points_cam : ndarray of float64, shape (..., 3)
            Points in the `cam` frame, metres, with positive depth.

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Pixel in the left image and disparity, pixels.
        """
        disparities = self.depth_to_disparity(points_cam[..., 2])
        return np.concatenate([self.project(points_cam), disparities[..., np.newaxis]], axis=-1)

    def unproject_stereo(self, keypoints: FloatArray, disparities: FloatArray) -> FloatArray:
        """Back-project pixels with disparity into the left camera frame.

        Parameters
        ----------
        keypoints : ndarray of float64, shape (..., 2)
            Pixels (u, v) in the left image.
        disparities : ndarray of float64, shape (...)
            u_left - u_right in pixels, positive.

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Points in the `cam` frame, metres.
        """
        return self.unproject(keypoints) * self.disparity_to_depth(disparities)[..., np.newaxis]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """One camera as `sensor_msgs/CameraInfo` describes it, of the image as recorded.

    Parameters
    ----------
    width, height : int
        Size of the recorded image, pixels: binning and region of interest are applied.
    K : ndarray of float64, shape (3, 3)
        Intrinsics of the raw image, pixels.
    D : ndarray of float64
        Distortion: k1, k2, p1, p2, k3 of `plumb_bob`; 8, 12 or 14 coefficients of
        `rational_polynomial`; k1 to k4 of `equidistant`.
    R : ndarray of float64, shape (3, 3)
        Rotation from the raw camera to the rectified one.
    P : ndarray of float64, shape (3, 4)
        Projection of the rectified image; P[0, 3] = -fx * baseline for a right camera.
    is_rectified : bool
        The images are rectified already: only P counts.
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        What D means.
    doubt : str
        Why the intrinsics seem to be those of images of another size; empty if they do not.
    """

    width: int
    height: int
    K: FloatArray
    D: FloatArray
    R: FloatArray
    P: FloatArray
    is_rectified: bool
    model: DistortionModel = "plumb_bob"
    doubt: str = ""

    @classmethod
    def from_camera(cls, camera: PinholeCamera, *, baseline: float = 0.0) -> Calibration:
        """Describe an ideal camera; with a baseline, the right one of a pair."""
        P = np.hstack([camera.K, [[-camera.fx * baseline], [0.0], [0.0]]])
        return cls(
            width=camera.width,
            height=camera.height,
            K=camera.K,
            D=np.zeros(5),
            R=np.eye(3),
            P=P,
            is_rectified=True,
        )

    @property
    def lens(self) -> Lens:
        """The raw camera."""
        return Lens(width=self.width, height=self.height, K=self.K, D=self.D, model=self.model)

    def pinhole(self) -> PinholeCamera:
        """Return the camera of the rectified image."""
        P = self.P
        return PinholeCamera(
            fx=float(P[0, 0]),
            fy=float(P[1, 1]),
            cx=float(P[0, 2]),
            cy=float(P[1, 2]),
            width=self.width,
            height=self.height,
        )


def stereo_camera(left: Calibration, right: Calibration) -> StereoCamera:
    """Return the rectified stereo camera that two calibrations describe.

    Raises
    ------
    CalibrationError
        When sizes differ, the rectified intrinsics differ, or there is no baseline.
    """
    _check_sizes(left, right)
    if not np.allclose(left.P[:, :3], right.P[:, :3], rtol=1e-6, atol=1e-6):
        raise CalibrationError(
            "left and right are not rectified to one camera: their P differ in the first three "
            "columns; give a calibration of the rectified pair"
        )
    pinhole = left.pinhole()
    return StereoCamera.from_pinhole(pinhole, float(left.P[0, 3] - right.P[0, 3]) / pinhole.fx)


def rectification_maps(calibration: Calibration) -> RectificationMaps | None:
    """Return the maps for `cv2.remap` from the raw to the rectified image.

    Parameters
    ----------
    calibration : Calibration
        Of one camera.

    Returns
    -------
    tuple of two ndarrays of float32, shape (height, width), or None
        u and v in the raw image for each rectified pixel; None if the images are rectified.
    """
    is_identity = (
        calibration.model != "equidistant"  # also without coefficients it is no pinhole
        and not np.any(calibration.D)
        and np.array_equal(calibration.R, np.eye(3))
        and np.array_equal(calibration.K, calibration.P[:, :3])
    )
    if calibration.is_rectified or is_identity:
        return None
    return calibration.lens.maps(calibration.R, calibration.P[:, :3])


def rectify_stereo(
    left: Calibration, right: Calibration, T_left_right: FloatArray
) -> tuple[Calibration, Calibration]:
    """Compute the rectification of a raw pair (Bouguet's algorithm).

    Parameters
    ----------
    left, right : Calibration
        Raw cameras; their R and P are not read.
    T_left_right : ndarray of float64, shape (4, 4)
        Maps coordinates of the right raw camera to the left one, metres.

    Returns
    -------
    tuple of two Calibration
        The same K and D with R and P set. The rectified images have no empty borders; with an
        `equidistant` lens they keep the resolution of the centre and are cropped to their size.

    Raises
    ------
    CalibrationError
        When sizes differ, or the baseline is not along x.
    """
    _check_pair(left, right, T_left_right)
    choose = bouguet_wide if "equidistant" in (left.model, right.model) else bouguet
    try:
        chosen = choose(left.lens, right.lens, np.asarray(np.linalg.inv(T_left_right)))
    except cv2.error as error:
        raise CalibrationError(
            "left and right cannot be rectified: OpenCV finds no projection that fits K and D; "
            "calibrate the pair again"
        ) from error
    return (
        replace(left, R=chosen.R_left, P=chosen.P_left, is_rectified=False),
        replace(right, R=chosen.R_right, P=chosen.P_right, is_rectified=False),
    )


def _check_sizes(left: Calibration, right: Calibration) -> None:
    if (left.width, left.height) != (right.width, right.height):
        raise CalibrationError(
            f"left and right images must be of one size, got {left.width}x{left.height} "
            f"and {right.width}x{right.height}"
        )


def _check_pair(left: Calibration, right: Calibration, T_left_right: FloatArray) -> None:
    _check_sizes(left, right)
    x, y, z = (float(value) for value in T_left_right[:3, 3])
    if not np.hypot(y, z) < abs(x):
        raise CalibrationError(
            f"left and right must stand side by side, got the right camera at x={x:.4g} "
            f"y={y:.4g} z={z:.4g} m of the left one; correct the transform between them"
        )
