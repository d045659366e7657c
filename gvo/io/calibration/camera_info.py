"""CameraInfo, and stereo pairs of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from gvo._text import MAX_SHOWN, cut, shortened
from gvo.errors import CalibrationError, named_faults
from gvo.geometry import se3
from gvo.geometry.camera import Calibration, rectify_stereo, stereo_camera
from gvo.geometry.lens import N_COEFFICIENTS, DistortionModel
from gvo.io.images import MAX_PIXELS
from gvo.types import FloatArray

_LARGEST_NUMBER = 1e9
MAX_SIDE_PX = 32767
"""Largest width or height of an image, pixels: what OpenCV rectifies."""
ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R R^T from the identity that is the rounding of a file."""
# As systems and drivers call them, in lower case, words joined by _.
_MODELS: dict[str, DistortionModel] = {
    **dict.fromkeys(("plumb_bob", "radtan", "radial_tangential", "brown_conrady"), "plumb_bob"),
    **dict.fromkeys(("radialtangential", "pinhole", "perspective", "rectified"), "plumb_bob"),
    **dict.fromkeys(("rational_polynomial", "pinhole_full"), "rational_polynomial"),
    **dict.fromkeys(("equidistant", "fisheye", "kannalabrandt8"), "equidistant"),
    **dict.fromkeys(("kannala_brandt", "kannala_brandt4"), "equidistant"),
}
_MAX_ANGLE_RAD = 1e-3
# How far the baseline of rectified cameras may lean, by the rounding of tf, as a tangent.
_MAX_SLOPE = 0.01
# Of an image that K fits: its sides over those of the image it is given for, which a principal
# point up to a tenth off the centre changes. And the half width of the view that K then gives, as a
# tangent: 2 x 39 and 2 x 35 degrees. A cut image has a narrow view, not a wide one.
_LEAST_LARGER, _WIDEST_LARGER = 1.4, 0.8
_MOST_SMALLER, _NARROWEST_SMALLER = 0.6, 0.7
_MAX_FACTOR, _EVEN = 10.0, 1.15
# Up to here two cameras are one: what is left moves no pixel by a tenth.
_ALIKE = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionOfInterest:
    """The part of the full image that was recorded, in its pixels before binning; width 0: all."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFields:
    """What a `CameraInfo` says, as it stands there.

    Parameters
    ----------
    where : str
        File or topic, for messages.
    width, height : int
        Size of the full image, pixels.
    model : str
        Distortion model.
    K, D, R, P : array_like of float
        9, 0 to 14, 9 and 12 numbers; R and P of zeros mean "not set". K and P are of the full
        image.
    binning : tuple of two ints
        How many columns and rows became one after the region was cut out; 0 means 1.
    roi : RegionOfInterest
        What was cut out.
    frame_id : str
        Of the camera in `/tf`, without a leading slash; empty where not known.
    is_distorted_by_zeros : bool
        D of zeros is meant: for `equidistant` no pinhole. Otherwise it says "no distortion".
    """

    where: str
    width: int
    height: int
    model: str
    K: ArrayLike
    D: ArrayLike
    R: ArrayLike
    P: ArrayLike
    binning: tuple[int, int] = (1, 1)
    roi: RegionOfInterest = RegionOfInterest()
    frame_id: str = ""
    is_distorted_by_zeros: bool = False

    @property
    def binning_factors(self) -> tuple[int, int]:
        """Columns and rows of the full image that became one."""
        return max(self.binning[0], 1), max(self.binning[1], 1)

    def recorded_size(self) -> tuple[int, int]:
        """Return width and height of the image as recorded, after region and binning."""
        roi = self.roi
        width = roi.width or self.width - roi.x_offset
        height = roi.height or self.height - roi.y_offset
        is_inside = roi.x_offset + width <= self.width and roi.y_offset + height <= self.height
        if (self.width > 0 and self.height > 0 and not is_inside) or min(width, height) < 0:
            raise CalibrationError(
                f"{self.where}: the region of {width}x{height} px at ({roi.x_offset}, "
                f"{roi.y_offset}) lies outside the full image of {self.width}x{self.height} px; "
                "mend roi, or give --calibration FILE of the images as recorded"
            )
        binning_x, binning_y = self.binning_factors
        return width // binning_x, height // binning_y


def make_calibration(fields: CameraFields, *, is_rectified: bool) -> Calibration:
    """Check the fields of a `CameraInfo` and return the calibration of the recorded image.

    Binning and region move K and P alike, by the raw region, as ROS's `PinholeCameraModel` does
    it; `do_rectify` does not matter there either. Of rectified images only P counts.
    """
    K, R, P = _matrices(fields)
    doubt = _doubt("P", P, fields)
    if not is_rectified or np.array_equal(K, P[:, :3]):
        doubt = _doubt("K", K, fields) or doubt
    model, D = _distortion(fields, is_rectified=is_rectified)
    width, height = fields.recorded_size()
    binning, roi = fields.binning_factors, fields.roi
    if binning != (1, 1) or (roi.x_offset, roi.y_offset) != (0, 0):
        scale = np.diag([1 / binning[0], 1 / binning[1], 1.0])
        shift = np.array([[1.0, 0.0, -roi.x_offset], [0.0, 1.0, -roi.y_offset], [0.0, 0.0, 1.0]])
        K, P = scale @ shift @ K, scale @ shift @ P
    calibration = Calibration(
        width=width, height=height, K=K, D=D, R=R, P=P, is_rectified=is_rectified, model=model
    )
    check_camera(calibration, fields.where)
    return replace(calibration, doubt=doubt)


def make_rgbd_calibration(fields: CameraFields, *, is_rectified: bool) -> Calibration:
    """Check the fields of an RGB-D camera's `CameraInfo` and return the calibration.

    Depth is measured along the axis of the raw camera: where R turns the camera, the depth of a
    pixel would have to change with it, so that R of raw images must be the identity.
    """
    calibration = make_calibration(fields, is_rectified=is_rectified)
    if not is_rectified and not np.allclose(calibration.R, np.eye(3), atol=ROTATION_TOLERANCE):
        raise CalibrationError(
            f"{fields.where}: R turns the camera, and depth cannot be turned with it: expected the "
            "identity for an RGB-D camera; give rectified images or a calibration without R"
        )
    return calibration


def _doubt(name: str, K: FloatArray, fields: CameraFields) -> str:
    """Say which images K or P fits, where its principal point is far from the centre of these.

    What is cut out of an image has it elsewhere, too, but seldom by such a share of both sides.
    """
    size = np.array([max(fields.width, 1), max(fields.height, 1)])
    shares = (2.0 * K[:2, 2] + 1.0) / size
    low, high = float(np.min(shares)), float(np.max(shares))
    half_view = size[0] / (2.0 * max(K[0, 0], 1.0))
    is_larger = low >= _LEAST_LARGER and half_view <= _WIDEST_LARGER
    is_smaller = high <= _MOST_SMALLER and half_view >= _NARROWEST_SMALLER
    if not (is_larger or is_smaller) or not 1.0 / _MAX_FACTOR <= low <= high <= _MAX_FACTOR:
        return ""
    share = float(np.sqrt(low * high))
    ratio = float(Fraction(max(share, 1.0 / share)).limit_denominator(2))
    factor = ratio if share < 1.0 else 1.0 / ratio
    is_even = high <= _EVEN * low
    width, height = np.rint(size / factor if is_even else size * shares).astype(int)
    what = "image" if fields.binning_factors == (1, 1) else "image before binning"
    return (
        f"{name} fits an image of {width}x{height}, the {what} is {size[0]}x{size[1]}"
        f"{f': factor {factor:.3g}' if is_even else ''}"
    )


def check_camera(calibration: Calibration, where: str) -> None:
    """Check the size and the intrinsics of a rectified camera; messages begin with `where`."""
    width, height = calibration.width, calibration.height
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS:
        raise CalibrationError(
            f"{where}: the image size must be at most {MAX_SIDE_PX} px a side and "
            f"{MAX_PIXELS // 10**6} megapixels, got {width}x{height}; mend the calibration"
        )
    with named_faults(CalibrationError, where, others=(CalibrationError,)):
        calibration.pinhole()


def _matrices(fields: CameraFields) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return K, R and P of the full image, checked; for those not set what they then mean."""
    where = fields.where
    K = read_array(fields.K, (3, 3), f"{where}: K")
    P = read_array(fields.P, (3, 4), f"{where}: P")
    R = read_array(fields.R, (3, 3), f"{where}: R")
    if not np.any(K):
        K = P[:, :3].copy()
    if not np.any(K):
        raise CalibrationError(
            f"{where}: the camera is not calibrated: K and P are zero; give --calibration FILE"
        )
    if not np.any(P):
        P = np.hstack([K, np.zeros((3, 1))])
    if not np.any(R):
        R = np.eye(3)
    _check_matrices(K, R, P, where)
    return K, R, P


