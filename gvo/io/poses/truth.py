"""True poses: found in a bag, brought to the base frame, compared with estimates."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from gvo._text import exists
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.bag.messages import bare
from gvo.io.bag.poses import POSE_TYPES, POSITION_TYPES, find_topics, pose_messages, read_positions
from gvo.io.bag.reader import MessageReader
from gvo.io.bag.topics import Topic
from gvo.io.edges.events import InputFaults
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.trajectory.evaluation import Evaluation, evaluate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, Failure, FloatArray, IntArray


class TfTruth(NamedTuple):
    """The poses T_parent_child of one frame of `/tf` in another."""

    parent: str
    child: str


BagTruthSpec: TypeAlias = TfTruth | str
"""True poses in a bag: of tf, or of a topic by its name."""

TRUTH_FRAMES = TfTruth("world", "ground_truth")
"""The ground truth in `/tf` as `gvo convert` writes it: T_world_cam of the rectified camera."""

TRUTH_TYPES = (*POSE_TYPES, *POSITION_TYPES)
"""Message types that true poses may have."""

# Motion-capture systems, and usual names of ground truth. Odometry is not ground truth.
_WORDS = (
    *("ground[_-]?truth", "true_?(pose|odom|odometry|state)", "gt"),
    *("vicon", "mocap", "qualisys", "optitrack", "leica", "vrpn"),
)
# as a whole word
_IS_TRUTH = re.compile(rf"(?<![a-z])({'|'.join(_WORDS)})(?![a-z])")


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
    '/vicon/drone'
    """
    if exists(Path(text)):
        return Path(text)
    if text.startswith(("tf:", "topic:", "/")):
        return parse_bag_truth(text)
    raise TrajectoryError(
        f"{text}: there is no such file; expected a file of poses, tf:PARENT:CHILD, or a topic "
        "(/NAME, or topic:NAME)"
    )


def parse_bag_truth(text: str) -> BagTruthSpec:
    """Read what names poses inside of a bag: `tf:PARENT:CHILD`, `topic:NAME` or a topic."""
    kind, _, rest = text.partition(":")
    if kind == "tf" and rest:
        names = [bare(name) for name in rest.split(":")]
        if len(names) != 2 or not all(names) or names[0] == names[1]:
            raise TrajectoryError(f"{text}: expected two frames, as in tf:map:base_link")
        return TfTruth(*names)
    name = rest if kind == "topic" else text
    if not name.strip("/"):
        raise TrajectoryError(f"{text!r} names no topic; expected tf:PARENT:CHILD or a topic")
    return name


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poses:
    """Poses, or positions without rotations, as a bag or a file holds them.

    Parameters
    ----------
    trajectory : Trajectory
        At the stamps of the headers.
    name : str
        Of the topic, the chain or the file.
    child_frame : str
        Whose they are; empty where that is not known.
    decision : str
        What was read, in one line.
    warning : str
        What could not be read, or that they are of another frame than the reference; empty if
        none.
    is_of_camera : bool
        Whether that frame is the rectified camera of the recording, whatever its name in tf.
    """

    trajectory: Trajectory
    name: str = ""
    child_frame: str = ""
    decision: str = ""
    warning: str = ""
    is_of_camera: bool = False


def read_poses(
    reader: MessageReader, spec: BagTruthSpec, *, where: str, buffer: TfBuffer | None = None
) -> Poses:
    """Read poses out of a bag; of a chain of tf a pose at each stamp of one of its moving edges."""
    if isinstance(spec, TfTruth):
        buffer = read_tf(reader, frames=spec) if buffer is None else buffer
        return _of_chain(buffer, spec, where)
    (topic,) = find_topics(reader, [spec], where, types=TRUTH_TYPES)
    return (_of_positions if topic.type in POSITION_TYPES else _of_topic)(reader, topic)


def _of_chain(buffer: TfBuffer, spec: TfTruth, where: str) -> Poses:
    stamps_ns = buffer.edge_stamps_ns(*spec)
    T_parent_child, is_known = buffer.lookup_many(*spec, stamps_ns)
    if not np.any(is_known):
        found = buffer.lookup(*spec, int(stamps_ns[0]) if len(stamps_ns) else 0)
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
    return Poses(
        trajectory=trajectory,
        child_frame=spec.child,
        decision=f"tf {spec.parent} -> {spec.child}, {len(trajectory)} poses{left_out}",
        is_of_camera=spec == TRUTH_FRAMES,
    )


