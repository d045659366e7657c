"""Streams of poses, as odometry gives them, turned into edges between consecutive poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.events import Event, InputFaults, PoseEvent, anchor
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, Edge, FloatArray, IntArray

MAX_GAP = 5.0
"""Poses are interpolated between neighbours nearer in time than so many usual steps."""

_MIN_RELATIVE_EIGENVALUE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseStream:
    """Poses of one frame over time, in a world of their own.

    Parameters
    ----------
    name : str
        Of the file or topic.
    poses : Trajectory
        Without covariances.
    covariances : ndarray of float64, shape (n, 6, 6)
        Of the poses, (rx, ry, rz, tx, ty, tz), right perturbation, in the frame; NaN where not
        known.
    decision : str
        How it was read; empty if there is nothing to say.
    broken_off : str
        Why it could not be read to its end; empty if it was.
    """

    name: str
    poses: Trajectory
    covariances: FloatArray
    decision: str = ""
    broken_off: str = ""


def read_stream(path: Path) -> PoseStream:
    """Read a file of poses, with the covariances of the file beside it."""
    poses, decision = read_trajectory(path), ""
    covariances = np.full((len(poses), 6, 6), np.nan)
    if poses.covariances is not None:
        covariances = poses.covariances
        decision = f"{path.stem}: covariances of {path.stem}_covariance.csv"
    poses = replace(poses, covariances=None)
    return PoseStream(name=path.stem, poses=poses, covariances=covariances, decision=decision)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepSigma:
    """How sure the step between two poses is, where the input does not say.

    The sigmas of a step are a floor, plus a share of the turn and of the distance, plus a turn
    per metre. The defaults are of an odometry of the better kind.

    Parameters
    ----------
    floor_rad, floor_m : float
        Of a step that does not move.
    share : float
        Of the angle and of the distance.
    rad_per_m : float
        Rotation sigma per metre of distance.
    """

    floor_rad: float = np.radians(0.02)
    floor_m: float = 0.002
    share: float = 0.01
    rad_per_m: float = np.radians(0.02)

    @classmethod
    def fixed(cls, rotation_rad: float, translation_m: float) -> StepSigma:
        """Return the same sigmas, radians and metres, for all steps."""
        return cls(floor_rad=rotation_rad, floor_m=translation_m, share=0.0, rad_per_m=0.0)

    def covariance(self, T_a_b: FloatArray) -> FloatArray:
        """Return the covariance, shape (6, 6), of a step of shape (4, 4)."""
        distance = float(np.linalg.norm(T_a_b[:3, 3]))
        angle = float(se3.rotation_angle(T_a_b))
        rotation = self.floor_rad + self.share * angle + self.rad_per_m * distance
        translation = self.floor_m + self.share * distance
        return np.diag(np.repeat([rotation, translation], 3)) ** 2

    def describe(self) -> str:
        """Return the sigmas in words."""
        floor = f"{np.degrees(self.floor_rad):g} deg, {self.floor_m:g} m"
        if not self.share:
            return f"{floor} a step"
        turn = f"{np.degrees(self.rad_per_m):g} deg/m"
        return f"{floor} and {100 * self.share:g} % of the motion and {turn}"


class FusedChains:
    """Several odometries of one moving frame, each a chain of edges, as one graph.

    The poses are those of the first stream, in its world. Each other stream is interpolated at
    their stamps, where two neighbours are not more than `MAX_GAP` usual steps apart, and gives
    an edge between consecutive poses that it covers both. Nothing is extrapolated. All streams
    must be of the same moving frame; their worlds may differ.

    Parameters
    ----------
    streams : sequence of PoseStream
        At least one.
    sigmas : sequence of StepSigma
        One for each.
    faults : InputFaults, optional
        What could not be used when they were read.

    Raises
    ------
    TrajectoryError
        Where some streams have stamps and some have not.
    """

    def __init__(
        self,
        streams: Sequence[PoseStream],
        sigmas: Sequence[StepSigma],
        faults: InputFaults | None = None,
    ) -> None:
        self._streams, self._sigmas = streams, sigmas
        self.name = streams[0].name
        self.faults = faults or InputFaults()
        self.n_poses = len(streams[0].poses)
        bare = [stream.poses.stamps_from == "rows" for stream in streams]
        if any(bare) and not all(bare):
            raise TrajectoryError(
                f"{streams[bare.index(True)].name} holds rows of poses without stamps, "
                f"{streams[bare.index(False)].name} has stamps; put a times.txt with one stamp "
                "in seconds per row beside the poses"
            )
        self.has_made_up_stamps = all(bare)
        self.decisions = [stream.decision for stream in streams if stream.decision]
        if self.has_made_up_stamps:
            self.decisions.append("stamps: the row of each pose, a second each; no file has any")
        self.decisions += [
            f"{stream.name}: sigma {sigma.describe()}, where it states no covariance"
            for stream, sigma in zip(streams, sigmas, strict=True)
        ]
        if len(streams) > 1:
            self.decisions.append(f"fused at the {self.n_poses} poses of {self.name}")

    def events(self) -> Iterator[Event]:
        """Yield the poses of the first stream, each with the edges of all streams.

        Raises
        ------
        RecordingError
            At the end, if a stream could not be read to its own.
        """
        first = self._streams[0].poses
        pairs = zip(self._streams, self._sigmas, strict=True)
        chains = [self._steps(stream, sigma, first.stamps_ns) for stream, sigma in pairs]
        for i, stamp_ns in enumerate(first.stamps_ns.tolist()):
            yield PoseEvent(
                frame_id=stamp_ns,
                stamp_ns=stamp_ns,
                edges=tuple(edge for edge in map(next, chains) if edge is not None),
                prior=anchor(first.T_world_frame[0]) if i == 0 else None,
            )
        for stream in self._streams:
            if stream.broken_off:
                raise RecordingError(stream.broken_off)

    def _steps(
        self, stream: PoseStream, sigma: StepSigma, stamps_ns: IntArray
    ) -> Iterator[Edge | None]:
        """Yield for each stamp the edge from the one before, where the stream covers both."""
        T, covariances, is_known = _at(stream, stamps_ns)
        is_step = np.zeros(len(stamps_ns), dtype=np.bool_)
        is_step[1:] = is_known[1:] & is_known[:-1]
        if len(stamps_ns) > 1 and not is_step.any():
            kind = "inputs have no two poses at the stamps of the first and give no edge"
            self.faults.add(kind, stream.name)
        for i, has_edge in enumerate(is_step.tolist()):
            if not has_edge:
                yield None
                continue
            T_a_b = se3.invert(T[i - 1]) @ T[i]
            yield Edge(
                reference_id=int(stamps_ns[i - 1]),
                T_reference_frame=T_a_b,
                covariance=step_covariance(T_a_b, covariances[i - 1], covariances[i], sigma),
            )


def _at(stream: PoseStream, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Interpolate a stream: poses (n, 4, 4), covariances (n, 6, 6), and where they are known."""
    own_ns = stream.poses.stamps_ns
    T, covariances = np.empty((len(stamps_ns), 4, 4)), np.full((len(stamps_ns), 6, 6), np.nan)
    if len(own_ns) == 0:
        return T, covariances, np.zeros(len(stamps_ns), dtype=np.bool_)
    steps_ns = np.diff(own_ns)
    max_gap_ns = int(MAX_GAP * np.median(steps_ns)) if len(steps_ns) else 0
    found = stream.poses.interpolate(stamps_ns, max_gap_ns=max_gap_ns)
    is_known = np.isin(stamps_ns, found.stamps_ns)
    T[is_known] = found.T_world_frame
    is_own = np.isin(stamps_ns, own_ns)  # needs no interpolation
    rows = np.searchsorted(own_ns, stamps_ns[is_own])
    T[is_own], covariances[is_own] = stream.poses.T_world_frame[rows], stream.covariances[rows]
    is_between = is_known & ~is_own
    after = np.searchsorted(own_ns, stamps_ns[is_between])
    spans_ns = own_ns[after] - own_ns[after - 1]
    shares = ((stamps_ns[is_between] - own_ns[after - 1]) / spans_ns)[:, np.newaxis, np.newaxis]
    before, beyond = stream.covariances[after - 1], stream.covariances[after]
    covariances[is_between] = (1.0 - shares) * before + shares * beyond
    return T, covariances, is_known


