"""Streams of poses, as odometry gives them, turned into edges between consecutive poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Protocol

import numpy as np

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.events import Event, InputFaults, PoseEvent, anchor
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import StampsFrom
from gvo.types import Edge, FloatArray

MAX_GAP = 5.0
"""Poses are interpolated between neighbours nearer in time than so many of the steps before."""

_N_STEPS = 51
_MIN_RELATIVE_EIGENVALUE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseSample:
    """One pose of a stream.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.
    T_world_frame : ndarray of float64, shape (4, 4)
        In the stream's own world, metres.
    covariance : ndarray of float64, shape (6, 6), optional
        Of the pose, (rx, ry, rz, tx, ty, tz), right perturbation, in the frame.
    """

    stamp_ns: int
    T_world_frame: FloatArray
    covariance: FloatArray | None = None


class PoseStream(Protocol):
    """Poses of one frame over time, in a world of its own; `stamps_from` as of `Trajectory`."""

    name: str
    decisions: list[str]
    n_poses: int
    stamps_from: StampsFrom

    def samples(self, faults: InputFaults) -> Iterator[PoseSample]:
        """Yield the poses; note in `faults` what was skipped."""
        ...


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


class TrajectoryStream:
    """The poses of a TUM, KITTI or EuRoC file, with the covariances of the file beside it."""

    def __init__(self, path: Path) -> None:
        self._trajectory = read_trajectory(path)
        self.name = path.stem
        self.n_poses = len(self._trajectory)
        self.stamps_from: StampsFrom = self._trajectory.stamps_from
        self.decisions: list[str] = []
        if self._trajectory.covariances is not None:
            self.decisions.append(f"{self.name}: covariances of {self.name}_covariance.csv")

    def samples(self, faults: InputFaults) -> Iterator[PoseSample]:
        """Yield the poses."""
        covariances = self._trajectory.covariances
        for i, stamp_ns in enumerate(self._trajectory.stamps_ns):
            yield PoseSample(
                stamp_ns=int(stamp_ns),
                T_world_frame=self._trajectory.T_world_frame[i],
                covariance=None if covariances is None else covariances[i],
            )


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

    Raises
    ------
    TrajectoryError
        Where some streams have stamps and some have not.
    """

    def __init__(self, streams: Sequence[PoseStream], sigmas: Sequence[StepSigma]) -> None:
        self._streams, self._sigmas = streams, sigmas
        self.name = streams[0].name
        self.faults = InputFaults()
        self.n_poses = streams[0].n_poses
        bare = [stream.stamps_from == "rows" for stream in streams]
        if any(bare) and not all(bare):
            raise TrajectoryError(
                f"{streams[bare.index(True)].name} holds rows of poses without stamps, "
                f"{streams[bare.index(False)].name} has stamps; put a times.txt with one stamp "
                "in seconds per row beside the poses"
            )
        self.has_made_up_stamps = all(bare)
        self.decisions = [line for stream in streams for line in stream.decisions]
        if self.has_made_up_stamps:
            self.decisions.append("stamps: the row of each pose, a second each; no file has any")
        self.decisions += [
            f"{stream.name}: sigma {sigma.describe()}, where it states no covariance"
            for stream, sigma in zip(streams, sigmas, strict=True)
        ]
        if len(streams) > 1:
            self.decisions.append(f"fused at the {self.n_poses} poses of {self.name}")

    def events(self) -> Iterator[Event]:
        """Yield the poses of the first stream, each with the edges of all streams."""
        followers = [
            _Follower(_ordered(stream, self.faults), sigma)
            for stream, sigma in zip(self._streams[1:], self._sigmas[1:], strict=True)
        ]
        before: PoseSample | None = None
        for sample in _ordered(self._streams[0], self.faults):
            edges = [edge for follower in followers for edge in follower.edges(sample.stamp_ns)]
            if before is not None:
                edges.insert(0, _step(before, sample, self._sigmas[0]))
            prior = anchor(sample.T_world_frame) if before is None else None
            before = sample
            yield PoseEvent(
                frame_id=sample.stamp_ns, stamp_ns=sample.stamp_ns, edges=tuple(edges), prior=prior
            )
        for stream, follower in zip(self._streams[1:], followers, strict=True):
            if follower.n_edges == 0:
                kind = "inputs have no two poses at the stamps of the first and give no edge"
                self.faults.add(kind, stream.name)


