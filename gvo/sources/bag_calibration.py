"""The calibration of a camera in a bag, from its `CameraInfo` messages or from files."""

from __future__ import annotations

from dataclasses import dataclass

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration
from gvo.sources.bag_cameras import (
    BagCamera,
    image_frame,
    read_bag_cameras,
    recorded_depth_scale,
)
from gvo.sources.bag_extrinsics import find_extrinsics
from gvo.sources.bag_reader import BagReader
from gvo.sources.calibration import make_calibration, make_rgbd_calibration
from gvo.sources.calibration_files import CalibrationPaths, read_cameras
from gvo.sources.depth_view import DepthChoice, choose_depth_view
from gvo.sources.recording import DepthView
from gvo.sources.stereo_pairs import (
    has_baseline,
    pair_of_baseline,
    pair_of_extrinsics,
    stereo_baseline,
)
from gvo.sources.topics import CameraTopics
from gvo.types import Failure, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagCalibration:
    """What was found.

    Parameters
    ----------
    calibrations : tuple of Calibration
        Of left and right, or of the colour camera.
    decisions : tuple of str
        What was chosen, a line each.
    depth_scale : float, optional
        Counts per metre, where a file or the bag says so.
    depth_view : DepthView, optional
        Of depth that has to be registered to colour.
    frame_id : str
        Of the first camera in `/tf`; empty where nothing names it.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the rectified first camera to the body that a file names, metres.
    """

    calibrations: tuple[Calibration, ...]
    decisions: tuple[str, ...]
    depth_scale: float | None = None
    depth_view: DepthView | None = None
    frame_id: str = ""
    T_body_cam: FloatArray | None = None


def calibrations_of_messages(reader: BagReader, topics: CameraTopics, where: str) -> BagCalibration:
    """Read the first `CameraInfo` of a stereo pair, or of the colour camera.

    A raw pair whose P hold no baseline is rectified by the transform between the cameras. Later
    messages are not read, which would take a pass over the bag: `camera_info_changes` does.

    Parameters
    ----------
    reader : BagReader
        The bag; only topics of `CameraInfo` are read, and where they do not say all, transforms
        and an image.
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
    first, second = read_bag_cameras(reader, topics, where)
    frame_id = first.fields.frame_id or image_frame(reader, topics.first)
    is_rectified = topics.first.is_rectified
    state = "rectified" if is_rectified else "raw, rectified by D, R and P"
    if second is not None and topics.sensor == "stereo":
        pair, baseline = _stereo_pair(reader, (first, second), where)
        names = f"{first.info_name} + {second.info_name}"
        decisions = (f"calibration: {names}; the images are {state}", *first.notes, *second.notes)
        return BagCalibration(
            calibrations=pair, decisions=(*decisions, baseline), frame_id=frame_id
        )
    decisions = (f"calibration: {first.info_name}; the images are {state}", *first.notes)
    color = make_rgbd_calibration(first.fields, is_rectified=is_rectified)
    choice = DepthChoice()
    if second is not None:
        choice = choose_depth_view(reader, (first, color), second)
    return BagCalibration(
        calibrations=(color,),
        decisions=(*decisions, *choice.decisions),
        depth_scale=recorded_depth_scale(reader, topics.second),
        depth_view=choice.view,
        frame_id=frame_id,
    )


def calibrations_of_file(
    paths: CalibrationPaths, topics: CameraTopics, reader: BagReader | None = None
) -> BagCalibration:
    """Read the calibration of a stereo pair, or of the colour camera, from files.

    Parameters
    ----------
    paths : Path or sequence of Path
        See `gvo.sources.calibration_files.read_cameras`.
    topics : CameraTopics
        The image topics; their names say whether the images are rectified.
    reader : BagReader, optional
        The bag, whose images name the camera's frame.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    CalibrationError
        When a file is malformed or describes another kind of camera.
    """
    found = read_cameras(paths, sensor=topics.sensor, is_rectified=topics.first.is_rectified)
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
        frame_id="" if reader is None else image_frame(reader, topics.first),
        T_body_cam=found.T_body_cam,
    )


def _stereo_pair(
    reader: BagReader, cameras: tuple[BagCamera, BagCamera], where: str
) -> tuple[tuple[Calibration, Calibration], str]:
    """Return left and right, and the line that says where the baseline comes from."""
    left, right = (
        make_calibration(camera.fields, is_rectified=camera.image.is_rectified)
        for camera in cameras
    )
    if has_baseline(left, right) or (left.width, left.height) != (right.width, right.height):
        baseline = stereo_baseline((left, right), where)
        return (left, right), f"baseline: {baseline:.4f} m from P of {cameras[1].info_name}"
    found = find_extrinsics(reader, *cameras)
    if isinstance(found, Failure):
        raise CalibrationError(
            f"{where}: the baseline must be positive, got none from P of {cameras[1].info_name}, "
            f"nor from tf: {found.reason}; give --calibration FILE of the pair"
        )
    origin = f"{where}: {found.origin}"
    if left.is_rectified:
        pair = pair_of_baseline((left, right), found.T_target_source, origin)
    else:
        pair = pair_of_extrinsics((left, right), found.T_target_source, origin)
    baseline = stereo_baseline(pair, origin)
    return pair, f"baseline: {baseline:.4f} m from {found.origin}"
