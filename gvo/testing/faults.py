"""Faults that are put into any recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory

Pixels: TypeAlias = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaultyImage:
    """An image with the faults so far; `frame` is its number in its stream before all faults."""

    given: StampedImage
    frame: int

    def with_pixels(self, load: Callable[[], Pixels]) -> FaultyImage:
        """Return the image with the same stamp and other pixels."""
        return replace(self, given=replace(self.given, load=load))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault of some images of a recording; a subclass overrides `inject`.

    Parameters
    ----------
    first, end : int, int or None
        Frames that may be affected: from `first` to before `end`, numbered within each stream;
        None: to the last one.
    every, burst : int
        Of these the first `burst` of each `every`.
    share : float
        Probability with which each of these is affected, the same frames in both streams.
    streams : tuple of int
        0: left or colour; 1: right or depth.
    seed : int
        Seed of all that is random, not negative.
    """

    first: int = 0
    end: int | None = None
    every: int = 1
    burst: int = 1
    share: float = 1.0
    streams: tuple[int, ...] = (0, 1)
    seed: int = 0

    def applies_to(self, image: FaultyImage) -> bool:
        """Tell whether an image is affected."""
        since = image.frame - self.first
        is_over = self.end is not None and image.frame >= self.end
        if image.given.stream not in self.streams or since < 0 or is_over:
            return False
        chance = np.random.default_rng([self.seed, image.frame]).random()
        return since % self.every < self.burst and chance < self.share

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield the images of both streams, in the order of the recording, with the fault."""
        yield from images


@dataclass(frozen=True, slots=True, kw_only=True)
class Dropped(Fault):
    """Missing images: lost on the way, or never taken.

    Without parameters none is left; with `first`, the recording ends early.
    """

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield the images that are not affected."""
        return (image for image in images if not self.applies_to(image))


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelFault(Fault):
    """A fault of grey and colour images, applied when an image is loaded.

    A subclass overrides `spoil`, and `is_possible` where depth images can have the fault too.
    """

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images; the pixels of affected ones change as they are loaded."""
        for image in images:
            is_depth = info.sensor == "rgbd" and image.given.stream == 1
            is_affected = self.applies_to(image) and self.is_possible(is_depth)
            yield image.with_pixels(partial(self._load, image)) if is_affected else image

    def is_possible(self, is_depth: bool) -> bool:
        """Tell whether images of depth, or of grey values and colours, can have this fault."""
        return not is_depth

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        """Return the pixels with the fault; those given are not to be changed."""
        return pixels

    def _load(self, image: FaultyImage) -> Pixels:
        return self.spoil(image.given.load(), image)


@dataclass(frozen=True, slots=True, kw_only=True)
class Black(PixelFault):
    """Black images: a cap on the lens, no light."""

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        """Return zeros."""
        return np.zeros_like(pixels)


class FaultySource:
    """A recording with faults; itself a `Source`.

    Parameters
    ----------
    source : Source
        The original recording, or one with other faults.
    faults : Fault
        Applied one after the other. All number the frames as in `source`.

    Examples
    --------
    >>> import gvo
    >>> from gvo.testing import Black, Dropped, FaultySource
    >>> recording = gvo.SyntheticRecording("driving", n_frames=9, scale=0.3)
    >>> faulty = FaultySource(recording, Dropped(every=3), Black(first=4, end=5))
    >>> [image.load().any().item() for image in faulty.images() if image.stream == 0]
    [True, True, False, True, True, True]
    """

    def __init__(self, source: Source, *faults: Fault) -> None:
        self._source, self.faults = source, faults

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        return self._source.info

    def images(self) -> Iterator[StampedImage]:
        """Yield the images with the faults."""
        return (image.given for image in self.faulty_images())

    def faulty_images(self) -> Iterator[FaultyImage]:
        """Yield the images with the faults and with their numbers in the original recording."""
        info, images = self._source.info, self._numbered()
        for fault in self.faults:
            images = fault.inject(images, info)
        return images

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the original recording, with the right stamps."""
        return self._source.ground_truth()

    def _numbered(self) -> Iterator[FaultyImage]:
        counts = [0, 0]
        for image in self._source.images():
            yield FaultyImage(given=image, frame=counts[image.stream])
            counts[image.stream] += 1
