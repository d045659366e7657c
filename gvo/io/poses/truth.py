"""True poses of the base frame; estimates compared with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gvo.geometry import se3
from gvo.io.bag.reader import MessageReader
from gvo.io.poses.ground_truth import BagTruth, BagTruthSpec, find_named_truth, read_bag_truth
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.poses.tf_paths import bare
from gvo.trajectory.evaluation import Evaluation, evaluate, truth_jump
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, Failure, FloatArray


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Place:
    """A frame rigidly attached to one of tf; an empty name if that is not known."""

    name: str
    T_name_frame: FloatArray = field(default_factory=lambda: np.eye(4))

    def describe(self) -> str:
        return self.name or "the camera, whose frame the recording does not name"


def find_truth(
    reader: MessageReader,
    spec: BagTruthSpec | None = None,
    *,
    where: str,
    base_frame: str = "",
    camera_frame: str = "",
    T_base_cam: FloatArray | None = None,
    buffer: TfBuffer | None = None,
) -> Truth | Failure:
    """Read the truth that `spec` names, else the named truth, as poses of the base frame.

    Parameters
    ----------
    reader : MessageReader
    spec : TfTruth or TopicTruth, optional
        What to read; see `find_named_truth` where omitted.
    where : str
        The bag, for messages.
    base_frame, camera_frame, T_base_cam
        As of `in_frame`.
    buffer : TfBuffer, optional
        Of the bag, with all its frames; read where omitted and needed.

    Returns
    -------
    Truth or Failure
        The failure says why there is none, or why it cannot be compared.

    Raises
    ------
    RecordingError
        When the bag cannot be read, or does not hold what was asked for.
    """
    truth: BagTruth | Failure
    if spec is None:
        truth = find_named_truth(reader, buffer, where=where)
        if isinstance(truth, Failure):
            return truth
    else:
        truth = read_bag_truth(reader, spec, where=where, buffer=buffer)
    if buffer is None:
        frames = [name for name in (truth.child_frame, base_frame, camera_frame) if name]
        buffer = read_tf(reader, frames=frames) if len({*frames}) > 1 else TfBuffer()
    return in_frame(
        truth, buffer, base_frame=base_frame, camera_frame=camera_frame, T_base_cam=T_base_cam
    )


def in_frame(
    truth: BagTruth,
    buffer: TfBuffer,
    *,
    base_frame: str = "",
    camera_frame: str = "",
    T_base_cam: FloatArray | None = None,
) -> Truth | Failure:
    """Bring true poses to the base frame: T_parent_child @ T_child_base.

    Where the messages name no child frame, they are taken for poses of the base frame.
    Positions without rotations stay: estimates are moved to the point instead, by
    `Truth.comparable`; where the place of the point in the base frame is not known it is taken
    for its origin, with a warning.

    Parameters
    ----------
    truth : BagTruth
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
        The failure says why tf does not bring the poses to the base frame.
    """
    camera = _Place(name=bare(camera_frame))
    asked = camera
    if T_base_cam is not None:
        asked = _Place(name=camera.name, T_name_frame=se3.invert(T_base_cam))
    elif base_frame:
        asked = _Place(name=bare(base_frame))
    if not truth.is_of_camera and not truth.child_frame:
        return _framed(truth, f"; it names no frame, taken for {base_frame or 'the camera'}")
    child = camera if truth.is_of_camera else _Place(name=bare(truth.child_frame))
    if child is asked or (not truth.is_of_camera and child.name == bare(base_frame)):
        return _framed(truth, "")
    if not truth.trajectory.has_rotations:
        return _at_point(truth, buffer, child, asked)
    return _moved(truth, buffer, child, asked)


def _moved(truth: BagTruth, buffer: TfBuffer, child: _Place, asked: _Place) -> Truth | Failure:
    trajectory = truth.trajectory
    T_child_asked, is_known, reason = _between(buffer, child, asked, trajectory)
    if not np.any(is_known):
        return Failure(
            reason=f"it is of {child.describe()}, the estimate of {asked.describe()}: {reason}; "
            f"give --frame {child.name or 'FRAME'} and its T_body_cam by --calibration FILE"
        )
    poses = trajectory.T_world_frame[is_known] @ T_child_asked[is_known]
    n_unknown = int(np.count_nonzero(~is_known))
    left_out = f"; {n_unknown} left out where tf does not know it" if n_unknown else ""
    how = "" if child.name == asked.name else f"; brought from {child.name} to {asked.name} by tf"
    framed = _framed(truth, how + left_out)
    return replace(framed, trajectory=replace(trajectory.select(is_known), T_world_frame=poses))


def _at_point(truth: BagTruth, buffer: TfBuffer, child: _Place, asked: _Place) -> Truth:
    T_asked_child, is_known, reason = _between(buffer, asked, child, truth.trajectory)
    framed = _framed(truth, "")
    points = T_asked_child[is_known, :3, 3]
    if len(points) == 0 or not np.allclose(points, points[0], atol=1e-6):
        reason = reason or f"tf moves {child.name} against {asked.name}"
        warning = (
            f"where {child.describe()} lies from {asked.describe()} is not known ({reason}): the "
            "errors hold its lever arm"
        )
        return replace(framed, warning=warning)
    # a point has no directions of its own: only its place counts
    T_asked_point = se3.make_transform(np.eye(3), points[0])
    place = ", ".join(f"{value:.3f}" for value in points[0])
    how = f"; {child.name} lies at ({place}) m from {asked.name} by tf"
    return replace(framed, T_base_point=T_asked_point, decision=f"{framed.decision}{how}")


def _between(
    buffer: TfBuffer, target: _Place, source: _Place, trajectory: Trajectory
) -> tuple[FloatArray, BoolArray, str]:
    """Return T_target_source at each stamp, where it is known, and why where it nowhere is."""
    stamps_ns, reason = trajectory.stamps_ns, ""
    if target.name == source.name:
        T, is_known = np.tile(np.eye(4), (len(stamps_ns), 1, 1)), np.ones(len(stamps_ns), bool)
    elif not target.name or not source.name:
        return np.empty((len(stamps_ns), 4, 4)), np.zeros(len(stamps_ns), bool), "tf cannot tell"
    else:
        T, is_known = buffer.lookup_many(target.name, source.name, stamps_ns)
        if not np.any(is_known):
            found = buffer.lookup(target.name, source.name, int(stamps_ns[0]))
            reason = found.reason if isinstance(found, Failure) else ""
    return se3.invert(target.T_name_frame) @ T @ source.T_name_frame, is_known, reason


def _framed(truth: BagTruth, how: str) -> Truth:
    return Truth(trajectory=truth.trajectory, decision=f"{truth.decision}{how}")


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
        """Compare estimates of the base frame.

        Parameters
        ----------
        truth : Truth
        estimates : mapping of str to Trajectory

        Raises
        ------
        TrajectoryError
            Where nothing can be associated.
        """
        comparable = {name: truth.comparable(estimate) for name, estimate in estimates.items()}
        evaluations = tuple(
            evaluate(truth.trajectory, estimate, name=name) for name, estimate in comparable.items()
        )
        return cls(truth=truth, estimates=comparable, evaluations=evaluations)

    @property
    def truth_jump_m(self) -> float | None:
        """By how much the truth jumps from frame to frame, metres; see `truth_jump`."""
        return truth_jump(self.truth.trajectory, self.estimates["smoothed"])

    def warnings(self) -> list[str]:
        """Return caveats of the errors, a line each."""
        warnings = [self.truth.warning] if self.truth.warning else []
        true_m = _extent(self.truth.trajectory)
        estimated_m = max(map(_extent, self.estimates.values()))
        if estimated_m > _MIN_EXTENT_M and true_m < _MIN_SHARE * estimated_m:
            warnings.append(
                f"it moves by {true_m:.2g} m where the estimate moves by {estimated_m:.2g} m: is "
                "it of another frame, are PARENT and CHILD exchanged?"
            )
        return warnings


def _extent(trajectory: Trajectory) -> float:
    """Return the diagonal of the box around the positions, metres."""
    return float(np.linalg.norm(np.ptp(trajectory.positions, axis=0)))
