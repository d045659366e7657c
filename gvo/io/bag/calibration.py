"""Calibration and extrinsics of a bag's cameras."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gvo.errors import CalibrationError, RecordingError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration, rectification_maps
from gvo.io.bag.cameras import (
    BagCamera,
    image_frame,
    image_size,
    read_bag_cameras,
    recorded_depth_scale,
)
from gvo.io.bag.messages import transform_of
from gvo.io.bag.reader import BagMessage, MessageReader
from gvo.io.bag.topics import CameraTopics, Topic
from gvo.io.calibration.camera_info import (
    make_calibration,
    make_rgbd_calibration,
    pair_of_baseline,
    pair_of_extrinsics,
    stereo_baseline,
)
from gvo.io.calibration.files import CalibrationPaths, read_cameras
from gvo.io.calibration.forms import ImuFacts
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.recording import DepthView
from gvo.types import Failure, FloatArray

TRANSFORM_TYPE = "geometry_msgs/msg/Transform"

# The topics of one stream of a bag that librealsense wrote.
_REALSENSE_STREAM = re.compile(r"(/device_\d+/sensor_\d+/[^/]+)/(?:image|imu)/data")
# Of the focal length and of the image size: calibrations of one camera differ by less, numbers that
# a driver copied or scaled by much less.
_TOLERANCE, _SAME = 0.02, 0.005
_SAME_PLACE_M = 1e-6
_REMEDY = "give a topic of depth registered to colour by --depth"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagCalibration:
    """The calibration of left and right, or of the colour camera, and how it was found."""

    calibrations: tuple[Calibration, ...]
    decisions: tuple[str, ...]
    depth_scale: float | None = None
    depth_view: DepthView | None = None
    frame_id: str = ""
    T_body_cam: FloatArray | None = None
    info_names: tuple[str, ...] = ()
    imu: ImuFacts = field(default_factory=dict)


def calibrations_of_messages(
    reader: MessageReader, topics: CameraTopics, where: str, names: Sequence[str] = ()
) -> BagCalibration:
    """Read the first `CameraInfo` of a stereo pair, or of the colour camera.

    A raw pair whose P hold no baseline is rectified by the transform between the cameras. Later
    messages are not read, which would take a pass over the bag: `camera_info_changes` does.
    """
    first, second = read_bag_cameras(reader, topics, where, names)
    info_names = tuple(camera.info_name for camera in (first, second) if camera is not None)
    frame_id = first.fields.frame_id or image_frame(reader, topics.first)
    is_rectified = topics.first.is_rectified
    state = "rectified" if is_rectified else "raw, rectified by D, R and P"
    if second is not None and topics.sensor == "stereo":
        pair, baseline = _stereo_pair(reader, (first, second), where)
        line = f"calibration: {' + '.join(info_names)}; the images are {state}"
        decisions = (line, *first.notes, *second.notes, baseline)
        return BagCalibration(
            calibrations=pair, decisions=decisions, frame_id=frame_id, info_names=info_names
        )
    decisions = (f"calibration: {first.info_name}; the images are {state}", *first.notes)
    color = make_rgbd_calibration(first.fields, is_rectified=is_rectified)
    view, found = None, ""
    second = second or _like_color(reader, topics.second, first)
    if second is not None:
        view, found = _depth_view(reader, first, color, second)
    return BagCalibration(
        calibrations=(color,),
        decisions=(*decisions, found) if found else decisions,
        depth_scale=recorded_depth_scale(reader, topics.second),
        depth_view=view,
        frame_id=frame_id,
        info_names=info_names,
    )


def calibrations_of_file(
    paths: CalibrationPaths, topics: CameraTopics, reader: MessageReader
) -> BagCalibration:
    """Read the calibration from files; the topics' names tell whether the images are rectified."""
    found = read_cameras(
        paths,
        sensor=topics.sensor,
        is_rectified=topics.first.is_rectified,
        image_size=partial(image_size, reader, topics.first),
    )
    decisions = [f"calibration: {found.origin}"]
    if topics.first.is_rectified and not found.calibrations[0].is_rectified:
        decisions[0] += "; the images are taken as raw, as there, whatever the topics are called"
    if topics.sensor == "stereo":
        baseline = stereo_baseline(found.pair, found.origin)
        decisions.append(f"baseline: {baseline:.4f} m from {found.baseline_from} of {found.origin}")
    return BagCalibration(
        calibrations=found.calibrations,
        decisions=tuple(decisions),
        depth_scale=found.depth_scale,
        frame_id=image_frame(reader, topics.first),
        T_body_cam=found.T_body_cam,
        imu=found.imu,
    )


