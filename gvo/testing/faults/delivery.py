"""Faults of delivery and stamps: images lost, repeated, late, out of step; wrong clocks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gvo.errors import RecordingError
from gvo.io.recording import RecordingInfo, Source
from gvo.testing.faults.fault import Fault, FaultyImage, ImageFault, Pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Dropped(Fault):
    """Missing images: lost on the way, or never taken.

    Without parameters none is left; with `first`, the recording ends early.
    """

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield the images that are not affected."""
        return (image for image in images if not self.applies_to(image))


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeated(Fault):
    """Images that are delivered twice, with the same stamp."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones twice."""
        for image in images:
            yield image
            if self.applies_to(image):
                yield image


@dataclass(frozen=True, slots=True, kw_only=True)
class Frozen(Fault):
    """A camera that hangs: the last image before, again and again, with new stamps."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images; affected ones show the last one before that is not."""
        last: dict[int, FaultyImage] = {}
        for image in images:
            stream = image.given.stream
            if self.applies_to(image):
                yield image.with_pixels(last.setdefault(stream, image).given.load)
            else:
                last[stream] = image
                yield image


@dataclass(frozen=True, slots=True, kw_only=True)
class Late(Fault):
    """Images that are delivered late, with the right stamps.

    Parameters
    ----------
    by : int
        Number of images of the same stream that come before.
    """

    by: int = 1

    def __post_init__(self) -> None:
        """Check the ranges."""
        Fault.__post_init__(self)
        if self.by < 1:
            raise ValueError(f"by must be 1 or more, got {self.by}")

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones later."""
        waiting: list[FaultyImage] = []
        for image in images:
            if self.applies_to(image):
                waiting.append(image)
                continue
            yield image
            due = [late for late in waiting if self._is_due(late, image)]
            waiting = [late for late in waiting if late not in due]
            yield from due
        yield from waiting

    def _is_due(self, late: FaultyImage, image: FaultyImage) -> bool:
        return image.given.stream == late.given.stream and image.frame >= late.frame + self.by


@dataclass(frozen=True, slots=True, kw_only=True)
class Shuffled(Fault):
    """Images in a random order, with the right stamps.

    Parameters
    ----------
    within : int
        Number of consecutive affected images of each stream that change places.
    """

    within: int = 4

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones in another order."""
        held: list[FaultyImage] = []
        for image in images:
            is_affected = self.applies_to(image)
            if is_affected:
                held.append(image)
            if len(held) >= self.within * len(self.streams) or not is_affected:
                yield from self._mixed(held)
                held = []
            if not is_affected:
                yield image
        yield from self._mixed(held)

    def _mixed(self, held: list[FaultyImage]) -> Iterator[FaultyImage]:
        if held:
            order = np.random.default_rng([self.seed, held[0].frame]).permutation(len(held))
            yield from (held[index] for index in order.tolist())


@dataclass(frozen=True, slots=True, kw_only=True)
class Lagging(Fault):
    """Images that show an earlier frame; the first ones show the first frame.

    Parameters
    ----------
    by : int
        Frames.
    """

    by: int = 1

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images; affected ones show an earlier one."""
        earlier: tuple[deque[FaultyImage], ...] = tuple(deque(maxlen=self.by + 1) for _ in range(2))
        for image in images:
            past = earlier[image.given.stream]
            past.append(image)
            yield image.with_pixels(past[0].given.load) if self.applies_to(image) else image


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchanged(Fault):
    """Left and right exchanged: each stream shows what the other one sees.

    Both images of a frame must be affected, and follow each other.
    """

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones with the pixels of their partners."""
        held: FaultyImage | None = None
        for image in images:
            if not self.applies_to(image):
                yield image
            elif held is None:
                held = image
            else:
                yield held.with_pixels(image.given.load)
                yield image.with_pixels(held.given.load)
                held = None
        if held is not None:
            yield held


