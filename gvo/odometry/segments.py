"""Segments of a run without measurements between them, until a kept keyframe is seen again.

While the camera is lost its pose is a guess that nobody should rely on. The frames after that
are a segment of their own, somewhere in the world: where, only relocalization against a keyframe
of an earlier segment can tell.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, SegmentJoin, Status

# The first frames of a segment all try to relocalize; later ones only where they became keyframes,
# with growing pauses of at most so many frames.
_N_EAGER = 15
_MAX_PAUSE = 30
# Keyframes that a frame is compared with, each of which costs as much as two registrations.
_N_TRIED = 2
# Sigmas by which two relocalizations may differ.
_AGREEMENT = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelocalizationCandidate:
    """A frame that was registered against a keyframe of an earlier segment.

    Parameters
    ----------
    raw : Estimate
        The frame's pose in the raw chain.
    edge : Edge
        The frame in the keyframe.
    """

    raw: Estimate
    edge: Edge


class Segments:
    """Which segment a run is in, how segments are joined, and which keyframes to look for.

    One relocalization may be mistaken: another house has such a window too. Two frames of a
    segment that agree about where they are join it to the other.
    """

    def __init__(self) -> None:
        self._candidate: RelocalizationCandidate | None = None
        self._starts_ns: list[int] = []
        self._groups = [0]
        self._is_lost = False
        self._tied_since_ns: int | None = None
        self._n_tries = 0
        self._n_paused = 0
        self._is_due = False

    @property
    def current(self) -> int:
        """The segment of the latest frame."""
        return len(self._starts_ns)

    def segment_of(self, stamp_ns: int) -> int:
        """Return the segment of an earlier frame."""
        return bisect_right(self._starts_ns, stamp_ns)

    @property
    def candidate_ns(self) -> FrameId:
        """The keyframe that an earlier frame relocalized against, unconfirmed; None without."""
        return None if self._candidate is None else self._candidate.edge.reference_id

    def note_frame(self, stamp_ns: int, reference_ns: int | None, status: Status) -> None:
        """Add a frame; the first one that is lost begins a segment.

        Parameters
        ----------
        stamp_ns : int
            Of the frame.
        reference_ns : int or None
            The frame that it is registered against; None where there is none.
        status : Status
        """
        if status is Status.LOST and not self._is_lost:
            self._starts_ns.append(stamp_ns)
            self._groups.append(self.current)
            self._n_tries, self._candidate = 0, None
        if self._is_lost and status is not Status.LOST:
            self._n_tries = 0  # the frames until now may have been dark
        self._is_lost = status is Status.LOST
        self._tied_since_ns = None if reference_ns is None else self._tied_since(reference_ns)

    def note_keyframe(self) -> None:
        """Note that the latest frame became a keyframe: it sees much that is new."""
        self._is_due = True

    def unjoined(self, stamps_ns: Iterable[int]) -> list[int]:
        """Return the keyframes of segments that the current one is not joined to."""
        present = self._groups[self.current]
        return [ns for ns in stamps_ns if self._groups[self.segment_of(ns)] != present]

    def choose_waiting(self, waiting_ns: Sequence[int]) -> list[int]:
        """Choose the keyframes that a frame is compared with: all in turn, the latest first.

        Parameters
        ----------
        waiting_ns : sequence of int
            Those that wait to be seen again, oldest first.
        """
        self._n_paused += 1
        if not waiting_ns or not self._is_time_to_relocalize():
            return []
        self._is_due, self._n_paused = False, 0
        first = self._n_tries * _N_TRIED
        self._n_tries += 1
        n = len(waiting_ns)
        chosen = [waiting_ns[::-1][(first + k) % n] for k in range(_N_TRIED)]
        again = [ns for ns in waiting_ns if ns == self.candidate_ns]
        return list(dict.fromkeys(again + chosen))

    def confirm(
        self, edge: Edge, raw: Estimate, reference_ns: int | None, known: Edge | None
    ) -> bool:
        """Tell whether a relocalization agrees with the candidate; else it is the new one.

        Parameters
        ----------
        edge : Edge
            The frame in a keyframe.
        raw : Estimate
            The frame's pose in the raw chain.
        reference_ns : int or None
            The frame that it is registered against; None where there is none.
        known : Edge or None
            That keyframe in the candidate's; None where they are not of one segment.
        """
        before = self._candidate
        if before is not None and known is not None and reference_ns is not None:
            is_tied = self._tied_since(reference_ns) <= before.raw.stamp_ns
            if is_tied and _do_agree(before, edge, raw, known):
                return True
        self._candidate = RelocalizationCandidate(raw=raw, edge=edge)
        return False

    def join(self, stamp_ns: int, reference_ns: int) -> SegmentJoin | None:
        """Join the segment of a frame to that of an earlier one, and to all that are joined to it.

        Parameters
        ----------
        stamp_ns, reference_ns : int
            The frame, and the one that it was registered against.

        Returns
        -------
        SegmentJoin or None
            None where they are joined already.
        """
        segment, other = self.segment_of(stamp_ns), self.segment_of(reference_ns)
        present, former = self._groups[segment], self._groups[other]
        if present == former:
            return None
        self._groups = [former if group == present else group for group in self._groups]
        self._candidate = None
        return SegmentJoin(
            segment=segment, to_segment=other, stamp_ns=stamp_ns, reference_ns=reference_ns
        )

    def _is_time_to_relocalize(self) -> bool:
        if self._n_tries < _N_EAGER or self._candidate is not None:
            return True
        return self._is_due and self._n_paused >= min(self._n_tries - _N_EAGER, _MAX_PAUSE)

    def _tied_since(self, reference_ns: int) -> int:
        """Return since when all frames are registered, with one more against a reference."""
        since_ns = self._tied_since_ns
        return reference_ns if since_ns is None else min(since_ns, reference_ns)


def _do_agree(before: RelocalizationCandidate, edge: Edge, raw: Estimate, known: Edge) -> bool:
    """Compare two ways from the candidate's keyframe to a frame."""
    T_before_frame, covariance = _step(before.raw, raw)
    T_expected = before.edge.T_reference_frame @ T_before_frame
    expected = se3.compose_covariance(before.edge.covariance, T_before_frame, covariance)
    T_found = known.T_reference_frame @ edge.T_reference_frame
    found = se3.compose_covariance(known.covariance, edge.T_reference_frame, edge.covariance)
    difference = se3.log(se3.invert(T_expected) @ T_found)
    return bool(se3.mahalanobis(difference, expected + found) <= _AGREEMENT**2)


def _step(first: Estimate, second: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return T_first_second of two poses of a chain, and its covariance (6, 6)."""
    T_first_second = se3.invert(first.T_world_frame) @ second.T_world_frame
    Ad = se3.adjoint(se3.invert(T_first_second))
    # The covariances of a chain add up step by step: their difference is that of what is between.
    return T_first_second, second.covariance - Ad @ first.covariance @ Ad.T
