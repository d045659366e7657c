"""What a run is given besides the recording: the frame of its poses, and the truth."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from gvo.bounded_text import exists
from gvo.errors import RecordingError, TrajectoryError
from gvo.output_frame import OutputFrame
from gvo.sources.bag import BagSource
from gvo.sources.opening import is_bag, open_recording
from gvo.sources.pose_inputs import is_in_bag, read_pose_input, read_poses
from gvo.sources.recording import Source
from gvo.sources.tf import TfBuffer
from gvo.sources.truth_frames import FramedTruth
from gvo.sources.truth_specs import FileTruth, parse_truth
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray


def choose_frame(
    source: Source, name: str | None = None, *, T_initial: FloatArray | None = None
) -> OutputFrame:
    """Find how the camera sits in the frame whose poses are asked for.

    Parameters
    ----------
    source : Source
        The recording.
    name : str, optional
        As `/tf` of a bag names it; where that does not connect it with the camera, it is the
        body that the calibration places the camera on. Omitted: the camera itself.
    T_initial : ndarray of float64, shape (4, 4), optional
        T_world_frame of the first frame, metres; the identity where omitted.

    Raises
    ------
    RecordingError
        When neither says where the camera is.
    """
    info = source.info
    if name is None:
        return OutputFrame(info.frame_id, T_initial=T_initial)
    name = name.strip("/")
    if isinstance(source, BagSource):
        buffer = source.transforms((name, info.frame_id))
        if info.T_body_cam is None or name in buffer.frames:
            return OutputFrame.from_tf(
                buffer, name, info.frame_id, T_initial=T_initial, where=info.name
            )
    if info.T_body_cam is None:
        raise RecordingError(
            f"{info.name}: --frame {name}: the recording does not say where the camera is on it; "
            "give a calibration with the camera's pose on the body by --calibration FILE"
        )
    placed = OutputFrame(name, info.T_body_cam, T_initial=T_initial)
    placed.origin = "the body on which the calibration places the camera"
    return placed


def asked_truth(source: Source, text: str, *, frame: OutputFrame | None = None) -> FramedTruth:
    """Read the true poses that were asked for.

    Parameters
    ----------
    source : Source
        The recording.
    text : str
        `tf:PARENT:CHILD` or a topic of the recording, which must be a bag; or a file of poses,
        or another recording, of the frame that is asked for.
    frame : OutputFrame, optional
        Whose poses are asked for; the camera's where omitted.

    Raises
    ------
    RecordingError, TrajectoryError
        When it cannot be read, or tf does not bring it to the frame.
    """
    frame = frame or OutputFrame()
    spec = parse_truth(text)
    if isinstance(spec, FileTruth):
        return FramedTruth(trajectory=read_ground_truth(spec.path), decision=str(spec.path))
    if not isinstance(source, BagSource):
        raise TrajectoryError(
            f"{text}: names what is in a bag, and {source.info.name} is none; give a file"
        )
    truth = source.truth(spec, frame=_name_in_tf(frame), T_frame_cam=frame.fixed_mount)
    if isinstance(truth, Failure):
        raise TrajectoryError(f"--ground-truth {text}: {truth.reason}")
    return truth


def own_truth(source: Source, *, frame: OutputFrame | None = None) -> FramedTruth | Failure:
    """Read what a recording itself names its ground truth.

    Parameters
    ----------
    source : Source
        The recording.
    frame : OutputFrame, optional
        Whose poses are asked for; the camera's where omitted.

    Returns
    -------
    FramedTruth or Failure
        The failure says why there is none, or why it cannot be compared.

    Raises
    ------
    RecordingError, TrajectoryError
        When it cannot be read.
    """
    frame = frame or OutputFrame()
    if isinstance(source, BagSource):
        return source.truth(frame=_name_in_tf(frame), T_frame_cam=frame.fixed_mount)
    truth = source.ground_truth()
    if truth is None:
        return Failure(reason="the recording holds none")
    return FramedTruth(trajectory=frame.convert(truth), decision="of the recording")


def read_transforms(source: Source, frames: Collection[str]) -> TfBuffer | None:
    """Return what a bag knows of frames; None where the recording is no bag."""
    if not isinstance(source, BagSource):
        return None
    return source.transforms([name for name in frames if name])


def count_calibration_changes(source: Source) -> dict[str, int] | None:
    """Count the `CameraInfo` of a bag that differ from the first, by topic; None for no bag."""
    return source.camera_info_changes() if isinstance(source, BagSource) else None


def read_compared(
    reference: str, estimates: Sequence[str]
) -> tuple[Trajectory, dict[str, Trajectory], list[str]]:
    """Read what `gvo compare` compares.

    Parameters
    ----------
    reference : str
        See `read_ground_truth`.
    estimates : sequence of str
        Files of poses, or what lies inside of bags; brought to the frame of the reference where
        tf can.

    Returns
    -------
    reference : Trajectory
    estimates : dict of str to Trajectory
        By their shortest names that differ.
    warnings : list of str
        What they are to be taken with, a line each.

    Raises
    ------
    TrajectoryError, RecordingError
        When something cannot be read.
    """
    if is_in_bag(reference):
        first = read_pose_input(reference)
        truth, frame, warnings = first.trajectory, first.child_frame, [first.warning]
    else:
        truth, frame, warnings = read_ground_truth(reference), "", []
    found = [read_pose_input(text, frame=frame) for text in estimates]
    warnings += [one.warning for one in found]
    names = _short_names(estimates, [one.name for one in found])
    trajectories = {name: one.trajectory for name, one in zip(names, found, strict=True)}
    return truth, trajectories, [warning for warning in warnings if warning]


def read_ground_truth(path: str | Path) -> Trajectory:
    """Read true poses.

    Parameters
    ----------
    path : str or Path
        A file of poses (TUM, KITTI, EuRoC), a recording's folder, or a bag that names its ground
        truth; what lies inside of a bag as `BAG#tf:PARENT:CHILD` or `BAG#TOPIC`.

    Returns
    -------
    Trajectory
        Of a recording that of the camera.

    Raises
    ------
    TrajectoryError, RecordingError
        When the file holds no poses, or the recording no ground truth.
    """
    if is_in_bag(str(path)) or (Path(path).is_dir() and is_bag(Path(path))):
        return read_poses(str(path))
    path = Path(path)
    if (path / "groundtruth.txt").is_file():
        return read_trajectory(path / "groundtruth.txt")
    if path.is_file() or not exists(path):
        return read_trajectory(path)
    truth = open_recording(path).ground_truth()
    if truth is None:
        raise TrajectoryError(f"{path}: this recording holds no ground truth")
    return truth


def initial_pose(truth: FramedTruth | Failure, stamp_ns: int) -> FloatArray:
    """Return the true pose of the first frame.

    Parameters
    ----------
    truth : FramedTruth or Failure
        In the frame that is asked for.
    stamp_ns : int
        Of the first frame, nanoseconds.

    Returns
    -------
    ndarray of float64, shape (4, 4)
        T_world_frame: between the true poses before and after, or the first one where the truth
        begins later.

    Raises
    ------
    TrajectoryError
        When there is no truth, it has no rotations, or ends before the first frame.
    """
    if isinstance(truth, Failure):
        raise TrajectoryError(f"--initial-pose truth: there is no ground truth: {truth.reason}")
    if not truth.trajectory.has_rotations:
        raise TrajectoryError("--initial-pose truth: the ground truth has no rotations")
    if len(truth.trajectory) == 0 or truth.trajectory.stamps_ns[-1] < stamp_ns:
        raise TrajectoryError("--initial-pose truth: the ground truth ends before the first frame")
    at_first = truth.trajectory.interpolate(np.array([stamp_ns], dtype=np.int64))
    poses = at_first if len(at_first) else truth.trajectory
    first: FloatArray = poses.T_world_cam[0]
    return first


def _name_in_tf(frame: OutputFrame) -> str:
    return "" if frame.is_camera else frame.name


def _short_names(texts: Sequence[str], names: Sequence[str]) -> list[str]:
    """Name estimates by their files or topics, with folders where that is ambiguous."""
    longer = [
        name if names.count(name) == 1 else f"{Path(text).parent.name}/{name}"
        for text, name in zip(texts, names, strict=True)
    ]
    if len(set(longer)) == len(longer):
        return longer
    return (
        list(texts)
        if len(set(texts)) == len(texts)
        else [f"{number}: {text}" for number, text in enumerate(texts, 1)]
    )
