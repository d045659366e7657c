"""Truth and poses as the command line names them: in the recording, in files, in bags."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gvo._text import exists
from gvo.errors import GvoError, RecordingError, TrajectoryError
from gvo.io.bag.messages import bare
from gvo.io.bag.reader import BagReader
from gvo.io.bag.source import BagSource
from gvo.io.opening import is_bag, open_recording
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.poses.tf import TF_TYPES, read_tf
from gvo.io.poses.truth import (
    TRUTH_TYPES,
    BagTruthSpec,
    Poses,
    Truth,
    find_named_truth,
    moved,
    parse_bag_truth,
    parse_truth,
    read_poses,
)
from gvo.io.recording import Source
from gvo.trajectory import evaluation
from gvo.trajectory.evaluation import Evaluation
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure

_MARK = "#"
# A run's bag writes the robot's frames with the name of the estimate before theirs.
_OWN_FRAME = re.compile(r"^gvo/(raw|causal|smoothed|global|odom)/")
# As a run's bag names the camera of a recording that does not.
_CAMERA = "camera_optical"


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
    spec = parse_truth(text)
    if isinstance(spec, Path):
        trajectory = read_ground_truth(spec)
        return Truth(trajectory=trajectory, decision=_repeats(str(spec), trajectory) or str(spec))
    if not isinstance(source, BagSource):
        raise TrajectoryError(
            f"{text}: names something in a bag, but {source.info.name} is not a bag; give a file"
        )
    truth = _in_bag(source, spec, base_frame or BaseFrame())
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
        return _in_bag(source, None, base_frame)
    truth = source.ground_truth()
    if truth is None:
        return Failure(reason="the recording holds none")
    return Truth(trajectory=base_frame.convert(truth), decision="of the recording")


def _in_bag(source: BagSource, spec: BagTruthSpec | None, base_frame: BaseFrame) -> Truth | Failure:
    name = "" if base_frame.is_camera else base_frame.name
    return source.truth(spec, base_frame=name, T_base_cam=base_frame.fixed_mount)


def read_ground_truth(path: str | Path) -> Trajectory:
    """Read true poses.

    Parameters
    ----------
    path : str or Path
        A file of poses (docs/frames.md), a recording's folder, or a bag that names its ground
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
    return _read(str(path)).trajectory


def evaluate(
    reference: Trajectory | str | Path,
    estimate: Trajectory | str | Path,
    *,
    name: str | None = None,
    **options: Any,  # noqa: ANN401 - of several types
) -> Evaluation:
    """Associate an estimate with its reference, align it and measure its errors.

    Parameters
    ----------
    reference, estimate : Trajectory, str or Path
        Poses of the same frame, see `Trajectory.transformed`; or what `read_ground_truth` reads.
    name : str, optional
        Of the estimate; by default that of its file, else "estimate".
    align : {"none", "origin", "se3", "sim3"}
        How the estimate is aligned first, see `alignment`.
    segments : sequence of float, optional
        Segment lengths in metres; by default KITTI's 100 to 800 m, and 20 and 50 m where the
        associated reference is shorter than 200 m.
    segment_step : int, optional
        Poses between the starts of segments; by default 10 as in KITTI, or 1, likewise.
    max_difference_ns : int
        Largest difference of associated stamps, nanoseconds; see `pair`.
    rpe_delta : int
        Distance of the two poses of a relative pose error, in poses.

    Returns
    -------
    Evaluation

    Raises
    ------
    TrajectoryError
        If a file cannot be read, fewer than three poses can be associated, `sim3` finds no scale,
        or `origin` lacks a rotation.
    ValueError
        If a segment length, the step or the delta is not positive.
    """
    truth = _given(reference)
    found = _given(estimate, truth)
    return evaluation.evaluate(
        truth.trajectory, found.trajectory, name=name or found.name, **options
    )


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
    first = _read(reference)
    found = [_read(text, first) for text in estimates]
    warnings = [one.warning for one in (first, *found) if one.warning]
    names = _short_names(estimates, [one.name for one in found])
    trajectories = {name: one.trajectory for name, one in zip(names, found, strict=True)}
    return first.trajectory, trajectories, warnings


