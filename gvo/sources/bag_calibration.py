"""The calibration of a camera in a bag, from its `CameraInfo` messages or from a file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration
from gvo.sources.bag_reader import BagReader
from gvo.sources.calibration import (
    make_calibration,
    make_rgbd_calibration,
    stereo_baseline,
)
from gvo.sources.calibration_files import read_mono_file, read_stereo_file
from gvo.sources.messages import camera_fields
from gvo.sources.topics import CameraTopics, Topic, camera_info_names, find_camera_info

_REGISTRATION_TOLERANCE = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class BagCalibration:
    """What was found.

    Parameters
    ----------
    calibrations : tuple of Calibration
        Of left and right, or of the colour camera.
    decisions : tuple of str
        What was chosen, a line each.
    depth_scale : float, optional
        Counts per metre, where the file says so.
    """

    calibrations: tuple[Calibration, ...]
    decisions: tuple[str, ...]
    depth_scale: float | None = None


def calibrations_of_messages(reader: BagReader, topics: CameraTopics, where: str) -> BagCalibration:
    """Read the first `CameraInfo` of a stereo pair, or of the colour camera.

    Parameters
    ----------
    reader : BagReader
        The bag; only topics of `CameraInfo` are read.
    topics : CameraTopics
        The image topics.
    where : str
        The bag, for messages.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    CalibrationError
        When a `CameraInfo` is missing or describes no usable camera.
    """
    images = [topics.first] if topics.sensor == "rgbd" else [topics.first, topics.second]
    names = [_camera_info_name(image, reader, where) for image in images]
    depth_name = find_camera_info(topics.second, reader.topics)
    messages = _first_messages(reader, {*names, depth_name or names[0]})
    for name in names:
        if name not in messages:
            raise CalibrationError(f"{where}: {name} yields no message; give --calibration FILE")
    make = make_rgbd_calibration if topics.sensor == "rgbd" else make_calibration
    calibrations = tuple(
        make(camera_fields(messages[name], f"{where}: {name}"), is_rectified=image.is_rectified)
        for image, name in zip(images, names, strict=True)
    )
    state = "rectified" if topics.first.is_rectified else "raw, rectified by D, R and P"
    decisions = [f"calibration: {' + '.join(names)}; the images are {state}"]
    if topics.sensor == "stereo":
        baseline = stereo_baseline((calibrations[0], calibrations[1]), where)
        decisions.append(f"baseline: {baseline:.4f} m from P of {names[1]}")
    elif depth_name in messages:
        decisions += _doubt_registration(calibrations[0], messages[depth_name])
    return BagCalibration(calibrations=calibrations, decisions=tuple(decisions))


def calibrations_of_file(path: Path, topics: CameraTopics) -> BagCalibration:
    """Read the calibration of a stereo pair, or of the colour camera, from a YAML file.

    Parameters
    ----------
    path : Path
        See `gvo.sources.calibration_files.read_calibration_file`.
    topics : CameraTopics
        The image topics; their names say whether the images are rectified.

    Raises
    ------
    CalibrationError
        When the file is malformed or describes another kind of camera.
    """
    is_rectified = topics.first.is_rectified
    decision = f"calibration: {path}"
    if topics.sensor == "stereo":
        left, right = read_stereo_file(path, is_rectified=is_rectified)
        baseline = f"baseline: {stereo_baseline((left, right), str(path)):.4f} m from P of {path}"
        return BagCalibration(calibrations=(left, right), decisions=(decision, baseline))
    fields, depth_scale = read_mono_file(path)
    camera = make_rgbd_calibration(fields, is_rectified=is_rectified)
    return BagCalibration(calibrations=(camera,), decisions=(decision,), depth_scale=depth_scale)


def _camera_info_name(image: Topic, reader: BagReader, where: str) -> str:
    name = find_camera_info(image, reader.topics)
    if name is None:
        raise CalibrationError(
            f"{where}: no CameraInfo for {image.name}: expected "
            f"/{camera_info_names(image)[0]}; give --calibration FILE"
        )
    return name


def _first_messages(reader: BagReader, names: Collection[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for message in reader.messages(names):
        if message.topic.name not in found:
            found[message.topic.name] = message.decode()
        if len(found) == len(names):
            break
    return found


def _doubt_registration(color: Calibration, depth_message: Any) -> list[str]:  # noqa: ANN401
    """Return a line of advice where depth is not seen from the colour camera."""
    depth = camera_fields(depth_message, "depth")
    if (depth.width, depth.height) != (color.width, color.height):
        return [
            f"depth: its images are of {depth.width}x{depth.height} pixels, colour of "
            f"{color.width}x{color.height}: give a topic of depth registered to colour by --depth"
        ]
    focal = np.asarray(depth.K)[0]
    if abs(focal - color.K[0, 0]) <= _REGISTRATION_TOLERANCE * color.K[0, 0]:
        return []
    return [
        f"depth: it is not registered to colour (fx {focal:.1f} against {color.K[0, 0]:.1f} px): "
        "give a topic of depth registered to colour by --depth"
    ]
