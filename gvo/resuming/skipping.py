"""Reading on where a run was interrupted: what was done is passed over without being decoded."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from gvo.errors import RecordingError, ResumeError
from gvo.io.sync import Pair
from gvo.types import FaultyFrame

_OTHER = "this is not the recording of that run, or it was changed: run without --resume"


def skip_done(
    pairs: Iterator[Pair | FaultyFrame], done_ns: Sequence[int], needed: Collection[int]
) -> Iterator[Pair | FaultyFrame]:
    """Pass over what was done, but for some pairs that are needed again.

    Parameters
    ----------
    pairs : iterator of pair of StampedImage, or FaultyFrame
        As in the run that was interrupted.
    done_ns : sequence of int
        Stamps of those that were done, in their order.
    needed : collection of int
        Numbers of those that are to be given again, counted from 0.

    Yields
    ------
    pair of StampedImage, or FaultyFrame
        The needed ones, then all that were not done.

    Raises
    ------
    ResumeError
        When others come than those that were done.
    """
    for index, expected_ns in enumerate(done_ns):
        pair = _next(pairs)
        stamp_ns = None if pair is None else _stamp_ns(pair)
        if pair is None or stamp_ns != expected_ns:
            found = "no more" if stamp_ns is None else f"one at {stamp_ns} ns"
            raise ResumeError(
                f"frame {index + 1} was at {expected_ns} ns, now there is {found}: {_OTHER}"
            )
        if index in needed:
            yield pair
    yield from pairs


def _next(pairs: Iterator[Pair | FaultyFrame]) -> Pair | FaultyFrame | None:
    try:
        return next(pairs, None)
    except RecordingError as error:
        raise ResumeError(f"{error}: {_OTHER}") from error


def _stamp_ns(item: Pair | FaultyFrame) -> int:
    return item.stamp_ns if isinstance(item, FaultyFrame) else item[0].stamp_ns
