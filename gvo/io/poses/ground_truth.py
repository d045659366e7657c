"""Ground truth in a bag: named by the user, or found by the name of its topic."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gvo._text import exists
from gvo.errors import RecordingError, TrajectoryError
from gvo.io.bag.poses import POSE_TYPES, POSITION_TYPES, TopicStream, find_topics, read_positions
from gvo.io.bag.reader import MessageReader
from gvo.io.bag.topics import Topic
from gvo.io.edges.events import InputFaults
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.poses.tf_paths import bare
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure

_KINDS = "a file of poses, tf:PARENT:CHILD, or a topic (/NAME, or topic:NAME)"


@dataclass(frozen=True, slots=True, kw_only=True)
class TfTruth:
    """The poses of one frame of `/tf` in another.

    Parameters
    ----------
    parent, child : str
        T_parent_child is the pose.
    """

    parent: str
    child: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicTruth:
    """The poses or positions of one topic.

    Parameters
    ----------
    name : str
    """

    name: str


BagTruthSpec: TypeAlias = TfTruth | TopicTruth


def parse_truth(text: str) -> BagTruthSpec | Path:
    """Read what `--ground-truth` names: poses in the bag, or of a file or another recording.

    Parameters
    ----------
    text : str
        A path, which wins where it exists; `tf:PARENT:CHILD`; `/TOPIC` or `topic:TOPIC`.

    Raises
    ------
    TrajectoryError
        Where it is none of them.

    Examples
    --------
    >>> parse_truth("tf:map:base_link")
    TfTruth(parent='map', child='base_link')
    >>> parse_truth("/vicon/drone")
    TopicTruth(name='/vicon/drone')
    """
    if exists(Path(text)):
        return Path(text)
    spec = parse_bag_truth(text) if text.startswith(("tf:", "topic:", "/")) else None
    if spec is None:
        raise TrajectoryError(f"{text}: there is no such file; expected {_KINDS}")
    return spec


def parse_bag_truth(text: str) -> BagTruthSpec:
    """Read what names poses inside of a bag: `tf:PARENT:CHILD`, `topic:NAME` or a topic.

    Raises
    ------
    TrajectoryError
        When a part is missing, or there is one too many.
    """
    kind, _, rest = text.partition(":")
    if kind == "tf" and rest:
        names = [bare(name) for name in rest.split(":")]
        if len(names) != 2 or not all(names) or names[0] == names[1]:
            raise TrajectoryError(f"{text}: expected two frames, as in tf:map:base_link")
        return TfTruth(parent=names[0], child=names[1])
    name = rest if kind == "topic" else text
    if not name.strip("/"):
        raise TrajectoryError(f"{text!r} names no topic; expected tf:PARENT:CHILD or a topic")
    return TopicTruth(name=name)


TRUTH_FRAMES = TfTruth(parent="world", child="ground_truth")
"""The ground truth in `/tf` as `gvo convert` writes it: T_world_cam of the rectified camera."""

TRUTH_TYPES = (*POSE_TYPES, *POSITION_TYPES)
"""Message types that ground truth may have."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagTruth:
    """True poses as a bag holds them.

    Parameters
    ----------
    trajectory : Trajectory
        T_parent_child at the stamps of the headers, or positions without rotations.
    parent_frame : str
        Empty where the messages name none, or where it is the first fix.
    child_frame : str
        Empty where the messages name none.
    decision : str
        What was read, in one line.
    is_of_camera : bool
        Whether the child is the rectified camera of the recording, whatever its name in tf.
    """

    trajectory: Trajectory
    parent_frame: str
    child_frame: str
    decision: str
    is_of_camera: bool = False


def read_bag_truth(
    reader: MessageReader, spec: BagTruthSpec, *, where: str, buffer: TfBuffer | None = None
) -> BagTruth:
    """Read true poses out of a bag.

    Parameters
    ----------
    reader : MessageReader
    spec : TfTruth or TopicTruth
    where : str
        The bag, for messages.
    buffer : TfBuffer, optional
        Of the bag; read from it where omitted and needed.

    Returns
    -------
    BagTruth
        Of a chain of tf a pose at each stamp of one of its moving edges.

    Raises
    ------
    RecordingError
        When the bag cannot be read, or holds no such poses.
    """
    if isinstance(spec, TfTruth):
        if buffer is None:
            buffer = read_tf(reader, frames=(spec.parent, spec.child))
        return _of_chain(buffer, spec, where)
    (topic,) = find_topics(reader, [spec.name], where, types=TRUTH_TYPES)
    return (_of_positions if topic.type in POSITION_TYPES else _of_poses)(reader, topic)