def _check_matrices(K: FloatArray, R: FloatArray, P: FloatArray, where: str) -> None:
    if not se3.is_rotation(R, tolerance=ROTATION_TOLERANCE):
        raise CalibrationError(f"{where}: R is not a rotation")
    for name, matrix in (("K", K), ("P", P)):
        if not np.allclose(matrix[2, :3], [0.0, 0.0, 1.0], atol=1e-6):
            raise CalibrationError(
                f"{where}: the third row of {name} must begin with 0 0 1, got "
                f"{' '.join(f'{value:g}' for value in matrix[2, :3])}"
            )
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise CalibrationError(
            f"{where}: focal lengths must be positive, got K with fx={K[0, 0]:g} fy={K[1, 1]:g}"
        )


def read_array(values: object, shape: tuple[int, ...], what: str) -> FloatArray:
    """Read so many numbers as an array, in rows."""
    numbers, n_expected = read_numbers(values, what), int(np.prod(shape))
    if numbers.size != n_expected:
        raise CalibrationError(f"{what} must hold {n_expected} numbers, got {numbers.size}")
    return numbers.reshape(shape)


def _distortion(fields: CameraFields, *, is_rectified: bool) -> tuple[DistortionModel, FloatArray]:
    D = read_numbers(fields.D, f"{fields.where}: D")
    is_meant = fields.is_distorted_by_zeros and known_model(fields.model) == "equidistant"
    if is_rectified or not (np.any(D) or is_meant):
        return "plumb_bob", np.zeros(5)
    model = supported_model(fields.model, fields.where)
    if model == "plumb_bob" and D.size > 5:
        model = "rational_polynomial"  # OpenCV goes by the count alone, and ROS with it
    counts = {4, 5, *N_COEFFICIENTS[model]} if model != "equidistant" else {4}
    if model == "equidistant" and not np.any(D[4:]):
        D = D[:4]
    if D.size not in counts:
        raise CalibrationError(
            f"{fields.where}: D of {cut(' '.join(fields.model.split()), MAX_SHOWN)} must hold "
            f"{' or '.join(map(str, sorted(counts)))} numbers, got {D.size}"
        )
    n_missing = max(N_COEFFICIENTS[model][0] - D.size, 0)
    return model, np.concatenate([D, np.zeros(n_missing)])


