"""Record what happens inside a computation.

Nothing is recorded in a run: a note then costs less than a microsecond. An explained frame is
recorded by the computation that gave its pose, so that what is shown is what happened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Event:
    """What happened at one place of a computation.

    Parameters
    ----------
    name : str
        Where it happened, and what: `ransac.block`.
    values : mapping of str to anything
        Arrays are copies.
    """

    name: str
    values: Mapping[str, Any]


class Trace(list[Event]):
    """Events in the order in which they happened."""

    def all(self, name: str) -> list[Mapping[str, Any]]:
        """Return the values of all events of a name."""
        return [event.values for event in self if event.name == name]

    def find(self, name: str) -> Mapping[str, Any]:
        """Return the values of the first event of a name; empty if there is none."""
        return next((event.values for event in self if event.name == name), {})

    def before(self, name: str) -> Trace:
        """Return the events before the first one of a name; all if there is none."""
        return Trace(takewhile(lambda event: event.name != name, self))

    def split(self, name: str) -> list[Trace]:
        """Return the parts that begin with an event of a name."""
        starts = [n for n, event in enumerate(self) if event.name == name]
        return [Trace(self[start:end]) for start, end in pairwise([*starts, len(self)])]


_TRACE: ContextVar[Trace | None] = ContextVar("trace", default=None)


def note(name: str, **values: object) -> None:
    """Record an event, if anyone watches.

    Parameters
    ----------
    name : str
    **values
        Arrays are copied, as they may change later.
    """
    trace = _TRACE.get()
    if trace is not None:
        trace.append(Event(name=name, values={key: _kept(each) for key, each in values.items()}))


@contextmanager
def watched() -> Iterator[Trace]:
    """Record the events inside the context, on this thread.

    Yields
    ------
    Trace
        Grows with each event. Events of an inner context do not reach the outer one.

    Examples
    --------
    >>> with watched() as trace:
    ...     note("search.done", n_found=3)
    >>> trace.all("search.done")
    [{'n_found': 3}]
    """
    trace = Trace()
    token = _TRACE.set(trace)
    try:
        yield trace
    finally:
        _TRACE.reset(token)


def _kept(value: object) -> object:
    return value.copy() if isinstance(value, np.ndarray) else value