def _of_chain(buffer: TfBuffer, spec: TfTruth, where: str) -> BagTruth:
    stamps_ns = buffer.edge_stamps_ns(spec.parent, spec.child)
    T_parent_child, is_known = buffer.lookup_many(spec.parent, spec.child, stamps_ns)
    if not np.any(is_known):
        at_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
        found = buffer.lookup(spec.parent, spec.child, at_ns)
        reason = found.reason if isinstance(found, Failure) else "they do not move in tf"
        raise RecordingError(
            f"{where}: holds no poses of {spec.child} in {spec.parent}: "
            f"{'; '.join([reason, *buffer.notes])}"
        )
    n_unknown = int(np.count_nonzero(~is_known))
    left_out = f"; {n_unknown} stamps where not all of the chain is known" if n_unknown else ""
    trajectory = Trajectory(
        stamps_ns=stamps_ns[is_known],
        T_world_frame=T_parent_child[is_known],
        # as data sets are written: at the stamps of their files
        stamps_from="file" if spec == TRUTH_FRAMES else "topic",
    )
    return BagTruth(
        trajectory=trajectory,
        parent_frame=spec.parent,
        child_frame=spec.child,
        decision=f"tf {spec.parent} -> {spec.child}, {len(trajectory)} poses{left_out}",
        is_of_camera=spec == TRUTH_FRAMES,
    )


def _of_poses(reader: MessageReader, topic: Topic) -> BagTruth:
    faults = InputFaults()
    stream = TopicStream(reader, topic)
    # of several of one stamp the last counts, as in tf
    poses = {sample.stamp_ns: sample.T_world_frame for sample in stream.samples(faults)}
    if not poses:
        raise RecordingError(f"{topic.name}: holds no pose: {'; '.join(faults.warnings())}")
    stamps_ns = np.array(sorted(poses), dtype=np.int64)
    return BagTruth(
        trajectory=Trajectory(
            stamps_ns=stamps_ns,
            T_world_frame=np.stack([poses[int(stamp_ns)] for stamp_ns in stamps_ns]),
            stamps_from="topic",
        ),
        parent_frame=stream.parent_frame,
        child_frame=stream.child_frame,
        decision=_describe(topic, f"{len(stamps_ns)} poses", stream.child_frame, faults.warnings()),
    )


def _of_positions(reader: MessageReader, topic: Topic) -> BagTruth:
    faults = InputFaults()
    found = read_positions(reader, topic, faults)
    notes = [found.origin] if found.origin else []
    what = f"{len(found.stamps_ns)} positions without rotations"
    return BagTruth(
        trajectory=Trajectory.of_positions(found.stamps_ns, found.positions, stamps_from="topic"),
        parent_frame=found.parent_frame,
        child_frame=found.child_frame,
        decision=_describe(topic, what, found.child_frame, notes + faults.warnings()),
    )


def _describe(topic: Topic, what: str, child: str, notes: Sequence[str]) -> str:
    of = f" of {child}" if child else ""
    return "; ".join([f"{topic.name} ({topic.type}), {what}{of}", *notes])


# Motion-capture systems, and usual names of ground truth. Odometry is not ground truth.
_WORDS = (
    *("ground[_-]?truth", "true_?(pose|odom|odometry|state)", "gt"),
    *("vicon", "mocap", "qualisys", "optitrack", "leica", "vrpn"),
)
# as a whole word
_IS_TRUTH = re.compile(rf"(?<![a-z])({'|'.join(_WORDS)})(?![a-z])")


def is_named_truth(topic: str) -> bool:
    """Tell whether a topic's name says that it holds true poses.

    Examples
    --------
    >>> [is_named_truth(name) for name in ("/vrpn_client_node/drone/pose", "/gt_pose", "/odom")]
    [True, True, False]
    """
    return _IS_TRUTH.search(topic.lower()) is not None


def find_named_truth(
    reader: MessageReader, buffer: TfBuffer | None = None, *, where: str
) -> BagTruth | Failure:
    """Find the ground truth by its name: `world` -> `ground_truth` in tf, or one topic.

    Parameters
    ----------
    reader : MessageReader
    buffer : TfBuffer, optional
        Of the bag; read from it where omitted.
    where : str
        The bag, for messages.

    Returns
    -------
    BagTruth or Failure
        The failure says that there is none, or which topics to choose from.

    Raises
    ------
    RecordingError
        When the bag cannot be read on, or the named truth holds no pose.
    """
    frames = (TRUTH_FRAMES.parent, TRUTH_FRAMES.child)
    buffer = read_tf(reader, frames=frames) if buffer is None else buffer
    if len(buffer.edge_stamps_ns(*frames)):
        return read_bag_truth(reader, TRUTH_FRAMES, where=where, buffer=buffer)
    candidates = truth_topics(reader.topics)
    if not candidates:
        return Failure(reason="no frame and no topic is named as ground truth")
    if len(candidates) > 1:
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in candidates)
        return Failure(
            reason=f"{len(candidates)} topics are named as ground truth: {names}; choose by "
            f"--ground-truth topic:{candidates[0].name}"
        )
    return read_bag_truth(reader, TopicTruth(name=candidates[0].name), where=where)


def truth_topics(topics: Sequence[Topic]) -> list[Topic]:
    """Return the topics of poses or positions whose names say that they hold the truth."""
    return [
        topic
        for topic in topics
        if topic.type in TRUTH_TYPES and topic.n_messages and is_named_truth(topic.name)
    ]
