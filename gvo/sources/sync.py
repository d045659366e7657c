"""Pairs of images by stamp, streaming.

The result depends on the order and stamps within each stream, not on how the two streams are
interleaved, as long as neither runs more than `MAX_PENDING` images ahead of the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TypeAlias

from gvo.sources.recording import StampedImage
from gvo.types import FaultyFrame

MAX_PENDING = 100
"""Images of one stream that are kept while the other one lags behind."""

Pair: TypeAlias = tuple[StampedImage, StampedImage]


def pair_images(
    images: Iterable[StampedImage], *, limit_ns: int, partner: str
) -> Iterator[Pair | FaultyFrame]:
    """Pair the images of stream 0 with those of stream 1.

    In the order of stream 0, each image takes the nearest partner within the limit among those
    after the partner taken before. Where that would leave the next image without any, and
    there is an earlier one within the limit, it takes the earlier one.

    Parameters
    ----------
    images : iterable of StampedImage
        Both streams, interleaved in any way.
    limit_ns : int
        Largest difference of the stamps of a pair, nanoseconds.
    partner : str
        What stream 1 is called in messages.

    Yields
    ------
    pair of StampedImage, or FaultyFrame
        One for each image of stream 0, in its order: faulty where the stamp repeats or goes
        back, or where there is no partner. Images of stream 1 whose stamp repeats or goes back
        are left out.
    """
    pairing = _Pairing(limit_ns, partner)
    for image in images:
        pairing.push(image)
        yield from pairing.decided()
    pairing.is_ended = True
    yield from pairing.decided()


class _Pairing:
    def __init__(self, limit_ns: int, partner: str) -> None:
        self.is_ended = False
        self._limit_ns = limit_ns
        self._partner = partner
        self._waiting: deque[StampedImage | FaultyFrame] = deque()
        self._partners: deque[StampedImage] = deque()
        self._last_stamps: list[int | None] = [None, None]
        self._stamp_passed: int | None = None

    def push(self, image: StampedImage) -> None:
        last_ns = self._last_stamps[image.stream]
        is_late = last_ns is not None and image.stamp_ns <= last_ns
        if not is_late:
            self._last_stamps[image.stream] = image.stamp_ns
        if image.stream == 0:
            self._waiting.append(_late_frame(image, last_ns) if is_late else image)
        elif not is_late:
            self._partners.append(image)
            if len(self._partners) > MAX_PENDING and not self._waiting:
                self._pass_partner()

    def decided(self) -> Iterator[Pair | FaultyFrame]:
        """Yield what no later image can change."""
        while self._waiting:
            front = self._waiting[0]
            if isinstance(front, FaultyFrame):
                yield front
            else:
                is_forced = max(len(self._waiting), len(self._partners)) > MAX_PENDING
                if not (is_forced or self._knows_nearest(front.stamp_ns)):
                    return
                self._pass_partners_before(front.stamp_ns - self._limit_ns)
                index = self._choose(front.stamp_ns, is_forced=is_forced)
                if index is None:
                    return
                yield self._take(front, index)
            self._waiting.popleft()

    def _choose(self, stamp_ns: int, *, is_forced: bool) -> int | None:
        """Return the index of the partner to take, -1 for none, None while undecided."""
        differences = [abs(partner.stamp_ns - stamp_ns) for partner in self._near(stamp_ns)]
        if not differences:
            return -1
        nearest = differences.index(min(differences))
        if nearest == 0:
            return nearest
        needs_it = self._next_needs(nearest)
        if needs_it is None and not is_forced:
            return None
        return nearest - 1 if needs_it else nearest

    def _near(self, stamp_ns: int) -> Iterator[StampedImage]:
        for partner in self._partners:
            if partner.stamp_ns > stamp_ns + self._limit_ns:
                return
            yield partner

    def _next_needs(self, index: int) -> bool | None:
        """Tell whether the next image has no partner but this one; None while unknown."""
        later = islice(self._waiting, 1, None)
        following = next((item for item in later if isinstance(item, StampedImage)), None)
        if following is None:
            return False if self.is_ended else None
        if abs(self._partners[index].stamp_ns - following.stamp_ns) > self._limit_ns:
            return False
        latest_ns = following.stamp_ns + self._limit_ns
        if index + 1 < len(self._partners):
            return self._partners[index + 1].stamp_ns > latest_ns
        return True if self._knows_partners_until(latest_ns) else None

    def _knows_nearest(self, stamp_ns: int) -> bool:
        if self._partners and self._partners[-1].stamp_ns >= stamp_ns:
            return True
        return self._knows_partners_until(stamp_ns + self._limit_ns)

    def _knows_partners_until(self, stamp_ns: int) -> bool:
        last_ns = self._last_stamps[1]
        return self.is_ended or (last_ns is not None and last_ns >= stamp_ns)

    def _take(self, image: StampedImage, index: int) -> Pair | FaultyFrame:
        if index < 0:
            return self._partnerless_frame(image)
        partner = self._partners[index]
        for _ in range(index + 1):
            self._pass_partner()
        return image, partner

    def _pass_partners_before(self, stamp_ns: int) -> None:
        while self._partners and self._partners[0].stamp_ns < stamp_ns:
            self._pass_partner()

    def _pass_partner(self) -> None:
        self._stamp_passed = self._partners.popleft().stamp_ns

    def _partnerless_frame(self, image: StampedImage) -> FaultyFrame:
        around = [self._stamp_passed] + [partner.stamp_ns for partner in self._partners]
        gaps = [abs(stamp - image.stamp_ns) for stamp in around if stamp is not None]
        nearest = f"the nearest is {min(gaps) / 1e6:g} ms away" if gaps else "there is none"
        if gaps and min(gaps) <= self._limit_ns:
            nearest += " and belongs to another image"
        return FaultyFrame(
            stamp_ns=image.stamp_ns,
            reason=f"no {self._partner} image within {self._limit_ns / 1e6:g} ms: {nearest}",
            is_unpaired=True,
        )


def _late_frame(image: StampedImage, last_ns: int | None) -> FaultyFrame:
    if image.stamp_ns == last_ns:
        reason = f"the stamp {image.stamp_ns} ns repeats"
    else:
        reason = f"the stamp goes back from {last_ns} to {image.stamp_ns} ns"
    return FaultyFrame(stamp_ns=image.stamp_ns, reason=reason)