def _ordered(stream: PoseStream, faults: InputFaults) -> Iterator[PoseSample]:
    """Yield the poses of a stream whose stamp is later than that before; count the others."""
    last_ns: int | None = None
    for sample in stream.samples(faults):
        if last_ns is not None and sample.stamp_ns <= last_ns:
            first = f"{sample.stamp_ns} ns after {last_ns} ns in {stream.name}"
            faults.add("poses have a stamp that does not advance and were skipped", first)
            continue
        last_ns = sample.stamp_ns
        yield sample


class _Follower:
    """A stream that is read along the stamps of another."""

    def __init__(self, samples: Iterator[PoseSample], sigma: StepSigma) -> None:
        self.n_edges = 0
        self._samples, self._sigma = samples, sigma
        self._before: PoseSample | None = None
        self._after: PoseSample | None = next(samples, None)
        self._steps_ns: deque[int] = deque(maxlen=_N_STEPS)
        self._is_in_gap = False
        self._last: PoseSample | None = None

    def edges(self, stamp_ns: int) -> list[Edge]:
        """Return the edge from the stamp asked for before, where the stream covers both."""
        last, self._last = self._last, self._at(stamp_ns)
        if last is None or self._last is None:
            return []
        self.n_edges += 1
        return [_step(last, self._last, self._sigma)]

    def _at(self, stamp_ns: int) -> PoseSample | None:
        while self._after is not None and self._after.stamp_ns < stamp_ns:
            self._before, self._after = self._after, next(self._samples, None)
            if self._after is not None:
                step_ns = self._after.stamp_ns - self._before.stamp_ns
                usual_ns = median(self._steps_ns) if self._steps_ns else step_ns
                self._is_in_gap = step_ns > MAX_GAP * usual_ns
                self._steps_ns.append(step_ns)
        if self._after is None or self._after.stamp_ns == stamp_ns:
            return self._after
        if self._before is None or self._is_in_gap:
            return None
        return _interpolate(self._before, self._after, stamp_ns)


def _interpolate(before: PoseSample, after: PoseSample, stamp_ns: int) -> PoseSample:
    """Interpolate linearly the position, along the shortest arc the rotation."""
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    T = se3.make_transform(
        before.T_world_frame[:3, :3],
        (1.0 - share) * before.T_world_frame[:3, 3] + share * after.T_world_frame[:3, 3],
    )
    turn = se3.log(se3.invert(before.T_world_frame) @ after.T_world_frame)
    turn[3:] = 0.0
    covariance = None
    if before.covariance is not None and after.covariance is not None:
        covariance = (1.0 - share) * before.covariance + share * after.covariance
    T = T @ se3.exp(share * turn)
    return PoseSample(stamp_ns=stamp_ns, T_world_frame=T, covariance=covariance)


def _step(before: PoseSample, after: PoseSample, sigma: StepSigma) -> Edge:
    return Edge(
        reference_id=before.stamp_ns,
        T_reference_frame=se3.invert(before.T_world_frame) @ after.T_world_frame,
        covariance=step_covariance(before, after, sigma),
    )


def step_covariance(before: PoseSample, after: PoseSample, sigma: StepSigma) -> FloatArray:
    """Return the covariance of the step between two poses of one stream.

    The covariance of odometry grows with the way: the step's is the growth. Where there is no
    growth the poses are taken for independent fixes: the step's is the sum. Where a pose has no
    covariance, or one that is not positive definite, it comes of `sigma`.

    Parameters
    ----------
    before, after : PoseSample
    sigma : StepSigma

    Returns
    -------
    ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame of `after`.
    """
    T_a_b = se3.invert(before.T_world_frame) @ after.T_world_frame
    if before.covariance is None or after.covariance is None:
        return sigma.covariance(T_a_b)
    if not _is_definite(after.covariance, scale=after.covariance):
        return sigma.covariance(T_a_b)
    moved = se3.transport_covariance(before.covariance, se3.invert(T_a_b))
    growth = after.covariance - moved
    if _is_definite(growth, scale=after.covariance):
        return np.asarray(0.5 * (growth + growth.T))
    if not _is_definite(before.covariance, scale=before.covariance):
        return sigma.covariance(T_a_b)
    total = after.covariance + moved
    return np.asarray(0.5 * (total + total.T))


def _is_definite(matrix: FloatArray, *, scale: FloatArray) -> bool:
    """Tell whether a matrix is positive definite by more than the rounding of another."""
    sigmas = np.sqrt(np.maximum(np.diag(scale), 0.0))
    if not np.isfinite(matrix).all() or sigmas.min() <= 0.0:
        return False
    scaled = matrix / np.outer(sigmas, sigmas)
    return bool(np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[0] > _MIN_RELATIVE_EIGENVALUE)
