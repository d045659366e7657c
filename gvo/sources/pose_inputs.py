"""Poses as `gvo compare` names them: a file, or what lies inside of a bag, `BAG#WHAT`.

`drive.bag#tf:odom:base_link` is a chain of tf, `drive.bag#/odom` a topic of poses or positions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from gvo.bounded_text import exists
from gvo.errors import RecordingError
from gvo.sources.bag_reader import BagReader
from gvo.sources.ground_truth import TRUTH_TYPES, BagTruth, read_bag_truth
from gvo.sources.obvious_truth import find_obvious_truth
from gvo.sources.opening import is_bag
from gvo.sources.tf import read_tf
from gvo.sources.truth_frames import in_frame
from gvo.sources.truth_specs import parse_bag_truth
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure

_MARK = "#"
# The frames of a run's bag are those of the robot under names of their own.
_OWN_FRAME = re.compile(r"^gvo/(raw|causal|smoothed)/")


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
    decision : str
        What was read, in one line; empty for a file.
    warning : str
        What of the bag could not be read, or why they are compared though of another frame than
        the reference; empty where there is nothing.
    """

    name: str
    trajectory: Trajectory
    child_frame: str = ""
    decision: str = ""
    warning: str = ""


def is_in_bag(text: str) -> bool:
    """Tell whether the text is `BAG#WHAT`, or a bag. A file or folder of that name wins."""
    if exists(Path(text)):
        return is_bag(Path(text))
    path, mark, _ = text.partition(_MARK)
    return bool(mark) and exists(Path(path))


def read_poses(text: str) -> Trajectory:
    """Read poses from a file, or out of a bag.

    Parameters
    ----------
    text : str
        A file of poses, `BAG#tf:PARENT:CHILD`, `BAG#TOPIC`, or a bag that names its ground truth.

    Raises
    ------
    TrajectoryError, RecordingError
        When they cannot be read.
    """
    return read_pose_input(text).trajectory


def read_pose_input(text: str, *, frame: str = "") -> PoseInput:
    """Read poses from a file, or out of a bag, with what is known about them.

    Parameters
    ----------
    text : str
        As of `read_poses`.
    frame : str
        The frame that the poses are to be of, by its name in the bag's tf; empty: as they are.

    Returns
    -------
    PoseInput

    Raises
    ------
    TrajectoryError, RecordingError
        When they cannot be read.
    """
    if not is_in_bag(text):
        return PoseInput(name=Path(text).stem, trajectory=read_trajectory(text))
    path, _, what = (text, "", "") if exists(Path(text)) else text.partition(_MARK)
    reader = BagReader(Path(path))
    truth = _read(reader, what, path)
    found = PoseInput(
        name=what or Path(path).stem,
        trajectory=truth.trajectory,
        # what is named ground truth is of the camera, whatever frame it has
        child_frame="" if truth.is_of_camera else _OWN_FRAME.sub("", truth.child_frame),
        decision=truth.decision,
        warning=reader.damage,
    )
    if not frame or found.child_frame in ("", frame):
        return found
    return _brought(found, truth, reader, frame)


def _read(reader: BagReader, what: str, path: str) -> BagTruth:
    if what:
        return read_bag_truth(reader, parse_bag_truth(what), where=path)
    truth = find_obvious_truth(reader, where=path)
    if not isinstance(truth, Failure):
        return truth
    held = [f"{path}{_MARK}{topic.name}" for topic in reader.topics if topic.type in TRUTH_TYPES]
    raise RecordingError(
        f"{path}: name the poses: {', '.join([f'{path}{_MARK}tf:PARENT:CHILD', *held])}"
    )


def _brought(found: PoseInput, truth: BagTruth, reader: BagReader, frame: str) -> PoseInput:
    """Return poses of another frame of the same body; as they are where that cannot be done."""
    reason = "positions without rotations cannot be moved"
    if truth.trajectory.has_rotations:
        tree = read_tf(reader, frames=(truth.child_frame, frame))
        framed = in_frame(truth, tree, frame=frame)
        if not isinstance(framed, Failure):
            return replace(
                found,
                trajectory=framed.trajectory,
                child_frame=frame,
                decision=framed.decision,
            )
        reason = framed.reason
    apart = f"{found.name} is of {truth.child_frame}, the reference of {frame}: {reason}"
    return replace(found, warning="; ".join(filter(None, [found.warning, apart])))