@dataclass(frozen=True, slots=True, kw_only=True)
class Elsewhere(Fault):
    """A camera that was switched off, carried away and switched on again.

    Parameters
    ----------
    other : Source
        Recording of the other place: frames of the same numbers are shown, with unchanged stamps.
        Images for which it has none stay as they are.
    """

    other: Source

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones with the pixels of the other recording."""
        others = [[image for image in self.other.images() if image.stream == n] for n in (0, 1)]
        for image in images:
            shown = others[image.given.stream][image.frame : image.frame + 1]
            is_affected = shown and self.applies_to(image)
            yield image.with_pixels(shown[0].load) if is_affected else image


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenOff(Fault):
    """A recording that cannot be read on.

    Parameters
    ----------
    error : type of exception
        Raised in place of the first affected image.
    message : str
    """

    error: type[Exception] = RecordingError
    message: str = "the file is cut off"

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield the images before the first affected one.

        Raises
        ------
        Exception
            Of the type and with the message given.
        """
        for image in images:
            if self.applies_to(image):
                raise self.error(self.message)
            yield image


@dataclass(frozen=True, slots=True, kw_only=True)
class Unloadable(ImageFault):
    """Images that cannot be loaded.

    Parameters
    ----------
    error : type of exception
        Raised by `StampedImage.load`.
    message : str
    """

    error: type[Exception] = RecordingError
    message: str = "the image is damaged"

    def change_image(self, image: FaultyImage) -> FaultyImage:
        """Return the image with a `load` that fails."""
        return image.with_pixels(self._fail)

    def _fail(self) -> Pixels:
        raise self.error(self.message)


@dataclass(frozen=True, slots=True, kw_only=True)
class StampFault(Fault):
    """A wrong stamp; a subclass overrides `restamp`. The clock of the recording is right."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones with another stamp."""
        start_ns: int | None = None
        for image in images:
            start_ns = image.stamp_ns if start_ns is None else start_ns
            is_affected = self.applies_to(image)
            yield image.with_stamp(self.restamp(image, start_ns)) if is_affected else image

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp of an image in nanoseconds; that of the first one is `start_ns`."""
        return image.given.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampShift(StampFault):
    """A clock that is set to another time, or an offset between two clocks.

    Parameters
    ----------
    by_s : float
        Seconds; negative: back.
    """

    by_s: float = 3600.0

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp, shifted."""
        return image.given.stamp_ns + round(self.by_s * 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class StampConstant(StampFault):
    """A driver that does not stamp: all images have the same stamp.

    Parameters
    ----------
    stamp_ns : int or None
        Nanoseconds; None: that of the first image of the recording.
    """

    stamp_ns: int | None = 0

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the common stamp."""
        return start_ns if self.stamp_ns is None else self.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampFromZero(StampFault):
    """A clock that starts with the recording: the first stamp is 0."""

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the time since the first image."""
        return image.given.stamp_ns - start_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampBackwards(StampFault):
    """A clock that runs backwards."""

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp, mirrored at the start."""
        return 2 * start_ns - image.given.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampRate(StampFault):
    """A clock that drifts.

    Parameters
    ----------
    rate : float
        Seconds of the clock in a second.
    """

    rate: float = 1.001

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp of the clock that was right at the start."""
        return start_ns + round(self.rate * (image.given.stamp_ns - start_ns))


@dataclass(frozen=True, slots=True, kw_only=True)
class StampUnit(StampFault):
    """Stamps in another unit, taken for nanoseconds.

    Parameters
    ----------
    unit_ns : int
        Nanoseconds of the unit: 10^9 for seconds.
    """

    unit_ns: int = 1_000_000_000

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp in whole units."""
        return image.given.stamp_ns // self.unit_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampJitter(StampFault):
    """Stamps of the arrival, not of the exposure.

    Parameters
    ----------
    sigma_s : float
        Standard deviation, seconds; errors end at three of them.
    is_shared : bool
        Both images of a frame have the same error.
    """

    sigma_s: float = 0.01
    is_shared: bool = True

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        """Return the stamp with its error."""
        given = replace(image.given, stream=0) if self.is_shared else image.given
        error = float(self.rng(replace(image, given=given)).standard_normal())
        error = math.copysign(min(abs(error), 3.0), error)
        return image.given.stamp_ns + round(1e9 * self.sigma_s * error)
