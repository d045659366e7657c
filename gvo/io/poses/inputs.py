"""Poses and truth as the command line names them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gvo._text import exists
from gvo.errors import GvoError, RecordingError, TrajectoryError
from gvo.io.bag.reader import OLD_TF_TYPE, TF_TYPE, BagReader
from gvo.io.bag.source import BagSource
from gvo.io.opening import is_bag, open_recording
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.poses.ground_truth import (
    TRUTH_TYPES,
    BagTruth,
    find_named_truth,
    parse_bag_truth,
    parse_truth,
    read_bag_truth,
)
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.poses.tf_paths import bare
from gvo.io.poses.truth import Truth
from gvo.io.recording import Source
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

CAMERA_CHANGED = (
    "the first one is used; give the right one by --calibration FILE, or cut the bag there"
)
"""What follows where a `CameraInfo` changes on the way, and what to do."""
_MARK = "#"
# A run's bag writes the robot's frames with the name of the estimate before theirs.
_OWN_FRAME = re.compile(r"^gvo/(raw|causal|smoothed|global|odom)/")
# As a run's bag names the camera of a recording that does not.
_CAMERA = "camera_optical"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseInput:
    """Poses that were named on the command line.

    Parameters
    ----------
    name : str
        Of the topic, the chain or the file.
    trajectory : Trajectory
    child_frame : str
        Whose poses they are; empty where that is not known.
    warning : str
        What could not be read, or that they are of another frame than the reference; empty if
        none.
    is_of_camera : bool
        Whether that frame is the rectified camera of a recording, whatever its name.
    """

    name: str
    trajectory: Trajectory
    child_frame: str = ""
    warning: str = ""
    is_of_camera: bool = False


def is_in_bag(text: str) -> bool:
    """Tell whether the text is `BAG#WHAT`, or a bag. A file or folder of that name wins."""
    if exists(Path(text)):
        return is_bag(Path(text))
    path, mark, _ = text.partition(_MARK)
    return bool(mark) and exists(Path(path))


def read_pose_input(text: str, *, frame: str = "", is_camera: bool = False) -> PoseInput:
    """Read poses from a file, or out of a bag, with what is known about them.

    Parameters
    ----------
    text : str
        A file of poses, `BAG#tf:PARENT:CHILD`, `BAG#TOPIC`, or a bag that names its ground truth.
    frame : str
        The frame that the poses are to be of, by its name in the bag's tf; empty: as they are.
    is_camera : bool
        Whether that is the rectified camera of a recording: in a run's bag it is that of the run.

    Returns
    -------
    PoseInput

    Raises
    ------
    TrajectoryError, RecordingError
        When they cannot be read.
    """
    if not is_in_bag(text):
        trajectory = read_trajectory(text)
        warning = _repeats(text, trajectory)
        return PoseInput(name=Path(text).stem, trajectory=trajectory, warning=warning)
    path, _, what = (text, "", "") if exists(Path(text)) else text.partition(_MARK)
    reader = BagReader(Path(path))
    truth = _read(reader, what, path)
    child = _camera_frame(path) if truth.is_of_camera else truth.child_frame
    found = PoseInput(
        name=what or Path(path).stem,
        trajectory=truth.trajectory,
        child_frame=_OWN_FRAME.sub("", child),
        warning=reader.damage,
        is_of_camera=truth.is_of_camera,
    )
    if not frame or not child or (is_camera and truth.is_of_camera):
        return found
    asked = _frame_of_run(reader, child, frame, is_camera=is_camera)
    return found if asked == child else _brought(found, reader, child, asked)


def _camera_frame(path: str) -> str:
    try:
        return bare(open_recording(path).info.frame_id) or _CAMERA
    except GvoError:  # its poses can be compared without its camera
        return _CAMERA


def _repeats(name: str, trajectory: Trajectory) -> str:
    n = trajectory.n_repeated
    return f"{name}: {n} rows were left out, the next has the same stamp" if n else ""


def _read(reader: BagReader, what: str, path: str) -> BagTruth:
    if what:
        return read_bag_truth(reader, parse_bag_truth(what), where=path)
    truth = find_named_truth(reader, where=path)
    if not isinstance(truth, Failure):
        return truth
    held = [topic.name for topic in reader.topics if topic.type in TRUTH_TYPES]
    if any(topic.type in (TF_TYPE, OLD_TF_TYPE) for topic in reader.topics):
        held.insert(0, "tf:PARENT:CHILD")
    if not held:
        raise RecordingError(f"{path}: holds no poses: neither tf nor a topic of poses")
    raise RecordingError(f"{path}: name the poses: {', '.join(f'{path}#{name}' for name in held)}")


def _brought(found: PoseInput, reader: BagReader, child: str, asked: str) -> PoseInput:
    """Return poses of another frame of the same body; as they are where that cannot be done."""
    trajectory, reason = found.trajectory, "positions without rotations cannot be moved"
    frame = _OWN_FRAME.sub("", asked)
    if trajectory.has_rotations:
        tree = read_tf(reader, frames=(child, asked))
        T_child_asked, is_known = tree.lookup_many(child, asked, trajectory.stamps_ns)
        if np.any(is_known):
            known = trajectory.select(is_known)
            poses = known.T_world_frame @ T_child_asked[is_known]
            return replace(found, trajectory=replace(known, T_world_frame=poses), child_frame=frame)
        reason = "tf does not connect the two"
    apart = f"{found.name} is of {child}, the reference of {frame}: {reason}"
    return replace(found, warning="; ".join(filter(None, [found.warning, apart])))


def _frame_of_run(reader: BagReader, child: str, frame: str, *, is_camera: bool) -> str:
    """Return a frame by its name in the tf of a run's bag; as it is where this is no run's."""
    own = _OWN_FRAME.match(child)
    if own and is_camera:
        # all that a run mounts on its base frame
        return next((c for p, c in read_tf(reader, frames=()).edges if p == child), child)
    return f"{own[0]}{frame}" if own else frame


def find_base_frame(
    source: Source, name: str | None = None, *, T_initial: FloatArray | None = None
) -> BaseFrame:
    """Find a base frame by its name, and where the camera is mounted on it.

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
        return BaseFrame(info.frame_id, T_initial=T_initial)
    name = name.strip("/")
    if isinstance(source, BagSource):
        buffer = source.transforms((name, info.frame_id))
        if info.T_body_cam is None or name in buffer.frames:
            return BaseFrame.from_tf(
                buffer, name, info.frame_id, T_initial=T_initial, where=info.name
            )
    if info.T_body_cam is None:
        raise RecordingError(
            f"{info.name}: --frame {name}: the recording does not say where the camera is on it; "
            "give a calibration with the camera's pose on the body by --calibration FILE"
        )
    placed = BaseFrame(name, info.T_body_cam, T_initial=T_initial)
    placed.origin = "the body on which the calibration places the camera"
    return placed


