"""Faults of delivery, stamps and calibration."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gvo import testing
from gvo.errors import RecordingError
from gvo.io.recording import RecordingInfo, Source
from gvo.testing.faults import Fault, FaultyImage, Pixels
from gvo.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeated(Fault):
    """Images that are delivered twice, with the same stamp."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        for image in images:
            yield image
            if self.applies_to(image):
                yield image


@dataclass(frozen=True, slots=True, kw_only=True)
class Frozen(Fault):
    """A camera that hangs: the last image before, again and again, with new stamps."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
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
    """Images that are delivered late, with the right stamps."""

    by: int = 1

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
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
    """Images in a random order, with the right stamps."""

    within: int = 4

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
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
    """Images that show an earlier frame; the first ones show the first frame."""

    by: int = 1

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        earlier: tuple[deque[FaultyImage], ...] = tuple(deque(maxlen=self.by + 1) for _ in range(2))
        for image in images:
            past = earlier[image.given.stream]
            past.append(image)
            yield image.with_pixels(past[0].given.load) if self.applies_to(image) else image


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchanged(Fault):
    """Left and right exchanged: each stream shows what the other one sees."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
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
    """A camera that was switched off, carried away and switched on again."""

    other: Source

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        others = [[image for image in self.other.images() if image.stream == n] for n in (0, 1)]
        for image in images:
            shown = others[image.given.stream][image.frame : image.frame + 1]
            is_affected = shown and self.applies_to(image)
            yield image.with_pixels(shown[0].load) if is_affected else image


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenOff(Fault):
    """A recording that cannot be read on."""

    error: type[Exception] = RecordingError
    message: str = "the file is cut off"

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        for image in images:
            if self.applies_to(image):
                raise self.error(self.message)
            yield image


@dataclass(frozen=True, slots=True, kw_only=True)
class Unloadable(Fault):
    """Images that cannot be loaded."""

    error: type[Exception] = RecordingError
    message: str = "the image is damaged"

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        for image in images:
            yield image.with_pixels(self._fail) if self.applies_to(image) else image

    def _fail(self) -> Pixels:
        raise self.error(self.message)


@dataclass(frozen=True, slots=True, kw_only=True)
class Restamped(Fault):
    """Stamps changed by a function of them and the first one; that of the recording is right."""

    by: Callable[[int, int], int]

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        start_ns: int | None = None
        for image in images:
            given = image.given
            start_ns = given.stamp_ns if start_ns is None else start_ns
            if self.applies_to(image):
                given = replace(given, stamp_ns=self.by(given.stamp_ns, start_ns))
            yield replace(image, given=given)


def stamps_moved(by_s: float, **options: Any) -> Restamped:
    """Return a clock that is set to another time, or an offset between two clocks."""
    by_ns = round(by_s * 1e9)
    return Restamped(by=lambda stamp_ns, _: stamp_ns + by_ns, **options)


def stamps_of_arrival(sigma_s: float, **options: Any) -> Restamped:
    """Return stamps that are off at random."""

    def restamp(stamp_ns: int, _: int) -> int:
        error = float(np.random.default_rng(stamp_ns % 10**9).standard_normal())
        return stamp_ns + round(1e9 * sigma_s * min(max(error, -3.0), 3.0))

    return Restamped(by=restamp, **options)


@dataclass(frozen=True, slots=True, kw_only=True)
class Miscalibrated(Fault):
    """K and P times a factor each, for the whole recording."""

    K: FloatArray | float = 1.0
    P: FloatArray | float = 1.0

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        calibrations = tuple(
            replace(each, K=each.K * self.K, P=each.P * self.P) if stream in self.streams else each
            for stream, each in enumerate(info.calibrations)
        )
        return replace(info, calibrations=calibrations)


class FaultySource(testing.FaultySource):
    """A recording with faults, also of its calibration."""

    @property
    def info(self) -> RecordingInfo:
        info = super().info
        for fault in self.faults:
            info = fault.change_info(info) if isinstance(fault, Miscalibrated) else info
        return info


def wrong_baseline(factor: float) -> Miscalibrated:
    return Miscalibrated(P=np.array([[1.0, 1.0, 1.0, factor]]))


def wrong_focal_length(factor: float, **options: Any) -> Miscalibrated:
    """Return the calibration of another lens; the baseline stays right."""
    K = np.array([[factor, factor, 1.0], [factor, factor, 1.0], [1.0, 1.0, 1.0]])
    P = np.array([[factor, factor, 1.0, factor], [factor, factor, 1.0, factor], [1.0] * 4])
    return Miscalibrated(K=K, P=P, **options)


def wrong_principal_point(factor: float) -> Miscalibrated:
    K = np.array([[1.0, 1.0, factor], [1.0, 1.0, factor], [1.0, 1.0, 1.0]])
    return Miscalibrated(K=K, P=np.column_stack([K, np.ones(3)]))
