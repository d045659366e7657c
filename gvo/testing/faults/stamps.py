"""Faults of stamps: the images are right, the clock is not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from gvo.io.recording import RecordingInfo
from gvo.testing.faults.fault import Fault, Shot


@dataclass(frozen=True, slots=True, kw_only=True)
class StampFault(Fault):
    """A wrong stamp; a subclass overrides `restamp`. The clock of the recording is right."""

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck with another stamp."""
        start_ns: int | None = None
        for shot in shots:
            if start_ns is None:
                start_ns = shot.stamp_ns
            if self.strikes(shot):
                stamp_ns = self.restamp(shot, start_ns)
                yield replace(shot, image=replace(shot.image, stamp_ns=stamp_ns))
            else:
                yield shot

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp of an image in nanoseconds; that of the first one is `start_ns`."""
        return shot.image.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampShift(StampFault):
    """A clock that is set to another time, or an offset between two clocks.

    Parameters
    ----------
    by_s : float
        Seconds; negative: back.
    """

    by_s: float = 3600.0

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp, shifted."""
        return shot.image.stamp_ns + round(self.by_s * 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class StampConstant(StampFault):
    """A driver that does not stamp: each image gets the same.

    Parameters
    ----------
    stamp_ns : int or None
        Nanoseconds; None: that of the first image of the recording.
    """

    stamp_ns: int | None = 0

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp of all."""
        return start_ns if self.stamp_ns is None else self.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampFromZero(StampFault):
    """A clock that starts with the recording: the first stamp is 0."""

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the time since the first image."""
        return shot.image.stamp_ns - start_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampBackwards(StampFault):
    """A clock that runs backwards."""

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp, mirrored at the start."""
        return 2 * start_ns - shot.image.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampRate(StampFault):
    """A clock that drifts.

    Parameters
    ----------
    rate : float
        Seconds it shows in a second.
    """

    rate: float = 1.001

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp of the clock that was right at the start."""
        return start_ns + round(self.rate * (shot.image.stamp_ns - start_ns))


@dataclass(frozen=True, slots=True, kw_only=True)
class StampUnit(StampFault):
    """Stamps in another unit, taken for nanoseconds.

    Parameters
    ----------
    unit_ns : int
        Nanoseconds of the unit: 10^9 for seconds.
    """

    unit_ns: int = 1_000_000_000

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the number of whole units."""
        return shot.image.stamp_ns // self.unit_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampJitter(StampFault):
    """Stamps of the arrival, not of the exposure; both images of a frame have the same.

    Parameters
    ----------
    sigma_s : float
        Standard deviation, seconds; cut at three.
    is_shared : bool
        Both images of a frame are off by the same.
    """

    sigma_s: float = 0.01
    is_shared: bool = True

    def restamp(self, shot: Shot, start_ns: int) -> int:
        """Return the stamp with its error."""
        image = replace(shot.image, stream=0) if self.is_shared else shot.image
        error = float(self.rng(replace(shot, image=image)).standard_normal())
        error = math.copysign(min(abs(error), 3.0), error)
        return shot.image.stamp_ns + round(1e9 * self.sigma_s * error)