def read_truth(source: Source, text: str, *, base_frame: BaseFrame | None = None) -> Truth:
    """Read the true poses that a text names.

    Parameters
    ----------
    source : Source
        The recording.
    text : str
        `tf:PARENT:CHILD` or a topic of the recording, which must be a bag; or a file of poses,
        or another recording, of the base frame.
    base_frame : BaseFrame, optional
        The camera's where omitted.

    Raises
    ------
    RecordingError, TrajectoryError
        When it cannot be read, or tf does not bring it to the frame.
    """
    base_frame = base_frame or BaseFrame()
    spec = parse_truth(text)
    if isinstance(spec, Path):
        trajectory = read_ground_truth(spec)
        return Truth(trajectory=trajectory, decision=_repeats(str(spec), trajectory) or str(spec))
    if not isinstance(source, BagSource):
        raise TrajectoryError(
            f"{text}: names what is in a bag, and {source.info.name} is none; give a file"
        )
    truth = source.truth(
        spec, base_frame=_name_in_tf(base_frame), T_base_cam=base_frame.fixed_mount
    )
    if isinstance(truth, Failure):
        raise TrajectoryError(f"--ground-truth {text}: {truth.reason}")
    return truth


def recorded_truth(source: Source, *, base_frame: BaseFrame | None = None) -> Truth | Failure:
    """Read the ground truth that a recording itself holds.

    Parameters
    ----------
    source : Source
        The recording.
    base_frame : BaseFrame, optional
        The camera's where omitted.

    Returns
    -------
    Truth or Failure
        The failure says why there is none, or why it cannot be compared.

    Raises
    ------
    RecordingError, TrajectoryError
        When it cannot be read.
    """
    base_frame = base_frame or BaseFrame()
    if isinstance(source, BagSource):
        return source.truth(base_frame=_name_in_tf(base_frame), T_base_cam=base_frame.fixed_mount)
    truth = source.ground_truth()
    if truth is None:
        return Failure(reason="the recording holds none")
    return Truth(trajectory=base_frame.convert(truth), decision="of the recording")