def _stereo_pair(
    reader: MessageReader, cameras: tuple[BagCamera, BagCamera], where: str
) -> tuple[tuple[Calibration, Calibration], str]:
    """Return left and right, and the line that says where the baseline comes from."""
    left, right = (
        make_calibration(camera.fields, is_rectified=camera.image.is_rectified)
        for camera in cameras
    )
    info, offset = cameras[1].info_name, float(left.P[0, 3] - right.P[0, 3])
    if offset > 0 or (left.width, left.height) != (right.width, right.height):
        baseline = stereo_baseline((left, right), where)
        return (left, right), f"baseline: {baseline:.4f} m from P of {info}"
    found = _find_extrinsics(reader, *cameras)
    if isinstance(found, Failure) or (offset < 0 and found[0][0, 3] <= 0):
        reason = found.reason if isinstance(found, Failure) else "it has the same sign"
        swap = "exchange --left and --right or, if `gvo check` then finds the images exchanged, "
        raise CalibrationError(
            f"{where}: the baseline must be positive, got {offset / left.P[0, 0]:.4g} m from P[3] "
            f"of {info}, and none from tf: {reason}; {swap if offset < 0 else ''}give "
            "--calibration FILE of the pair"
        )
    T_left_right, origin = found
    if offset < 0:
        origin += f", which the sign of P of {info} contradicts"
    make_pair = pair_of_baseline if left.is_rectified else pair_of_extrinsics
    pair = make_pair((left, right), T_left_right, f"{where}: {origin}")
    baseline = stereo_baseline(pair, f"{where}: {origin}")
    return pair, f"baseline: {baseline:.4f} m from {origin}"


def _like_color(reader: MessageReader, depth: Topic, color: BagCamera) -> BagCamera | None:
    """Return the camera of depth without `CameraInfo`: that of colour, with larger pixels if so."""
    with suppress(CalibrationError, RecordingError):
        n = color.fields.recorded_size()[0] // max(image_size(reader, depth)[0], 1)
        x, y = color.fields.binning_factors
        return replace(color, image=depth, fields=replace(color.fields, binning=(n * x, n * y)))
    return None


def _depth_view(
    reader: MessageReader, camera: BagCamera, color: Calibration, depth: BagCamera
) -> tuple[DepthView | None, str]:
    """Return the camera of depth that has to be registered to colour, and a line on it.

    Both are at one place where their frame is one, or where the topic's name says that depth is
    registered and the intrinsics are the same; None where the size and the intrinsics are the same
    too, or where the place is not known.
    """
    try:
        calibration = make_rgbd_calibration(depth.fields, is_rectified=depth.image.is_rectified)
    except CalibrationError as error:
        return None, f"depth: taken as registered to colour: {error}"
    difference = _difference(color, calibration)
    frames = (camera.fields.frame_id, depth.fields.frame_id)
    found: tuple[FloatArray, str] | Failure = (np.eye(4), f"one frame {frames[0]}")
    if depth.image.is_registered and not _difference(color, calibration, _SAME):
        found = np.eye(4), "its name"
    elif not frames[0] or frames[0] != frames[1]:
        found = _find_extrinsics(reader, camera, depth)
    if (calibration.width, calibration.height) != (color.width, color.height):
        size = f"{calibration.width}x{calibration.height} pixels"
        difference = f"images of {size}, colour {color.width}x{color.height}"
    if isinstance(found, Failure):
        return None, _advice(difference, frames, found)
    T_color_depth, origin = found
    if not difference and np.allclose(T_color_depth, np.eye(4), atol=_SAME_PLACE_M):
        return None, ""
    distance = float(np.linalg.norm(T_color_depth[:3, 3]))
    line = f"depth: of a camera {distance:.4f} m from colour by {origin}, registered to it"
    line += f" ({difference})" if difference else ""
    return DepthView(calibration=calibration, T_color_depth=T_color_depth), line


