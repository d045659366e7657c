"""Other front-ends' output as a stream of events: new poses, and edges between known ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from gvo.types import Edge, FloatArray, FrameId, PosePrior, Prior

ANCHOR_SIGMA = 1e-5
"""Of a pose that holds the world: radians and metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseEvent:
    """A new pose.

    Parameters
    ----------
    frame_id : hashable
    stamp_ns : int
        Nanoseconds, after that of the pose before.
    edges : tuple of Edge
        To poses that came before; empty for the first pose.
    prior : PosePrior or PositionPrior, optional
        What is known of it in the world.
    """

    frame_id: FrameId
    stamp_ns: int
    edges: tuple[Edge, ...] = ()
    prior: Prior | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeEvent:
    """An edge between two poses that both came before: it measures `frame_id`."""

    frame_id: FrameId
    edge: Edge


Event: TypeAlias = PoseEvent | EdgeEvent


class InputFaults:
    """Counts what of an input could not be used, and remembers the first of each kind."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._first: dict[str, str] = {}

    def add(self, kind: str, first: str, *, n: int = 1) -> None:
        """Count a fault.

        Parameters
        ----------
        kind : str
            In the plural, such as `poses are out of order and were skipped`.
        first : str
            The fault itself; kept where it is the first of its kind.
        n : int
            How many.
        """
        self._counts[kind] = self._counts.get(kind, 0) + n
        self._first.setdefault(kind, first)

    def warnings(self) -> list[str]:
        """Return a line for each kind."""
        return [f"{n} {kind}; the first: {self._first[kind]}" for kind, n in self._counts.items()]


class EdgeSource(Protocol):
    """A source of poses and edges.

    Attributes
    ----------
    name : str
        Of the input, for titles.
    decisions : list of str
        What was decided in reading it, a line each.
    faults : InputFaults
        What could not be used, as far as it was read.
    n_poses : int
        How many may come; 0 where that is not known.
    has_made_up_stamps : bool
        Whether stamps are the order of the poses, a second each.
    """

    name: str
    decisions: list[str]
    faults: InputFaults
    n_poses: int
    has_made_up_stamps: bool

    def events(self) -> Iterator[Event]:
        """Yield poses and edges in the order of the input."""
        ...


def anchor(T_world_frame: FloatArray) -> PosePrior:
    """Return the prior of a pose that holds the world, from T_world_frame, shape (4, 4)."""
    return PosePrior(T_world_frame=T_world_frame, covariance=ANCHOR_SIGMA**2 * np.eye(6))
