"""Faults of delivery, stamps and calibration."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.recording import RecordingInfo, Source
from gvo.testing.faults import Fault, FaultyImage, Pixels


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
class StampFault(Fault):
    """A wrong stamp; a subclass overrides `restamp`. The clock of the recording is right."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        start_ns: int | None = None
        for image in images:
            start_ns = image.given.stamp_ns if start_ns is None else start_ns
            if self.applies_to(image):
                stamp_ns = self.restamp(image, start_ns)
                image = replace(image, given=replace(image.given, stamp_ns=stamp_ns))
            yield image

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return image.given.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampShift(StampFault):
    """A clock that is set to another time, or an offset between two clocks."""

    by_s: float = 3600.0

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return image.given.stamp_ns + round(self.by_s * 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class StampConstant(StampFault):
    """A driver that does not stamp: all images have the same stamp."""

    stamp_ns: int | None = 0

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return start_ns if self.stamp_ns is None else self.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampFromZero(StampFault):
    """A clock that starts with the recording: the first stamp is 0."""

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return image.given.stamp_ns - start_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampBackwards(StampFault):
    """A clock that runs backwards."""

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return 2 * start_ns - image.given.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampRate(StampFault):
    """A clock that drifts."""

    rate: float = 1.001

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return start_ns + round(self.rate * (image.given.stamp_ns - start_ns))


@dataclass(frozen=True, slots=True, kw_only=True)
class StampUnit(StampFault):
    """Stamps in another unit, taken for nanoseconds."""

    unit_ns: int = 1_000_000_000

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        return image.given.stamp_ns // self.unit_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampJitter(StampFault):
    """Stamps of the arrival, not of the exposure."""

    sigma_s: float = 0.01
    is_shared: bool = True

    def restamp(self, image: FaultyImage, start_ns: int) -> int:
        given = replace(image.given, stream=0) if self.is_shared else image.given
        error = float(self.rng(replace(image, given=given)).standard_normal())
        error = math.copysign(min(abs(error), 3.0), error)
        return image.given.stamp_ns + round(1e9 * self.sigma_s * error)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationFault(Fault):
    """A wrong calibration, for the whole recording."""

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        calibrations = tuple(
            self.miscalibrate(calibration) if stream in self.streams else calibration
            for stream, calibration in enumerate(info.calibrations)
        )
        return replace(info, calibrations=calibrations)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        return calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongBaseline(CalibrationFault):
    """A baseline in another unit, or of another rig."""

    factor: float = 2.0

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        P = calibration.P.copy()
        P[:, 3] *= self.factor
        return replace(calibration, P=P)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongFocalLength(CalibrationFault):
    """The focal length of another lens; the baseline stays right."""

    factor: float = 1.3

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        K, P = calibration.K.copy(), calibration.P.copy()
        K[:2, :2] *= self.factor
        P[:2, [0, 1, 3]] *= self.factor
        return replace(calibration, K=K, P=P)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongPrincipalPoint(CalibrationFault):
    """The principal point of another camera; off by shares of width and height."""

    by: tuple[float, float] = (0.1, 0.1)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        K, P = calibration.K.copy(), calibration.P.copy()
        shift = np.array([self.by[0] * calibration.width, self.by[1] * calibration.height])
        K[:2, 2] += shift
        P[:2, 2] += shift
        return replace(calibration, K=K, P=P)
