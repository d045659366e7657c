"""Pairing by stamp; stray stamps taken out."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TypeAlias

from gvo.errors import GvoError
from gvo.io.recording import StampedImage
from gvo.types import FaultyFrame

Pair: TypeAlias = tuple[StampedImage, StampedImage]
Paired: TypeAlias = Pair | FaultyFrame
"""A pair, or the image of stream 0 that became none."""

# A step so long is a gap, or a stamp gone wrong: the next images tell.
_LEAP_NS = 1_000_000_000
# So many images in a row that are all after the leap: it was a gap.
_N_TO_CONFIRM = 3
# Periods that are known before one is relied on, and the share of the shortest that counts.
_N_PERIODS = 10
_SHORTEST = 0.8
# Images of each stream (of equal stamps: stamps of both together) that are kept while their
# partners may still come, and how much nearer, as a share, a later partner must be to be preferred
# to an earlier one: as message_filters has them by default.
_QUEUE_SIZE = 100
# Of a running camera, their memory has a bound as well.
MAX_WAITING_BYTES = 512_000_000
_AGE_PENALTY = 0.1


def pair_images(
    images: Iterable[StampedImage],
    *,
    limit_ns: int,
    partner: str,
    is_live: bool = False,
) -> Iterator[Paired]:
    """Pair the images of stream 0 with those of stream 1, as message_filters of ROS does.

    Without a tolerance images of equal stamps are paired, by its policy ExactTime; else by its
    ApproximateTime [1]_: the later one of the two images at the front becomes the pivot, and gets
    either the last image of the other stream before it or, where that is nearer by more than the
    age penalty, the first one after it.

    Parameters
    ----------
    images : iterable of StampedImage
        Both streams, interleaved in any way.
    limit_ns : int
        Largest difference of the stamps of a pair, nanoseconds; 0: equal stamps.
    partner : str
        What stream 1 is called in messages, with the parameter that sets the limit.
    is_live : bool
        The images come from a running camera. An approximate pair is given out as soon as the
        period of the images says that no better partner can come, not with the next image: the
        pairs are the same, unless a camera suddenly sends faster than ever before. Images that
        wait for a partner take at most 512 MB, and a negative stamp makes no frame.

    Yields
    ------
    pair of StampedImage, or FaultyFrame
        One for each image of stream 0, as soon as it is certain, in the order of the stream
        (ExactTime: of the stamps waiting). Faulty with `is_unpaired` where there is no partner;
        faulty where the stamp repeats or goes behind that of the last pair given: frames have
        increasing stamps. Images of stream 1 without partner are left out.

    Raises
    ------
    GvoError
        What reading the images raises, after the pairs of those read before.

    Notes
    -----
    At the end of the images, pairs held back are given out, as if one more image of each stream
    followed long after. The interval of a pair never exceeds the limit, the limits on message
    rates are 0, and only two streams exist: so the search of message_filters for a virtual
    candidate never decides anything, and is left out.

    References
    ----------
    .. [1] http://wiki.ros.org/message_filters/ApproximateTime
    """
    answers = _Answers(limit_ns, partner, is_live=is_live)
    policy: _ExactTime | _ApproximateTime = _ExactTime(answers)
    if limit_ns > 0:
        policy = _ApproximateTime(limit_ns, answers, is_live=is_live)
    try:
        for image in images:
            policy.push(image)
            yield from answers.take()
    except GvoError:
        policy.end()  # what was read before it counts
        yield from answers.take()
        raise
    policy.end()
    yield from answers.take()


class _Answers:
    """Pairs and faulty frames, one for each image of stream 0, in the order of stamps."""

    def __init__(self, limit_ns: int, partner: str, *, is_live: bool) -> None:
        self._limit_ns, self._partner = limit_ns, partner
        self._is_live = is_live
        self._ready: list[Paired] = []
        self._passed_ns: int | None = None  # the last stamp of stream 1 that was dealt with
        self.last_ns: int | None = -1 if is_live else None  # of the last pair

    def take(self) -> list[Paired]:
        """Return the answers since the last call."""
        ready, self._ready = self._ready, []
        return ready

    def add_pair(self, image: StampedImage, partner: StampedImage) -> None:
        self.pass_partner(partner)
        if self.is_late(image):
            self.add_late(image)
        else:
            self.last_ns = image.stamp_ns
            self._ready.append((image, partner))

    def is_crowded(self, n_waiting: int, images: Iterable[StampedImage | None]) -> bool:
        """Tell whether more wait than may, by their number or by their memory."""
        if n_waiting > _QUEUE_SIZE or not self._is_live:
            return n_waiting > _QUEUE_SIZE
        return sum(image.n_bytes for image in images if image is not None) > MAX_WAITING_BYTES

    def is_late(self, image: StampedImage) -> bool:
        return self.last_ns is not None and image.stamp_ns <= self.last_ns

    def add_late(self, image: StampedImage) -> None:
        if self.last_ns == -1 and image.stamp_ns < 0:
            reason = f"the stamp {image.stamp_ns} ns is negative"
        elif self.last_ns is not None and image.stamp_ns < self.last_ns:
            reason = f"the stamp goes back from {self.last_ns} to {image.stamp_ns} ns"
        else:
            reason = f"the stamp {image.stamp_ns} ns repeats"
        if image.stamp_ns == 0:
            reason += "; the driver stamps nothing: --set sync.stamps=recording takes the bag's"
        self._ready.append(FaultyFrame(stamp_ns=image.stamp_ns, reason=reason))

    def add_alone(self, image: StampedImage, next_ns: int | None, *, is_crowded: bool) -> None:
        """Answer for an image without partner; `next_ns`: the next stamp of stream 1."""
        if self.is_late(image):
            self.add_late(image)
            return
        around = [stamp_ns for stamp_ns in (self._passed_ns, next_ns) if stamp_ns is not None]
        gaps = [abs(stamp_ns - image.stamp_ns) for stamp_ns in around]
        nearest = f"the nearest is {min(gaps) / 1e6:g} ms away" if gaps else "there is none"
        if is_crowded:
            nearest += f", and {_QUEUE_SIZE} images, or 512 MB, wait already"
        elif gaps and min(gaps) <= self._limit_ns:
            nearest += " and belongs to another image"
        reason = f"no {self._partner}={self._limit_ns / 1e6:g}: {nearest}"
        self._ready.append(FaultyFrame(stamp_ns=image.stamp_ns, reason=reason, is_unpaired=True))

    def pass_partner(self, partner: StampedImage) -> None:
        self._passed_ns = partner.stamp_ns


class _ExactTime:
    """Images wait by their stamp; a pair ends the wait of all older ones."""

    def __init__(self, answers: _Answers) -> None:
        self._answers = answers
        self._stamps: list[int] = []  # a heap of the keys of `_waiting`
        self._waiting: dict[int, list[StampedImage | None]] = {}

    def push(self, image: StampedImage) -> None:
        """Take the next image of either stream."""
        if self._answers.is_late(image):
            # message_filters would pair it with another late one; no frame could come of it
            if image.stream == 0:
                self._answers.add_late(image)
            return
        if image.stamp_ns not in self._waiting:
            self._waiting[image.stamp_ns] = [None, None]
            heapq.heappush(self._stamps, image.stamp_ns)
        self._store(image)
        while self._answers.is_crowded(
            len(self._waiting), chain.from_iterable(self._waiting.values())
        ):
            self._leave_oldest(is_crowded=True)

    def end(self) -> None:
        """Give up what waits."""
        while self._stamps:
            self._leave_oldest()

    def _store(self, image: StampedImage) -> None:
        """Put an image beside its partner, instead of an earlier one of the same stamp."""
        images = self._waiting[image.stamp_ns]
        replaced, images[image.stream] = images[image.stream], image
        if replaced is not None and replaced.stream == 0:
            self._answers.add_late(replaced)
        first, second = images
        if first is not None and second is not None:
            while self._stamps[0] < image.stamp_ns:
                self._leave_oldest()
            del self._waiting[heapq.heappop(self._stamps)]
            self._answers.add_pair(first, second)

    def _leave_oldest(self, *, is_crowded: bool = False) -> None:
        image, partner = self._waiting.pop(heapq.heappop(self._stamps))
        if partner is not None:
            self._answers.pass_partner(partner)
        if image is not None:
            partners = (stamp for stamp, images in self._waiting.items() if images[1] is not None)
            next_ns = min(partners, default=None)
            # Where a later partner is known, a longer queue would not have helped.
            self._answers.add_alone(image, next_ns, is_crowded=is_crowded and next_ns is None)


class _ApproximateTime:
    """Two queues; the fronts make the candidate where there is a pivot.

    `_pivot` is the stream whose front is the pivot: the later front of the first interval within
    the limit. The front of the other queue is its best partner so far; `_n_seen` images of
    that queue have been looked at, the best one included. Each pivot looks at the images of the
    other stream up to the first one after it.
    """

    def __init__(self, limit_ns: int, answers: _Answers, *, is_live: bool) -> None:
        self._periods = (_Period(), _Period()) if is_live else None
        self._limit_ns, self._answers = limit_ns, answers
        self._queues: tuple[deque[StampedImage], deque[StampedImage]] = (deque(), deque())
        # Where images were given up, one of them might have suited a pivot better than what is
        # left: no image of that stream is a pivot until the other stream has caught up.
        self._has_gap = [False, False]
        self._pivot: int | None = None
        self._n_seen = 0

    def push(self, image: StampedImage) -> None:
        """Take the next image of either stream."""
        queue = self._queues[image.stream]
        queue.append(image)
        if self._periods is not None:
            self._periods[image.stream].add(image.stamp_ns)
        self._advance()
        while self._answers.is_crowded(len(queue), queue):
            self._pivot = None
            self._leave(image.stream, is_crowded=True)
            self._has_gap[image.stream] = True
            self._advance()

    def end(self) -> None:
        """Give out the pairs held back, and give up the rest."""
        while self._pivot is not None:
            self._give_candidate()
            self._advance()
        while self._queues[0]:
            self._leave(0)

    def _advance(self) -> None:
        """Do all that the images known so far allow."""
        while self._find_pivot() if self._pivot is None else self._look_on(self._pivot):
            pass

    def _find_pivot(self) -> bool:
        """Look at the fronts; tell whether there were both."""
        if not (self._queues[0] and self._queues[1]):
            return False
        gap_ns = self._queues[1][0].stamp_ns - self._queues[0][0].stamp_ns
        earlier, later = (0, 1) if gap_ns >= 0 else (1, 0)
        self._has_gap[earlier] = False
        if abs(gap_ns) > self._limit_ns:
            self._leave(earlier)
        elif self._has_gap[later]:
            self._leave(earlier, is_crowded=True)
        else:
            self._pivot, self._n_seen = later, 1
            if gap_ns == 0:
                self._give_candidate()
        return True

    def _look_on(self, pivot: int) -> bool:
        """Look at one more image of the other stream; tell whether there was one."""
        others = self._queues[1 - pivot]
        pivot_ns = self._queues[pivot][0].stamp_ns
        if self._n_seen == len(others):
            return self._give_early(pivot, pivot_ns)
        best_ns, next_ns = others[0].stamp_ns, others[self._n_seen].stamp_ns
        if next_ns > pivot_ns:
            is_better = self._is_nearer(pivot_ns, best_ns, next_ns)
        else:
            is_better = next_ns > best_ns  # it is not where stamps repeat or go back
        if is_better:
            for _ in range(self._n_seen):
                self._leave(1 - pivot)
            self._n_seen = 0
        self._n_seen += 1
        if next_ns >= pivot_ns:
            self._give_candidate()
        return True

    def _give_early(self, pivot: int, pivot_ns: int) -> bool:
        """Give the candidate out if no image that may come suits the pivot better."""
        shortest_ns = None if self._periods is None else self._periods[1 - pivot].shortest_ns
        if shortest_ns is None:
            return False
        others = self._queues[1 - pivot]
        soonest_ns = others[-1].stamp_ns + shortest_ns
        if soonest_ns < pivot_ns or self._is_nearer(pivot_ns, others[0].stamp_ns, soonest_ns):
            return False
        self._give_candidate()
        return True

    def _is_nearer(self, pivot_ns: int, best_ns: int, later_ns: int) -> bool:
        """Tell whether a partner after the pivot is preferred to the best one before it."""
        return _scaled_ns(later_ns - pivot_ns, 1 + _AGE_PENALTY) < pivot_ns - best_ns

    def _give_candidate(self) -> None:
        self._pivot = None
        self._answers.add_pair(self._queues[0].popleft(), self._queues[1].popleft())

    def _leave(self, stream: int, *, is_crowded: bool = False) -> None:
        image = self._queues[stream].popleft()
        if stream == 1:
            self._answers.pass_partner(image)
        else:
            next_ns = self._queues[1][0].stamp_ns if self._queues[1] else None
            self._answers.add_alone(image, next_ns, is_crowded=is_crowded)


class _Period:
    """The time between the images of a stream, by their stamps."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._n_known = 0
        self._least_ns = 0

    def add(self, stamp_ns: int) -> None:
        if self._last_ns is not None:
            step_ns = stamp_ns - self._last_ns
            if step_ns <= 0:  # a stamp gone wrong
                return
            self._least_ns = step_ns if self._n_known == 0 else min(self._least_ns, step_ns)
            self._n_known += 1
        self._last_ns = stamp_ns

    @property
    def shortest_ns(self) -> int | None:
        """What no period is expected to be below; None as long as few are known."""
        return int(_SHORTEST * self._least_ns) if self._n_known >= _N_PERIODS else None