def _of_topic(reader: MessageReader, topic: Topic) -> Poses:
    faults = InputFaults()
    child = ""
    poses: dict[int, FloatArray] = {}  # of several of one stamp the last counts, as in tf
    for pose in pose_messages(reader, topic, faults):
        child, poses[pose.stamp_ns] = pose.child_frame, pose.T_parent_child
    if not poses:
        raise RecordingError(f"{topic.name}: holds no pose: {'; '.join(faults.warnings())}")
    stamps_ns = sorted(poses)
    trajectory = Trajectory(
        stamps_ns=np.array(stamps_ns, dtype=np.int64),
        T_world_frame=np.stack([poses[stamp_ns] for stamp_ns in stamps_ns]),
        stamps_from="topic",
    )
    return _described(topic, trajectory, child, f"{len(poses)} poses", faults.warnings())


def _of_positions(reader: MessageReader, topic: Topic) -> Poses:
    faults = InputFaults()
    trajectory, child, origin = read_positions(reader, topic, faults)
    notes = [*([origin] if origin else []), *faults.warnings()]
    what = f"{len(trajectory)} positions without rotations"
    return _described(topic, trajectory, child, what, notes)


def _described(
    topic: Topic, trajectory: Trajectory, child: str, what: str, notes: Sequence[str]
) -> Poses:
    of = f" of {child}" if child else ""
    decision = "; ".join([f"{topic.name} ({topic.type}), {what}{of}", *notes])
    return Poses(trajectory=trajectory, child_frame=child, decision=decision)


def find_named_truth(
    reader: MessageReader, where: str, buffer: TfBuffer | None = None
) -> Poses | Failure:
    """Find the ground truth by its name: `world` -> `ground_truth` in tf, or one topic."""
    buffer = read_tf(reader, frames=TRUTH_FRAMES) if buffer is None else buffer
    if len(buffer.edge_stamps_ns(*TRUTH_FRAMES)):
        return _of_chain(buffer, TRUTH_FRAMES, where)
    named = [
        topic
        for topic in reader.topics
        if topic.type in TRUTH_TYPES and topic.n_messages and _IS_TRUTH.search(topic.name.lower())
    ]
    if not named:
        return Failure(reason="no frame and no topic is named as ground truth")
    if len(named) > 1:
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in named)
        return Failure(
            reason=f"{len(named)} topics are named as ground truth: {names}; choose by "
            f"--ground-truth topic:{named[0].name}"
        )
    return read_poses(reader, named[0].name, where=where)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """True poses of the base frame, to compare estimates with.

    Parameters
    ----------
    trajectory : Trajectory
        T_parent_base; or positions of the measured point, without rotations.
    decision : str
        What was read and how it was brought to the base frame, in one line.
    T_base_point : ndarray of float64, shape (4, 4)
        Where that point lies in the base frame, metres; the identity for poses.
    warning : str
        A caveat of the errors, in one line; empty if none.
    """

    trajectory: Trajectory
    decision: str
    T_base_point: FloatArray = field(default_factory=lambda: np.eye(4))
    warning: str = ""

    def comparable(self, estimate: Trajectory) -> Trajectory:
        """Return the estimate of the base frame, moved to the point of the true positions."""
        if np.array_equal(self.T_base_point, np.eye(4)):
            return estimate
        return estimate.transformed(self.T_base_point)


def in_frame(
    found: Poses,
    buffer: TfBuffer,
    *,
    base_frame: str = "",
    camera_frame: str = "",
    T_base_cam: FloatArray | None = None,
) -> Truth | Failure:
    """Bring true poses to the base frame.

    Where the messages name no child frame, they are taken for poses of the base frame. Positions
    without rotations stay: estimates are moved to the point instead, by `Truth.comparable`; where
    the place of the point in the base frame is not known it is taken for its origin, with a
    warning.

    Parameters
    ----------
    found : Poses
    buffer : TfBuffer
        Of the bag.
    base_frame : str
        Its name in tf; empty: the rectified camera.
    camera_frame : str
        Of the rectified camera in tf; empty where the recording names none.
    T_base_cam : ndarray of float64, shape (4, 4), optional
        Where the camera is mounted on it, metres, if that does not come from tf.

    Returns
    -------
    Truth or Failure
        The failure says why they cannot be brought to the base frame.
    """
    camera_frame, base_frame = bare(camera_frame), bare(base_frame)
    child = camera_frame if found.is_of_camera else bare(found.child_frame)
    is_camera = T_base_cam is None and not base_frame
    if not found.is_of_camera and not child:
        taken = f"; it names no frame, taken for {base_frame or 'the camera'}"
        return Truth(trajectory=found.trajectory, decision=f"{found.decision}{taken}")
    if is_camera if found.is_of_camera else child == base_frame:
        return Truth(trajectory=found.trajectory, decision=found.decision)
    asked = base_frame if base_frame and T_base_cam is None else camera_frame
    T_child_asked, is_known, reason = _between(buffer, child, asked, found.trajectory.stamps_ns)
    if T_base_cam is not None:
        T_child_asked = T_child_asked @ se3.invert(T_base_cam)
    if not found.trajectory.has_rotations:
        points = se3.invert(T_child_asked[is_known])[:, :3, 3]
        return _at_point(found, points, (child, asked), reason)
    return _brought(found, T_child_asked, is_known, (child, asked), reason)