def _difference(color: Calibration, depth: Calibration, tolerance: float = _TOLERANCE) -> str:
    """Say how the views of two cameras differ, apart from resolution; empty where they do not."""
    has_lens, depth_has_lens = (rectification_maps(each) is not None for each in (color, depth))
    K, K_depth, sizes = color.P, depth.P, (color.width, color.height)
    scales = color.width / depth.width, color.height / depth.height
    if has_lens and not depth_has_lens:
        # Drivers that register depth to raw colour give it the K of colour, without a lens.
        K, tolerance = color.K, _SAME
    for axis, size, scale in zip((0, 1), sizes, scales, strict=True):
        f, c, f_depth, c_depth = *K[axis, [axis, 2]], *K_depth[axis, [axis, 2]]
        if abs(scale * f_depth - f) > tolerance * f:
            return f"f{'xy'[axis]} {f_depth:.1f} against {f:.1f} px"
        if abs(scale * (c_depth + 0.5) - 0.5 - c) > tolerance * size:
            return f"c{'xy'[axis]} {c_depth:.1f} against {c:.1f} px"
    is_one_lens = color.model == depth.model and np.array_equal(color.D, depth.D)
    return "another lens" if depth_has_lens and not is_one_lens else ""


def _advice(difference: str, frames: tuple[str, str], why: Failure) -> str:
    if difference:
        return f"depth: not registered to colour ({difference}; {why.reason}): {_REMEDY}"
    if all(frames):
        return (
            f"depth: taken as registered to colour, though its frame is {frames[1]} and that of "
            f"colour {frames[0]} ({why.reason}); if it is not, {_REMEDY}"
        )
    return ""


def _find_extrinsics(
    reader: MessageReader, target: BagCamera, source: BagCamera
) -> tuple[FloatArray, str] | Failure:
    """Find T_target_source of two cameras, metres, and where it was found.

    By the tf between the frames that their `CameraInfo` name; where these are empty, by the `tf`
    topics beside the streams of librealsense, which map their reference to each stream.
    """
    frames = (target.fields.frame_id, source.fields.frame_id)
    if not all(frames):
        return of_realsense(reader, target.image.name, source.image.name)
    if frames[0] == frames[1]:
        return Failure(reason=f"both CameraInfo name the frame {frames[0]}")
    found = lookup_mount(read_tf(reader, frames=frames), frames, target.stamp_ns)
    if isinstance(found, Failure):
        return found
    return found, f"tf {frames[0]} -> {frames[1]}"


def lookup_mount(buffer: TfBuffer, frames: tuple[str, str], stamp_ns: int) -> FloatArray | Failure:
    """Look a mount up at a stamp, or where it is known: `CameraInfo` may come before tf."""
    found = buffer.lookup(*frames, stamp_ns)
    if not isinstance(found, Failure):
        return found
    stamps_ns, T = buffer.known(*frames)
    return np.asarray(T[np.argmin(np.abs(stamps_ns - stamp_ns))]) if len(stamps_ns) else found


def of_realsense(
    reader: MessageReader, target: str, source: str
) -> tuple[FloatArray, str] | Failure:
    """Find T_target_source of two topics of a bag that librealsense wrote, and where."""
    streams = [_REALSENSE_STREAM.fullmatch(name) for name in (target, source)]
    references = [set() if stream is None else _references(reader, stream[1]) for stream in streams]
    common = sorted(references[0] & references[1])
    if not common:
        return Failure(reason="the CameraInfo name no frame")
    names = [f"{stream[1]}/tf/{common[0]}" for stream in streams if stream is not None]
    T_stream_reference = {m.topic.name: _transform(m) for m in reader.messages(names)}
    if len(T_stream_reference) != len(set(names)):
        return Failure(reason=f"{names[0]} or {names[1]} yields no message")
    T_target_reference, T_source_reference = (T_stream_reference[name] for name in names)
    return T_target_reference @ se3.invert(T_source_reference), " and ".join(names)


def _references(reader: MessageReader, stream: str) -> set[str]:
    start = f"{stream}/tf/"
    return {
        topic.name.removeprefix(start)
        for topic in reader.topics
        if topic.name.startswith(start) and topic.type == TRANSFORM_TYPE
    }


def _transform(message: BagMessage) -> FloatArray:
    content = message.decode()
    T = transform_of(content.translation, content.rotation)
    if isinstance(T, Failure):
        raise RecordingError(
            f"{message.topic.name}: not a transform: {T.reason}; give --calibration FILE"
        )
    return T
