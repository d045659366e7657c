"""Single stamps far ahead of all others, which would make what follows seem late."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from gvo.errors import GvoError
from gvo.sources.recording import StampedImage
from gvo.types import FaultyFrame

# A step so long is a gap, or a stamp gone wrong: the next images tell.
_LEAP_NS = 1_000_000_000
# So many images in a row that are all after the leap: it was a gap.
_N_TO_CONFIRM = 3


class StrayStamps:
    """Takes out images with a stamp far ahead of those before and after.

    Frames have increasing stamps: one that is an hour ahead would make all frames of the next
    hour late. So images after a step of more than a second wait for the next ones of their
    stream: where these go back to before the step, the stamps of those that wait are wrong. At
    most two in a row are found; where three agree, a clock was set or the recording has a gap.

    Parameters
    ----------
    images : iterable of StampedImage
        Both streams.
    """

    def __init__(self, images: Iterable[StampedImage]) -> None:
        self._images = images
        self._last_ns: list[int | None] = [None, None]
        self._waiting: tuple[list[StampedImage], list[StampedImage]] = ([], [])
        self._faulty: list[FaultyFrame] = []

    def sound(self) -> Iterator[StampedImage]:
        """Yield all images but those with stray stamps.

        Raises
        ------
        GvoError
            What reading the images raises, after those that wait.
        """
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
