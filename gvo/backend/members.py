"""The poses of a window, and what was measured of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from gvo.backend.factors import Factors
from gvo.types import Edge, Estimate, FrameId, Prior, Status

# Of poses that a smaller window lets go: what they cost together grows with the cube.
_MAX_LEAVING = 32


class Tie(NamedTuple):
    """An accepted edge, with the key of its reference and what made its factor: its kernel."""

    edge: Edge
    factors: Factors
    reference_key: int


@dataclass(slots=True, kw_only=True)
class Member:
    """A pose of the window, with what was measured of it.

    Ties to poses that have left since stay among the edges. Each prior comes with what made its
    factor.
    """

    key: int
    stamp_ns: int
    edges: list[Tie]
    priors: list[tuple[Prior, Factors]]
    is_kept: bool = False
    status: Status = Status.OK
    causal: Estimate | None = None


class Members(dict[FrameId, Member]):
    """The poses of a window by the caller's names, oldest first."""

    @property
    def newest(self) -> FrameId:
        """The newest frame; None where there is none."""
        return next(reversed(self), None)

    @property
    def kept(self) -> list[FrameId]:
        """The kept frames, oldest first."""
        return [frame_id for frame_id, member in self.items() if member.is_kept]

    def find(self, frame_id: FrameId) -> Member | None:
        """Return a pose of the window, if it is there.

        Raises
        ------
        ValueError
            Where it can be no name.
        """
        try:
            return self.get(frame_id)
        except TypeError:
            raise ValueError(f"a frame_id must be hashable, got {frame_id!r}") from None

    def member(self, frame_id: FrameId) -> Member:
        """Return a pose of the window.

        Raises
        ------
        ValueError
            Where it is not there.
        """
        member = self.find(frame_id)
        if member is None:
            raise ValueError(absence(frame_id))
        return member

    def leaving(self, size: int | None) -> list[FrameId]:
        """Return who leaves with the next pose: neither recent then, nor kept."""
        if size is None:
            return []
        old = islice(self.items(), max(len(self) + 1 - size, 0))
        return [frame_id for frame_id, member in old if not member.is_kept][:_MAX_LEAVING]

    def tie_fault(self, frame_id: FrameId, edge: Edge, *, is_new: bool = False) -> str:
        """Return which end of an edge is not there; empty where both are, or a new pose is one."""
        if edge.reference_id == frame_id:
            return "an edge of a pose to itself"
        ends = [edge.reference_id] if is_new else [edge.reference_id, frame_id]
        return next((absence(end) for end in ends if end not in self), "")

    def standing_ties(self, member: Member) -> Iterator[Tie]:
        """Yield the edges of a pose whose references are still in the window.

        A name may have been given again to another pose: the key tells.
        """
        for tie in member.edges:
            reference = self.get(tie.edge.reference_id)
            if reference is not None and reference.key == tie.reference_key:
                yield tie


def absence(frame_id: FrameId) -> str:
    """Return what to say of a frame that is not there."""
    return f"{frame_id!r} is not in the window: it has left, or never was"