def supported_model(name: str, where: str) -> DistortionModel:
    """Return the model that a system calls so; refuse others."""
    model = known_model(name)
    if model is None:
        raise CalibrationError(
            f"{where}: model {shortened(name)} is not supported, expected plumb_bob "
            "(pinhole, radtan), rational_polynomial or equidistant (fisheye, Kannala-Brandt); "
            "rectify the images first"
        )
    return model


def known_model(name: str) -> DistortionModel | None:
    """Return the model that a system calls so; None if it is not supported."""
    return _MODELS.get("_".join(name.lower().replace("-", " ").split()))


def read_numbers(values: object, what: str) -> FloatArray:
    """Read numbers, nested or not, as a flat array; texts too, as YAML reads `1e-5`."""
    try:
        numbers = np.array(cast(ArrayLike, values), dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{what} must hold numbers, got {shortened(values)}") from error
    if not np.all(np.isfinite(numbers)):
        raise CalibrationError(f"{what} holds a value that is not finite")
    if np.any(np.abs(numbers) > _LARGEST_NUMBER):
        raise CalibrationError(f"{what} holds {np.abs(numbers).max():g}, which no camera has")
    return numbers


def has_baseline(left: Calibration, right: Calibration) -> bool:
    """Tell whether the P of a pair, rectified or not, say how far apart the cameras are."""
    return bool(left.P[0, 3] != right.P[0, 3])


def stereo_baseline(calibrations: tuple[Calibration, Calibration], where: str) -> float:
    """Return the baseline of a rectified pair in metres; refuse other pairs."""
    left, right = calibrations
    if (left.width, left.height) == (right.width, right.height) and not has_baseline(left, right):
        raise CalibrationError(
            f"{where}: the baseline must be positive, got none: expected -fx * baseline as the "
            "fourth number of P of the right camera, or the transform between the cameras (tf, "
            "T_cn_cnm1, T_BS); give --calibration FILE that holds either"
        )
    with named_faults(CalibrationError, where, others=(CalibrationError,)):
        return stereo_camera(left, right).baseline


def pair_of_extrinsics(
    raw: tuple[Calibration, Calibration], T_left_right: FloatArray, where: str
) -> tuple[Calibration, Calibration]:
    """Rectify a pair of raw cameras by the transform between them, metres.

    The pair is taken as rectified already where the cameras are alike, without distortion and
    side by side; otherwise R and P are those of `rectify_stereo`.
    """
    left, right = raw
    if _is_rectified_pair(left, right, T_left_right):
        baseline = float(T_left_right[0, 3])
        pair = _without_lens(left, left.K, 0.0), _without_lens(right, left.K, baseline)
    else:
        with named_faults(CalibrationError, where, others=(CalibrationError,)):
            pair = rectify_stereo(left, right, T_left_right)
    for calibration in pair:
        check_camera(calibration, where)
    return pair


def pair_of_baseline(
    rectified: tuple[Calibration, Calibration], T_left_right: FloatArray, where: str
) -> tuple[Calibration, Calibration]:
    """Set the baseline of a rectified pair by the transform between the cameras, metres.

    Refuse more than a shift to the side, as it must be between rectified cameras.
    """
    left, right = rectified
    x, y, z = (float(value) for value in T_left_right[:3, 3])
    angle = float(np.linalg.norm(Rotation.from_matrix(T_left_right[:3, :3]).as_rotvec()))
    if angle > _MAX_ANGLE_RAD or np.hypot(y, z) > _MAX_SLOPE * abs(x):
        raise CalibrationError(
            f"{where}: expected rectified cameras side by side, got the right one turned by "
            f"{np.degrees(angle):.2f} deg at x={x:.4g} y={y:.4g} z={z:.4g} m of the left one; "
            "give --calibration FILE"
        )
    P = right.P.copy()
    P[0, 3] = left.P[0, 3] - P[0, 0] * x
    return left, replace(right, P=P)


def _is_rectified_pair(left: Calibration, right: Calibration, T_left_right: FloatArray) -> bool:
    x, y, z = T_left_right[:3, 3]
    is_pinhole = all(each.model != "equidistant" and not np.any(each.D) for each in (left, right))
    return bool(
        is_pinhole
        and (left.width, left.height) == (right.width, right.height)
        and np.allclose(left.K, right.K, rtol=_ALIKE, atol=0.0)
        and np.allclose(T_left_right[:3, :3], np.eye(3), rtol=0.0, atol=_ALIKE)
        and np.hypot(y, z) <= _ALIKE * abs(x)
    )


def _without_lens(raw: Calibration, K: FloatArray, baseline: float) -> Calibration:
    P = np.hstack([K, [[-K[0, 0] * baseline], [0.0], [0.0]]])
    return replace(raw, R=np.eye(3), P=P, is_rectified=True)
