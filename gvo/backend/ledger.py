"""What a window took and refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from gvo.types import FrameId, Rejected


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowCounts:
    """What a window has taken and refused so far.

    Parameters
    ----------
    n_poses, n_edges, n_priors : int
        Taken in.
    n_rejected : int
        Edges and priors refused, those below among them.
    n_gated : int
        Edges refused because the others disagree with them.
    n_coasting : int
        Poses without a usable edge, which continue the last velocity.
    n_restored : int
        Updates that GTSAM gave up; the window went back to where it was before.
    n_rebuilt : int
        Times that the graph was made anew from its poses and their covariances.
    first_rejected : str
        The first refusal; empty where there was none.
    """

    n_poses: int = 0
    n_edges: int = 0
    n_priors: int = 0
    n_rejected: int = 0
    n_gated: int = 0
    n_coasting: int = 0
    n_restored: int = 0
    n_rebuilt: int = 0
    first_rejected: str = ""


class Ledger:
    """Counts what happens in a window."""

    def __init__(self) -> None:
        self._numbers: Counter[str] = Counter()
        self._first_rejected = ""

    @property
    def counts(self) -> WindowCounts:
        """What happened so far."""
        return WindowCounts(**self._numbers, first_rejected=self._first_rejected)

    def add(self, **numbers: int) -> None:
        """Add to counts by their names."""
        for name, number in numbers.items():
            self._numbers[name] += number

    def reject(
        self,
        frame_id: FrameId,
        stamp_ns: int | None,
        reason: str,
        *,
        reference_id: FrameId = None,
        is_gated: bool = False,
    ) -> Rejected:
        """Count a refusal and return it."""
        rejected = Rejected(
            frame_id=frame_id, stamp_ns=stamp_ns, reason=reason, reference_id=reference_id
        )
        self.add(n_rejected=1, n_gated=int(is_gated))
        self._first_rejected = self._first_rejected or str(rejected)
        return rejected
