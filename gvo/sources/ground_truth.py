"""True poses out of a bag: a chain of tf, a topic of poses, fixes or points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvo.errors import RecordingError
from gvo.sources.bag_reader import BagReader
from gvo.sources.edges import InputFaults
from gvo.sources.pose_topics import POSE_TYPES, TopicStream, find_topics
from gvo.sources.position_topics import POSITION_TYPES, read_positions
from gvo.sources.tf import TfBuffer, read_tf
from gvo.sources.topics import Topic
from gvo.sources.truth_specs import BagTruthSpec, TfTruth
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure

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
    reader: BagReader, spec: BagTruthSpec, *, where: str, buffer: TfBuffer | None = None
) -> BagTruth:
    """Read true poses out of a bag.

    Parameters
    ----------
    reader : BagReader
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
    read = _of_positions if topic.type in POSITION_TYPES else _of_poses
    return read(reader, topic)


def _reason(buffer: TfBuffer, spec: TfTruth, stamp_ns: int) -> str:
    found = buffer.lookup(spec.parent, spec.child, stamp_ns)
    return found.reason if isinstance(found, Failure) else "they do not move in tf"


def _of_chain(buffer: TfBuffer, spec: TfTruth, where: str) -> BagTruth:
    stamps_ns = buffer.edge_stamps_ns(spec.parent, spec.child)
    T_parent_child, is_known = buffer.lookup_many(spec.parent, spec.child, stamps_ns)
    if not np.any(is_known):
        at_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
        reason = _reason(buffer, spec, at_ns)
        raise RecordingError(
            f"{where}: holds no poses of {spec.child} in {spec.parent}: "
            f"{'; '.join([reason, *buffer.notes])}"
        )
    n_unknown = int(np.count_nonzero(~is_known))
    left_out = f"; {n_unknown} stamps where not all of the chain is known" if n_unknown else ""
    trajectory = Trajectory(
        stamps_ns=stamps_ns[is_known],
        T_world_cam=T_parent_child[is_known],
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


def _of_poses(reader: BagReader, topic: Topic) -> BagTruth:
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
            T_world_cam=np.stack([poses[int(stamp_ns)] for stamp_ns in stamps_ns]),
            stamps_from="topic",
        ),
        parent_frame=stream.parent_frame,
        child_frame=stream.child_frame,
        decision=_describe(topic, f"{len(stamps_ns)} poses", stream.child_frame, faults.warnings()),
    )


def _of_positions(reader: BagReader, topic: Topic) -> BagTruth:
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
