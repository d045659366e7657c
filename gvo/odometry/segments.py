"""Parts of a run that no measurement ties to one another, until a kept keyframe is seen again.

While the camera is lost its pose is a guess that nobody should rely on. What is measured after
that holds together, as a segment of its own, somewhere in the world: where, only a keyframe of an
earlier segment can tell.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, SegmentJoin, Status

# Frames that look for earlier keyframes as soon as they hold together; after that only where one
# saw so much new that it was kept, and ever more rarely: at last once in so many frames.
_N_EAGER = 15
_N_PAUSE = 30
# Keyframes that a frame is compared with, each of which costs as much as two registrations.
_N_TRIED = 2
# Sigmas by which two sightings may differ.
_AGREEMENT = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """A frame that saw a keyframe of an earlier segment.

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
    """Which segment a run is in, how segments are joined, and whom to look for.

    A sighting alone may be mistaken: another house has such a window too. Two frames of one
    segment that agree about where they are join it to the other.

    Attributes
    ----------
    sighting : Sighting or None
        What an earlier frame saw, which waits to be confirmed.
    """

    def __init__(self) -> None:
        self.sighting: Sighting | None = None
        self._starts_ns: list[int] = []
        self._groups = [0]
        self._is_lost = False
        self._tied_since_ns: int | None = None
        self._n_looked = 0
        self._n_paused = 0
        self._is_due = False

    @property
    def current(self) -> int:
        """The segment of the latest frame."""
        return len(self._starts_ns)

    def segment_of(self, stamp_ns: int) -> int:
        """Return the segment of an earlier frame."""
        return bisect_right(self._starts_ns, stamp_ns)

    def note_frame(self, stamp_ns: int, reference_ns: int | None, status: Status) -> None:
        """Take what became of a frame; a segment begins with the first one that is lost.

        Parameters
        ----------
        stamp_ns : int
            Of the frame.
        reference_ns : int or None
            The frame that its registration ties it to; None where there is none.
        status : Status
        """
        if status is Status.LOST and not self._is_lost:
            self._starts_ns.append(stamp_ns)
            self._groups.append(self.current)
            self._n_looked, self.sighting = 0, None
        if self._is_lost and status is not Status.LOST:
            self._n_looked = 0  # what was seen until now may have been darkness
        self._is_lost = status is Status.LOST
        self._tied_since_ns = None if reference_ns is None else self._tied_since(reference_ns)

    def note_keyframe(self) -> None:
        """Take that the latest frame is kept: it sees much that is new."""
        self._is_due = True

    def apart(self, stamps_ns: Iterable[int]) -> list[int]:
        """Return the keyframes of segments that the current one is not joined to."""
        present = self._groups[self.current]
        return [ns for ns in stamps_ns if self._groups[self.segment_of(ns)] != present]

    def to_look_for(self, held_ns: Sequence[int]) -> list[int]:
        """Choose the keyframes that a frame is compared with: all in turn, the latest first.

        Parameters
        ----------
        held_ns : sequence of int
            Those that wait to be seen again, oldest first.
        """
        self._n_paused += 1
        if not held_ns or not self._is_time_to_look():
            return []
        self._is_due, self._n_paused = False, 0
        latest_first = held_ns[::-1]
        first = self._n_looked * _N_TRIED
        self._n_looked += 1
        chosen = [latest_first[(first + n) % len(held_ns)] for n in range(_N_TRIED)]
        seen = [] if self.sighting is None else [self.sighting.edge.reference_id]
        return list(dict.fromkeys([ns for ns in held_ns if ns in seen] + chosen))

    def confirms(
        self, edge: Edge, raw: Estimate, reference_ns: int | None, known: Edge | None
    ) -> bool:
        """Tell whether another sighting agrees with the one before.

        Parameters
        ----------
        edge : Edge
            The frame in a keyframe.
        raw : Estimate
            The frame's pose in the raw chain.
        reference_ns : int or None
            The frame that its registration ties it to; None where there is none.
        known : Edge or None
            That keyframe in the one that was seen before; None where they are not of one segment.
        """
        before = self.sighting
        if before is None or known is None or reference_ns is None:
            return False
        if self._tied_since(reference_ns) > before.raw.stamp_ns:
            return False
        T_before_frame, covariance = _step(before.raw, raw)
        T_seen_frame = before.edge.T_reference_frame @ T_before_frame
        expected = se3.compose_covariance(before.edge.covariance, T_before_frame, covariance)
        T_known_frame = known.T_reference_frame @ edge.T_reference_frame
        found = se3.compose_covariance(known.covariance, edge.T_reference_frame, edge.covariance)
        difference = se3.log(se3.invert(T_seen_frame) @ T_known_frame)
        return bool(se3.mahalanobis(difference, expected + found) <= _AGREEMENT**2)

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
        self.sighting = None
        return SegmentJoin(
            segment=segment, to_segment=other, stamp_ns=stamp_ns, reference_ns=reference_ns
        )

    def _is_time_to_look(self) -> bool:
        if self._n_looked < _N_EAGER or self.sighting is not None:
            return True
        return self._is_due and self._n_paused >= min(self._n_looked - _N_EAGER, _N_PAUSE)

    def _tied_since(self, reference_ns: int) -> int:
        """Return since when registrations tie all frames, with one more against a reference."""
        since_ns = self._tied_since_ns
        return reference_ns if since_ns is None else min(since_ns, reference_ns)


def _step(first: Estimate, second: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return T_first_second of two poses of a chain, and its covariance (6, 6)."""
    T_first_second = se3.invert(first.T_world_cam) @ second.T_world_cam
    Ad = se3.adjoint(se3.invert(T_first_second))
    # The covariances of a chain add up step by step: their difference is that of what is between.
    return T_first_second, second.covariance - Ad @ first.covariance @ Ad.T