def read_transforms(source: Source, frames: Collection[str]) -> TfBuffer | None:
    """Return what a bag knows of frames; None where the recording is no bag."""
    if not isinstance(source, BagSource):
        return None
    return source.transforms([name for name in frames if name])


def describe_camera_changes(source: Source) -> str | None:
    """Say which `CameraInfo` of the images read differ from the one used; None for no bag."""
    if not isinstance(source, BagSource):
        return None
    return ", ".join(f"{n} of {name}" for name, n in source.camera_info_changes.items())


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
        A line each.

    Raises
    ------
    TrajectoryError, RecordingError
        When something cannot be read.
    """
    if is_in_bag(reference):
        first = read_pose_input(reference)
    else:
        truth = read_ground_truth(reference)
        first = PoseInput(name=reference, trajectory=truth, warning=_repeats(reference, truth))
        if Path(reference).is_dir():
            first = replace(first, child_frame=_CAMERA, is_of_camera=True)
    frame, is_camera = first.child_frame, first.is_of_camera
    found = [read_pose_input(text, frame=frame, is_camera=is_camera) for text in estimates]
    warnings = [one.warning for one in (first, *found) if one.warning]
    names = _short_names(estimates, [one.name for one in found])
    trajectories = {name: one.trajectory for name, one in zip(names, found, strict=True)}
    return first.trajectory, trajectories, warnings


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
        return read_pose_input(str(path)).trajectory
    path = Path(path)
    if (path / "groundtruth.txt").is_file():
        return read_trajectory(path / "groundtruth.txt")
    if not path.is_dir():
        return read_trajectory(path)  # of a pipe too
    truth = open_recording(path).ground_truth()
    if truth is None:
        raise TrajectoryError(f"{path}: this recording holds no ground truth")
    return truth


def initial_pose(truth: Truth | Failure, stamp_ns: int) -> FloatArray:
    """Return the true pose of the first frame.

    Parameters
    ----------
    truth : Truth or Failure
        Of the base frame.
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
    first: FloatArray = poses.T_world_frame[0]
    return first


def _name_in_tf(base_frame: BaseFrame) -> str:
    return "" if base_frame.is_camera else base_frame.name


def _short_names(texts: Sequence[str], names: Sequence[str]) -> list[str]:
    """Name estimates by their files or topics, with folders where that is ambiguous."""
    longer = [
        name if names.count(name) == 1 else f"{Path(text).parent.name}/{name}"
        for text, name in zip(texts, names, strict=True)
    ]
    for found in (longer, list(texts)):
        if len(set(found)) == len(found):
            return found
    return [f"{number}: {text}" for number, text in enumerate(texts, 1)]