def _is_in_bag(text: str) -> bool:
    """Tell whether the text is `BAG#WHAT`, or a bag. A file or folder of that name wins."""
    if exists(Path(text)):
        return is_bag(Path(text))
    path, mark, _ = text.partition(_MARK)
    return bool(mark) and exists(Path(path))


def _given(poses: Trajectory | str | Path, reference: Poses | None = None) -> Poses:
    if isinstance(poses, Trajectory):
        return Poses(trajectory=poses, name="estimate")
    return _read(str(poses), reference)


def _read(text: str, reference: Poses | None = None) -> Poses:
    """Read poses; out of a bag, where its tf can, as those of the reference's frame."""
    if _is_in_bag(text):
        return _read_of_bag(text, reference)
    path = Path(text)
    is_recording = path.is_dir()
    if (path / "groundtruth.txt").is_file():
        trajectory = read_trajectory(path / "groundtruth.txt")
    elif is_recording:
        truth = open_recording(path).ground_truth()
        if truth is None:
            raise TrajectoryError(f"{path}: this recording holds no ground truth")
        trajectory = truth
    else:
        trajectory = read_trajectory(path)  # of a pipe too
    return Poses(
        trajectory=trajectory,
        name=path.stem,
        child_frame=_CAMERA if is_recording else "",
        warning=_repeats(text, trajectory),
        is_of_camera=is_recording,
    )


def _read_of_bag(text: str, reference: Poses | None) -> Poses:
    path, _, what = (text, "", "") if exists(Path(text)) else text.partition(_MARK)
    reader = BagReader(Path(path))
    poses = _read_in_bag(reader, what, path)
    child = _camera_frame(path) if poses.is_of_camera else poses.child_frame
    plain = _OWN_FRAME.sub("", child)
    name = what or Path(path).stem
    found = replace(poses, name=name, child_frame=plain, warning=reader.damage)
    if reference is None or not reference.child_frame or not child:
        return found
    if reference.is_of_camera and found.is_of_camera:
        return found
    asked = _frame_of_run(reader, child, reference)
    return found if asked == child else _brought(found, reader, child, asked)


def _read_in_bag(reader: BagReader, what: str, path: str) -> Poses:
    if what:
        return read_poses(reader, parse_bag_truth(what), where=path)
    truth = find_named_truth(reader, path)
    if not isinstance(truth, Failure):
        return truth
    held = [topic.name for topic in reader.topics if topic.type in TRUTH_TYPES]
    if any(topic.type in TF_TYPES for topic in reader.topics):
        held.insert(0, "tf:PARENT:CHILD")
    if not held:
        raise RecordingError(f"{path}: holds no poses: neither tf nor a topic of poses")
    raise RecordingError(f"{path}: name the poses: {', '.join(f'{path}#{name}' for name in held)}")


def _camera_frame(path: str) -> str:
    try:
        return bare(open_recording(path).info.frame_id) or _CAMERA
    except GvoError:  # its poses can be compared without its camera
        return _CAMERA


def _frame_of_run(reader: BagReader, child: str, reference: Poses) -> str:
    """Return the reference's frame by its name in a run's bag; as it is where this is none."""
    own = _OWN_FRAME.match(child)
    if own and reference.is_of_camera:
        # all that a run mounts on its base frame
        return next((c for p, c in read_tf(reader, frames=()).edges if p == child), child)
    return f"{own[0]}{reference.child_frame}" if own else reference.child_frame


def _brought(found: Poses, reader: BagReader, child: str, asked: str) -> Poses:
    """Return poses of another frame of the same body; as they are where that cannot be done."""
    trajectory, reason = found.trajectory, "positions without rotations cannot be moved"
    frame = _OWN_FRAME.sub("", asked)
    if trajectory.has_rotations:
        tree = read_tf(reader, frames=(child, asked))
        T_child_asked, is_known = tree.lookup_many(child, asked, trajectory.stamps_ns)
        if np.any(is_known):
            trajectory = moved(trajectory, T_child_asked, is_known)
            return replace(found, trajectory=trajectory, child_frame=frame)
        reason = "tf does not connect the two"
    apart = f"{found.name} is of {child}, the reference of {frame}: {reason}"
    return replace(found, warning="; ".join(filter(None, [found.warning, apart])))


def _repeats(name: str, trajectory: Trajectory) -> str:
    n = trajectory.n_repeated
    return f"{name}: {n} rows were left out, the next has the same stamp" if n else ""


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