def _scaled_ns(duration_ns: int, factor: float) -> int:
    """Scale a duration as ROS does: by way of seconds, so that ties fall alike."""
    seconds = (duration_ns // 10**9 + 1e-9 * (duration_ns % 10**9)) * factor
    whole = math.floor(seconds)
    return whole * 10**9 + math.floor((seconds - whole) * 1e9 + 0.5)


class StampFilter:
    """Takes out images with a stamp far ahead of those before and after.

    Frames have increasing stamps: one that is an hour ahead would make all frames of the next
    hour late. So images after a step of more than a second wait for the next ones of their
    stream: where these go back to before the step, the stamps of those that wait are wrong. At
    most two in a row are found; where three agree, a clock was set or the recording has a gap.
    """

    def __init__(self, images: Iterable[StampedImage]) -> None:
        self._images = images
        self._last_ns: list[int | None] = [None, None]
        self._waiting: tuple[list[StampedImage], list[StampedImage]] = ([], [])
        self._faulty: list[FaultyFrame] = []

    def images(self) -> Iterator[StampedImage]:
        """Yield all images but those with stray stamps."""
        try:
            for image in self._images:
                yield from self._judge(image)
        except GvoError:
            yield from self._left()  # what was read before it counts
            raise
        yield from self._left()

    def _left(self) -> Iterator[StampedImage]:
        return (image for waiting in self._waiting for image in waiting)

    def take_faulty(self) -> list[FaultyFrame]:
        """Return the frames of stream 0 that were taken out since the last call."""
        faulty, self._faulty = self._faulty, []
        return faulty

    def _judge(self, image: StampedImage) -> Iterator[StampedImage]:
        waiting, last_ns = self._waiting[image.stream], self._last_ns[image.stream]
        if waiting and last_ns is not None and last_ns < image.stamp_ns < waiting[0].stamp_ns:
            self._refuse(waiting, last_ns, image.stamp_ns)
            waiting.clear()
        if waiting or (last_ns is not None and image.stamp_ns - last_ns > _LEAP_NS):
            waiting.append(image)
            if len(waiting) < _N_TO_CONFIRM:
                return
            ready = waiting.copy()
            waiting.clear()
        else:
            ready = [image]
        newest_ns = max(found.stamp_ns for found in ready)
        self._last_ns[image.stream] = newest_ns if last_ns is None else max(last_ns, newest_ns)
        yield from ready

    def _refuse(self, strays: list[StampedImage], last_ns: int, next_ns: int) -> None:
        self._faulty += [
            FaultyFrame(
                stamp_ns=stray.stamp_ns,
                reason=f"the stamp is {(stray.stamp_ns - last_ns) / 1e9:g} s ahead of the one "
                f"before, and the next one goes back to {next_ns} ns",
            )
            for stray in strays
            if stray.stream == 0
        ]
