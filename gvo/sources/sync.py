"""Pairs of images by stamp, streaming.

The result depends on the order and stamps within each stream, not on how the two streams are
interleaved, as long as neither runs more than `MAX_PENDING` images ahead of the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from gvo.errors import GvoError
from gvo.sources.recording import StampedImage
from gvo.types import FaultyFrame

MAX_PENDING = 100
"""Images of one stream that are kept while the other one lags behind, or while they compete."""

Pair: TypeAlias = tuple[StampedImage, StampedImage]


def pair_images(
    images: Iterable[StampedImage], *, limit_ns: int, partner: str
) -> Iterator[Pair | FaultyFrame]:
    """Pair the images of stream 0 with those of stream 1.

    Of all ways to pair within the limit, each image at most once, that with the least sum of
    differences is taken, where an image of stream 0 without partner counts as much as the limit.
    So none is left without while its partner's stamp is nearer to it than to the image that got
    it, and a missing image does not shift those after it.

    Parameters
    ----------
    images : iterable of StampedImage
        Both streams, interleaved in any way.
    limit_ns : int
        Largest difference of the stamps of a pair, nanoseconds.
    partner : str
        What stream 1 is called in messages, with the parameter that sets the limit.

    Yields
    ------
    pair of StampedImage, or FaultyFrame
        One for each image of stream 0, in its order: faulty where the stamp repeats or goes
        back, or where there is no partner. Images of stream 1 whose stamp repeats or goes back
        are left out.

    Raises
    ------
    GvoError
        What reading the images raises, after the pairs of those read before.

    Notes
    -----
    The sum is minimized by dynamic programming over the images of stream 0. A pair is given out
    when all plans that may still turn out best agree on it, which is mostly an image later; when
    `MAX_PENDING` images wait for that, the best plan so far decides about the first.
    """
    pairing = _Pairing(limit_ns, partner)
    try:
        for image in images:
            pairing.push(image)
            yield from pairing.decided()
    except GvoError:
        yield from pairing.rest()  # what was read before it counts
        raise
    yield from pairing.rest()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plan:
    """One way to pair the images that are planned but not given out.

    `last_ns` is the stamp of the last partner taken, `cost_ns` the sum of differences so far.
    """

    last_ns: int
    cost_ns: int
    partners: tuple[StampedImage | None, ...]


class _Pairing:
    def __init__(self, limit_ns: int, partner: str) -> None:
        self._is_ended = False
        self._limit_ns = limit_ns
        self._partner = partner
        self._waiting: deque[StampedImage | FaultyFrame] = deque()
        self._partners: deque[StampedImage] = deque()
        self._last_stamps: list[int | None] = [None, None]
        self._stamp_passed: int | None = None
        # planned images, each with what it becomes where the plan has no partner for it
        self._planned: deque[tuple[StampedImage | None, FaultyFrame]] = deque()
        self._plans = [_Plan(last_ns=-(2**64), cost_ns=0, partners=())]

    def push(self, image: StampedImage) -> None:
        """Take the next image of either stream."""
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
        while self._waiting and self._is_plannable(self._waiting[0]):
            image = self._waiting.popleft()
            if isinstance(image, FaultyFrame):
                self._planned.append((None, image))
                self._plans = [_extended(plan, None) for plan in self._plans]
            else:
                self._plan(image)
            yield from self._agreed()

    def rest(self) -> Iterator[Pair | FaultyFrame]:
        """Yield what is left when no image will come any more."""
        self._is_ended = True
        yield from self.decided()
        self._plans = [self._best_plan()]
        yield from self._agreed()

    def _is_plannable(self, image: StampedImage | FaultyFrame) -> bool:
        """Tell whether all images that may become its partner are known."""
        last_ns = self._last_stamps[1]
        return (
            self._is_ended
            or isinstance(image, FaultyFrame)
            or (last_ns is not None and last_ns >= image.stamp_ns + self._limit_ns)
            or max(len(self._waiting), len(self._partners)) > MAX_PENDING
        )

    def _plan(self, image: StampedImage) -> None:
        """Continue all plans by all choices for one image, and keep those that may be best."""
        earliest_ns = image.stamp_ns - self._limit_ns
        while self._partners and self._partners[0].stamp_ns < earliest_ns:
            self._pass_partner()
        self._planned.append((image, self._partnerless_frame(image)))
        near = [p for p in self._partners if p.stamp_ns <= image.stamp_ns + self._limit_ns]
        plans = []
        for plan in self._plans:
            # one more than the limit: a pair with just that difference is better than none
            plans.append(_extended(plan, None, cost_ns=self._limit_ns + 1))
            plans += [
                _extended(plan, partner, cost_ns=abs(partner.stamp_ns - image.stamp_ns))
                for partner in near
                if partner.stamp_ns > plan.last_ns
            ]
        self._plans = _not_dominated(plans, earliest_ns)

    def _agreed(self) -> Iterator[Pair | FaultyFrame]:
        """Yield the answers that all plans share; the best plan's where too many wait."""
        while self._planned:
            if len(self._planned) > MAX_PENDING:
                first = self._best_plan().partners[0]
            else:
                first = self._plans[0].partners[0]
                if any(plan.partners[0] is not first for plan in self._plans):
                    return
            self._plans = [
                _Plan(last_ns=plan.last_ns, cost_ns=plan.cost_ns, partners=plan.partners[1:])
                for plan in self._plans
                if plan.partners[0] is first
            ]
            image, alone = self._planned.popleft()
            yield alone if image is None or first is None else (image, first)

    def _best_plan(self) -> _Plan:
        return min(self._plans, key=lambda plan: plan.cost_ns)

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
            reason=f"no {self._partner}={self._limit_ns / 1e6:g}: {nearest}",
            is_unpaired=True,
        )


def _extended(plan: _Plan, partner: StampedImage | None, *, cost_ns: int = 0) -> _Plan:
    return _Plan(
        last_ns=plan.last_ns if partner is None else partner.stamp_ns,
        cost_ns=plan.cost_ns + cost_ns,
        partners=(*plan.partners, partner),
    )


def _not_dominated(plans: list[_Plan], earliest_ns: int) -> list[_Plan]:
    """Leave out each plan that another one cannot do worse than, whatever comes.

    Of two plans, that whose last partner is earlier has all choices of the other; partners
    before `earliest_ns` are no choice any more.
    """
    kept: list[_Plan] = []
    for plan in sorted(plans, key=lambda plan: (max(plan.last_ns, earliest_ns), plan.cost_ns)):
        if not kept or plan.cost_ns < kept[-1].cost_ns:
            kept.append(plan)
    return kept


def _late_frame(image: StampedImage, last_ns: int | None) -> FaultyFrame:
    if image.stamp_ns == last_ns:
        reason = f"the stamp {image.stamp_ns} ns repeats"
    else:
        reason = f"the stamp goes back from {last_ns} to {image.stamp_ns} ns"
    return FaultyFrame(stamp_ns=image.stamp_ns, reason=reason)
