"""ROS messages of images, calibrations and transforms, decoded."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import cut
from gvo.config import ImagesConfig
from gvo.geometry import se3
from gvo.io.bag.image_encodings import (
    BAYER,
    DEPTHS,
    IMAGES,
    convert_to_bgr,
    decode_rvl,
    find_encoding,
    stored_pixels,
)
from gvo.io.calibration.camera_info import CameraFields, RegionOfInterest
from gvo.io.images import decode_image, depth_from_counts, depth_from_metres, to_8_bit
from gvo.io.png import is_png
from gvo.trajectory.formats import MAX_POSITION_M
from gvo.types import DepthArray, Failure, FloatArray, ImageArray

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_humble as ros

    from gvo.io.bag.reader import BagMessage

_FULL_RANGE = ImagesConfig()
_NORM_TOLERANCE = 1e-2  # of quaternions
# After the number of ROS 1, or the encoding of CDR, of four bytes.
_STAMP_END = 12
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")


def stamp_of(header: ros.std_msgs__msg__Header) -> int:
    """Return the stamp of a header of ROS 1 or ROS 2 in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def header_stamp(message: BagMessage) -> int | None:
    """Return the stamp at the start of a message that cannot be decoded; None if it is none."""
    if len(message.data) < _STAMP_END:
        return None
    is_little = message.topic.is_ros1 or message.data[1] & 1
    seconds, nanoseconds = struct.unpack_from("<iI" if is_little else ">iI", message.data, 4)
    return None if nanoseconds >= 10**9 else int(seconds * 10**9 + nanoseconds)


def bare(name: str) -> str:
    """Return the name of a frame without a leading slash."""
    return name.removeprefix("/")


def pose_fault(pose: Sequence[float]) -> str:
    """Say why x, y, z, qx, qy, qz, qw are no pose in metres; empty if they are one.

    The length of the quaternion may be off by a hundredth.
    """
    if not all(map(math.isfinite, pose)):
        return "the numbers are not finite"
    if any(abs(number) > MAX_POSITION_M for number in pose):
        return f"a number is beyond {MAX_POSITION_M:g}"
    norm = math.hypot(*pose[3:])
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        return f"the quaternion has the norm {norm:.3g}, expected 1"
    return ""


def transform_of(translation: Any, rotation: Any) -> FloatArray | Failure:  # noqa: ANN401
    """Return T, shape (4, 4), of a translation in metres and a quaternion; see `pose_fault`."""
    t = np.array([getattr(translation, axis) for axis in "xyz"], dtype=np.float64)
    quaternion_xyzw = np.array([getattr(rotation, axis) for axis in "xyzw"])
    fault = pose_fault([*t.tolist(), *quaternion_xyzw.tolist()])
    if fault:
        return Failure(reason=fault)
    return se3.make_transform(np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix()), t)


def decode_grey_or_color(
    message: ros.sensor_msgs__msg__Image, where: str, grey_range: ImagesConfig = _FULL_RANGE
) -> ImageArray:
    """Return the pixels of an `Image` message.

    Parameters
    ----------
    message : sensor_msgs/Image
        Of an encoding in `gvo.io.bag.image_encodings.IMAGES`.
    where : str
        The topic, for messages.
    grey_range : ImagesConfig
        Of encodings with 16 bits.

    Returns
    -------
    ndarray of uint8, shape (height, width) or (height, width, 3)
        Grey, or colour in BGR order.

    Raises
    ------
    RecordingError
        When the encoding is unknown, size and data do not belong together, or 16 bits would
        become nearly black.
    """
    encoding = find_encoding(message.encoding, IMAGES, where)
    pixels = stored_pixels(message, encoding, where)
    if encoding.to_bgr is not None:
        pixels = convert_to_bgr(pixels, encoding.to_bgr, f"{where} ({message.encoding})")
    return to_8_bit(pixels, where, grey_range)