def step_covariance(
    T_a_b: FloatArray, covariance_a: FloatArray, covariance_b: FloatArray, sigma: StepSigma
) -> FloatArray:
    """Return the covariance of the step between two poses of one stream.

    The covariance of odometry grows with the way: the step's is the growth. Where there is no
    growth the poses are taken for independent fixes: the step's is the sum. Where a pose has no
    covariance, or one that is not positive definite, it comes of `sigma`.

    Parameters
    ----------
    T_a_b : ndarray of float64, shape (4, 4)
    covariance_a, covariance_b : ndarray of float64, shape (6, 6)
        Of both poses, NaN where not known.
    sigma : StepSigma

    Returns
    -------
    ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in frame b.
    """
    is_stated = np.isfinite(covariance_a).all()
    if not is_stated or not _is_definite(covariance_b, scale=covariance_b):
        return sigma.covariance(T_a_b)
    moved = se3.transport_covariance(covariance_a, se3.invert(T_a_b))
    step = covariance_b - moved
    if not _is_definite(step, scale=covariance_b):
        if not _is_definite(covariance_a, scale=covariance_a):
            return sigma.covariance(T_a_b)
        step = covariance_b + moved
    return np.asarray(0.5 * (step + step.T))


def _is_definite(matrix: FloatArray, *, scale: FloatArray) -> bool:
    """Tell whether a matrix is positive definite by more than the rounding of another."""
    sigmas = np.sqrt(np.maximum(np.diag(scale), 0.0))
    if not np.isfinite(matrix).all() or sigmas.min() <= 0.0:
        return False
    scaled = matrix / np.outer(sigmas, sigmas)
    return bool(np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[0] > _MIN_RELATIVE_EIGENVALUE)
