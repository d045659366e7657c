"""Faults of delivery: images lost, repeated, late, out of step, from elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.testing.faults.fault import Fault, ImageFault, Shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Dropped(Fault):
    """Images that are missing: lost on the way, or never taken.

    Without parameters none is left; with `first`, the recording ends early.
    """

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield the images that are not struck."""
        return (shot for shot in shots if not self.strikes(shot))


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeated(Fault):
    """Images that are delivered twice, with the same stamp."""

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck twice."""
        for shot in shots:
            yield shot
            if self.strikes(shot):
                yield shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Frozen(Fault):
    """A camera that hangs: the last image before, again and again, with new stamps."""

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images; those that are struck show what the last sound one shows."""
        last: dict[int, StampedImage] = {}
        for shot in shots:
            image = shot.image
            if self.strikes(shot):
                shown = last.setdefault(image.stream, image)
                yield replace(shot, image=replace(image, load=shown.load))
            else:
                last[image.stream] = image
                yield shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Late(Fault):
    """Images that are delivered late, with the right stamps.

    Parameters
    ----------
    by : int
        So many images of the same stream come before.
    """

    by: int = 1

    def __post_init__(self) -> None:
        """Check the ranges."""
        Fault.__post_init__(self)
        if self.by < 1:
            raise ValueError(f"by must be 1 or more, got {self.by}")

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck later."""
        waiting: list[Shot] = []
        for shot in shots:
            if self.strikes(shot):
                waiting.append(shot)
                continue
            yield shot
            due = [late for late in waiting if self._is_due(late, shot)]
            waiting = [late for late in waiting if late not in due]
            yield from due
        yield from waiting

    def _is_due(self, late: Shot, shot: Shot) -> bool:
        return shot.image.stream == late.image.stream and shot.frame >= late.frame + self.by


@dataclass(frozen=True, slots=True, kw_only=True)
class Shuffled(Fault):
    """Images in a random order, with the right stamps.

    Parameters
    ----------
    within : int
        So many images of each stream, that are struck and follow one another, change places.
    """

    within: int = 4

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck in another order."""
        held: list[Shot] = []
        for shot in shots:
            if self.strikes(shot):
                held.append(shot)
            if len(held) >= self.within * len(self.streams) or not self.strikes(shot):
                yield from self._mixed(held)
                held = []
            if not self.strikes(shot):
                yield shot
        yield from self._mixed(held)

    def _mixed(self, held: list[Shot]) -> Iterator[Shot]:
        if held:
            order = np.random.default_rng([self.seed, held[0].frame]).permutation(len(held))
            yield from (held[index] for index in order.tolist())


@dataclass(frozen=True, slots=True, kw_only=True)
class Lagging(Fault):
    """Images that show what was to be seen some frames before; the first ones all the same.

    Parameters
    ----------
    by : int
        Frames.
    """

    by: int = 1

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images; those that are struck show an earlier one."""
        earlier: dict[int, list[StampedImage]] = {0: [], 1: []}
        for shot in shots:
            past = earlier[shot.image.stream]
            past.append(shot.image)
            del past[: -self.by - 1]
            if self.strikes(shot):
                yield replace(shot, image=replace(shot.image, load=past[0].load))
            else:
                yield shot


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchanged(Fault):
    """Left and right exchanged: each stream shows what the other one sees.

    Both images of a frame must be struck, and follow each other.
    """

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck with the pixels of their partners."""
        held: Shot | None = None
        for shot in shots:
            if not self.strikes(shot):
                yield shot
            elif held is None:
                held = shot
            else:
                yield replace(held, image=replace(held.image, load=shot.image.load))
                yield replace(shot, image=replace(shot.image, load=held.image.load))
                held = None
        if held is not None:
            yield held


@dataclass(frozen=True, slots=True, kw_only=True)
class Elsewhere(Fault):
    """A camera that was switched off, carried away and switched on again.

    Parameters
    ----------
    other : Source
        What it shows then: its frames of the same numbers, with the stamps as they are. Images
        for which it has none are left as they are.
    """

    other: Source

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck with the pixels of the other recording."""
        others: tuple[list[StampedImage], list[StampedImage]] = ([], [])
        for image in self.other.images():
            others[image.stream].append(image)
        for shot in shots:
            images = others[shot.image.stream]
            if self.strikes(shot) and shot.frame < len(images):
                load = images[shot.frame].load
                yield replace(shot, image=replace(shot.image, load=load))
            else:
                yield shot


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenOff(Fault):
    """A recording that cannot be read on.

    Parameters
    ----------
    error : type of exception
        Raised in place of the first image that is struck.
    message : str
    """

    error: type[Exception] = RecordingError
    message: str = "the file is cut off"

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield the images before the first one that is struck.

        Raises
        ------
        Exception
            The error that was asked for.
        """
        for shot in shots:
            if self.strikes(shot):
                raise self.error(self.message)
            yield shot


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

    def change_image(self, shot: Shot) -> StampedImage:
        """Return the image with a `load` that fails."""
        return replace(shot.image, load=self._fail)

    def _fail(self) -> NDArray[Any]:
        raise self.error(self.message)
