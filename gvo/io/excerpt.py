"""A part of a recording: from when, for how long, every how many frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from gvo.errors import ConfigurationError, RecordingError, named_faults
from gvo.io.sync import Paired
from gvo.types import FaultyFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class Excerpt:
    """Which frames of a recording are wanted; all of them by default.

    Stamps are those of the headers, relative to the first image of stream 0. When the messages
    were recorded, and by which clock, plays no role.

    Parameters
    ----------
    start_s : float
        Leave out what comes before, seconds.
    duration_s : float, optional
        Leave out what comes so long after the start or later, seconds; so excerpts that follow
        one another share no frame. None: to the end.
    every : int
        Keep the first and then each n-th of the frames. Frames are counted, that is pairs, not
        images of one stream.

    Raises
    ------
    ValueError
        Where a number is out of its range.

    Examples
    --------
    >>> Excerpt(start_s=10.0, duration_s=5.0, every=2).n_expected(3000, length_s=100.0)
    75
    """

    start_s: float = 0.0
    duration_s: float | None = None
    every: int = 1

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (math.isfinite(self.start_s) and self.start_s >= 0):
            raise ValueError(f"start_s must be 0 or more, got {self.start_s}")
        if self.duration_s is not None and not (
            math.isfinite(self.duration_s) and self.duration_s > 0
        ):
            raise ValueError(f"duration_s must be more than 0, got {self.duration_s}")
        if self.every < 1:
            raise ValueError(f"every must be 1 or more, got {self.every}")

    @property
    def is_everything(self) -> bool:
        """Whether nothing is left out."""
        return self == Excerpt()

    def n_expected(self, n_images: int, length_s: float | None = None) -> int:
        """Estimate how many of `n_images` left images are kept; the recording lasts `length_s`."""
        share = 1.0
        if length_s is not None and length_s > 0:
            rest_s = max(length_s - self.start_s, 0.0)
            kept_s = rest_s if self.duration_s is None else min(rest_s, self.duration_s)
            share = kept_s / length_s
        return math.ceil(n_images * share / self.every)


def make_excerpt(start_s: float, duration_s: float | None, every: int) -> Excerpt:
    """Return the excerpt that a user asked for; refuse numbers out of range in one line."""
    with named_faults(ConfigurationError, "--start, --duration, --every", others=(ValueError,)):
        return Excerpt(start_s=start_s, duration_s=duration_s, every=every)


def take_excerpt(items: Iterable[Paired], excerpt: Excerpt) -> Iterator[Paired]:
    """Take a part of what `pair_images` gives; refuse an excerpt that holds nothing.

    A faulty frame takes no place in the count of `every`: it is given where the pair after it is
    due. Reading stops at the first pair after the end: then both streams are past it. An image
    without partner ends nothing; its stamp may be a mistake, or the other stream may be late.
    """
    if excerpt.is_everything:
        yield from items
        return
    start_ns = round(1e9 * excerpt.start_s)
    end_ns = math.inf if excerpt.duration_s is None else start_ns + round(1e9 * excerpt.duration_s)
    stamps: list[int] = []  # of the first and the latest item
    n_given = n_to_skip = 0
    for item in items:
        is_pair = not isinstance(item, FaultyFrame)
        stamp_ns = item.stamp_ns if isinstance(item, FaultyFrame) else item[0].stamp_ns
        stamps = [stamps[0], max(stamps[1], stamp_ns)] if stamps else [stamp_ns, stamp_ns]
        elapsed_ns = stamp_ns - stamps[0]
        if elapsed_ns >= end_ns and is_pair:
            break
        if elapsed_ns >= end_ns or (start_ns > 0 and elapsed_ns < start_ns):
            continue
        if n_to_skip:
            n_to_skip -= is_pair
            continue
        n_given += 1
        n_to_skip = excerpt.every - 1 if is_pair else 0
        yield item
    if stamps and not n_given:
        length_s = (stamps[1] - stamps[0]) / 1e9
        until = "" if excerpt.duration_s is None else f" and for {excerpt.duration_s:g} s"
        raise RecordingError(
            f"no frame at {excerpt.start_s:g} s or later{until}: the recording is {length_s:g} s "
            "long, or has a gap there; start elsewhere or take more"
        )