def _between(
    buffer: TfBuffer, target: str, source: str, stamps_ns: IntArray
) -> tuple[FloatArray, BoolArray, str]:
    """Return T_target_source at each stamp, where it is known, and why where it nowhere is."""
    if target == source:
        n = len(stamps_ns)
        return np.tile(np.eye(4), (n, 1, 1)), np.ones(n, np.bool_), ""
    if not target or not source:
        n = len(stamps_ns)
        return np.empty((n, 4, 4)), np.zeros(n, np.bool_), "tf cannot tell"
    T, is_known = buffer.lookup_many(target, source, stamps_ns)
    found = None if np.any(is_known) else buffer.lookup(target, source, int(stamps_ns[0]))
    return T, is_known, found.reason if isinstance(found, Failure) else ""


def moved(trajectory: Trajectory, T_frame_other: FloatArray, is_known: BoolArray) -> Trajectory:
    """Return poses of another frame of the same body, where its place is known."""
    known = trajectory.select(is_known)
    T_world_other = known.T_world_frame @ T_frame_other[is_known]
    return replace(known, T_world_frame=T_world_other, covariances=None)


def _brought(
    found: Poses, T_child_asked: FloatArray, is_known: BoolArray, ends: tuple[str, str], reason: str
) -> Truth | Failure:
    """Return true poses T_parent_child @ T_child_asked."""
    if not np.any(is_known):
        child, asked = map(_named, ends)
        return Failure(
            reason=f"its poses are of {child}, those of the estimate of {asked}: {reason}; "
            f"give --frame {ends[0] or 'FRAME'} and its T_body_cam by --calibration FILE"
        )
    how = "" if ends[0] == ends[1] else f"; brought from {ends[0]} to {ends[1]} by tf"
    n_unknown = int(np.count_nonzero(~is_known))
    how += f"; {n_unknown} left out where tf does not know it" if n_unknown else ""
    trajectory = moved(found.trajectory, T_child_asked, is_known)
    return Truth(trajectory=trajectory, decision=f"{found.decision}{how}")


def _named(frame: str) -> str:
    return frame or "the camera, whose frame the recording does not name"


def _at_point(found: Poses, points: FloatArray, ends: tuple[str, str], reason: str) -> Truth:
    """Return true positions of a point, from its places (n, 3) in the base frame."""
    child, asked = map(_named, ends)
    if len(points) == 0 or not np.allclose(points, points[0], atol=1e-6):
        reason = reason or f"tf moves {child} against {asked}"
        warning = (
            f"where {child} lies from {asked} is not known ({reason}): the errors include its "
            "lever arm"
        )
        return Truth(trajectory=found.trajectory, decision=found.decision, warning=warning)
    place = ", ".join(f"{value:.3f}" for value in points[0])
    return Truth(
        trajectory=found.trajectory,
        decision=f"{found.decision}; {child} lies at ({place}) m from {asked} by tf",
        # a point has no directions of its own: only its place counts
        T_base_point=se3.make_transform(np.eye(3), points[0]),
    )


# Truth that stands still while the estimate moves is of something else.
_MIN_EXTENT_M = 0.1
_MIN_SHARE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthComparison:
    """Estimates compared with the truth, and their errors.

    Parameters
    ----------
    truth : Truth
    estimates : dict of str to Trajectory
        By name; of the point that the truth measured, where that holds positions only.
    evaluations : tuple of Evaluation
        In the same order.
    """

    truth: Truth
    estimates: dict[str, Trajectory]
    evaluations: tuple[Evaluation, ...]

    @classmethod
    def of(cls, truth: Truth, estimates: Mapping[str, Trajectory]) -> TruthComparison:
        """Compare estimates of the base frame."""
        comparable = {name: truth.comparable(estimate) for name, estimate in estimates.items()}
        evaluations = tuple(
            evaluate(truth.trajectory, estimate, name=name) for name, estimate in comparable.items()
        )
        return cls(truth=truth, estimates=comparable, evaluations=evaluations)

    def warnings(self) -> list[str]:
        """Return caveats of the errors, a line each."""
        warnings = [self.truth.warning] if self.truth.warning else []
        true_m = _extent(self.truth.trajectory)
        estimated_m = max(map(_extent, self.estimates.values()))
        if estimated_m > _MIN_EXTENT_M and true_m < _MIN_SHARE * estimated_m:
            warnings.append(
                f"it moves by {true_m:.2g} m, the estimate by {estimated_m:.2g} m: is it of "
                "another frame, or are PARENT and CHILD exchanged?"
            )
        return warnings


def _extent(trajectory: Trajectory) -> float:
    """Return the diagonal of the box around the positions, metres."""
    return float(np.linalg.norm(np.ptp(trajectory.positions, axis=0)))


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