def decode_depth(message: ros.sensor_msgs__msg__Image, scale: float, where: str) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of an `Image` message of depth.

    Parameters
    ----------
    message : sensor_msgs/Image
        16UC1 or mono16 counts, or 32FC1 metres.
    scale : float
        Counts per metre.
    where : str
        The topic, for messages.

    Raises
    ------
    RecordingError
        When the encoding is no depth, or size and data do not belong together.
    """
    encoding = find_encoding(message.encoding, DEPTHS, where)
    pixels = stored_pixels(message, encoding, where)
    if encoding.dtype == "f4":
        return depth_from_metres(pixels)
    return depth_from_counts(pixels, scale, where)


def decode_compressed(
    message: ros.sensor_msgs__msg__CompressedImage,
    where: str,
    grey_range: ImagesConfig = _FULL_RANGE,
) -> ImageArray:
    """Return the pixels of a `CompressedImage` message.

    Parameters
    ----------
    message : sensor_msgs/CompressedImage
        PNG, JPEG, TIFF, BMP or PNM; its `format` in any of the forms of `image_transport`:
        "jpeg", "rgb8; jpeg compressed bgr8", "bayer_rggb8; png compressed ".
    where : str
        The topic, for messages.
    grey_range : ImagesConfig
        Of images with 16 bits.

    Returns
    -------
    ndarray of uint8, shape (h, w) or (h, w, 3)
        Grey, or colour in BGR order.

    Raises
    ------
    RecordingError
        When the image is damaged or of another format.
    """
    encoding, _, transport = message.format.partition(";")
    where_format = f"{where} ({cut(message.format, 40)})"
    pixels = decode_image(np.asarray(message.data), where_format)
    bayer = BAYER.get(encoding.strip())
    if bayer is not None and bayer.to_bgr is not None and pixels.ndim == 2:
        # The transport compresses a mosaic as if it were grey.
        pixels = convert_to_bgr(pixels, bayer.to_bgr, where_format)
    elif "compressed rgb" in transport and pixels.ndim == 3 and pixels.shape[2] == 3:
        # Early releases gave RGB to an encoder that expects BGR, and said so.
        pixels = convert_to_bgr(pixels, cv2.COLOR_RGB2BGR, where_format)
    return to_8_bit(pixels, where, grey_range)


def decode_compressed_depth(
    message: ros.sensor_msgs__msg__CompressedImage, scale: float, where: str
) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of a `CompressedImage` message of depth.

    Parameters
    ----------
    message : sensor_msgs/CompressedImage
        A 16-bit PNG, or TIFF in metres; or of the transport `compressedDepth`, where PNG or RVL
        follow a header.
    scale : float
        Counts per metre of integer depth.
    where : str
        The topic, for messages.

    Raises
    ------
    RecordingError
        When the image is damaged or no depth.
    """
    data, where_format = np.asarray(message.data), f"{where} ({cut(message.format, 40)})"
    if "compressedDepth" not in message.format or is_png(data):
        pixels = decode_image(data, where_format)
        if pixels.dtype == np.float32 and pixels.ndim == 2:
            return depth_from_metres(pixels)
        return depth_from_counts(pixels, scale, where_format)
    n_header = _COMPRESSED_DEPTH_HEADER.size
    decode = decode_rvl if message.format.endswith("rvl") else decode_image
    counts = decode(data[n_header:], where_format)
    if not message.format.startswith("32FC1"):
        return depth_from_counts(counts, scale, where_format)
    # The transport keeps floats as counts of inverse depth: depth = a / (counts - b).
    _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(data[:n_header].tobytes())
    counts_of_one_per_metre = depth_from_counts(counts, 1.0, where_format)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return depth_from_metres(np.float32(a) / (counts_of_one_per_metre - np.float32(b)))


def camera_fields(message: Any, where: str) -> CameraFields:  # noqa: ANN401 - ROS 1 or 2
    """Return the fields of a `CameraInfo` of ROS 1 (`K`) or ROS 2 (`k`), not checked."""
    matrices: dict[str, Any] = {name: _matrix(message, name) for name in "KDRP"}
    return CameraFields(
        where=where,
        width=int(message.width),
        height=int(message.height),
        model=str(message.distortion_model),
        **matrices,
        binning=(int(message.binning_x), int(message.binning_y)),
        roi=RegionOfInterest(
            **{name: int(getattr(message.roi, name)) for name in RegionOfInterest.__slots__}
        ),
        frame_id=bare(str(message.header.frame_id)),
    )


def _matrix(message: Any, name: str) -> FloatArray:  # noqa: ANN401 - ROS 1 or 2
    name_found = name if hasattr(message, name) else name.lower()
    return np.asarray(getattr(message, name_found), dtype=np.float64)
