"""What happens inside a computation, told to whoever watches.

Nobody watches in a run: then a note costs less than a microsecond. Whoever explains a frame
watches the very computation that gave its pose, so that what is shown is what happened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Event:
    """One thing that happened.

    Parameters
    ----------
    name : str
        Where it happened, and what: `ransac.block`.
    values : mapping of str to anything
        What is known there; arrays are copies.
    """

    name: str
    values: Mapping[str, Any]


_EVENTS: ContextVar[list[Event] | None] = ContextVar("events", default=None)


def note(name: str, **values: object) -> None:
    """Tell what happened, where somebody watches.

    Parameters
    ----------
    name : str
    **values
        Arrays are copied: what is done to them later does not show.
    """
    events = _EVENTS.get()
    if events is not None:
        kept = {key: _kept(value) for key, value in values.items()}
        events.append(Event(name=name, values=kept))


@contextmanager
def watched() -> Iterator[list[Event]]:
    """Watch what happens inside the context, on this thread.

    Yields
    ------
    list of Event
        Grows as things happen. What an inner context watches does not reach the outer one.

    Examples
    --------
    >>> with watched() as events:
    ...     note("search.done", n_found=3)
    >>> events[0].name, events[0].values["n_found"]
    ('search.done', 3)
    """
    events: list[Event] = []
    token = _EVENTS.set(events)
    try:
        yield events
    finally:
        _EVENTS.reset(token)


def _kept(value: object) -> object:
    return value.copy() if isinstance(value, np.ndarray) else value
