"""What a fault is, and a recording with faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory

Kind: TypeAlias = Literal["image", "depth"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """An image and its place in the recording that it was taken from.

    Parameters
    ----------
    image : StampedImage
        As it is given now.
    frame : int
        Its number in its stream of the sound recording, from 0.
    stamp_ns : int
        Its stamp there, nanoseconds.
    """

    image: StampedImage
    frame: int
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """What goes wrong with some images of a recording; this one: nothing.

    A subclass overrides `inject`, and `change_info` where the calibration is wrong. The same
    fault on the same recording gives the same bytes, in whatever order images are loaded.

    Parameters
    ----------
    first, end : int, int or None
        Frames that it may strike: from `first` to before `end`, numbered within each stream;
        None: to the last one.
    every, burst : int
        Of these the first `burst` of each `every`.
    share : float
        Of these each one with so much probability. Whether a frame is struck is the same for
        both streams.
    streams : tuple of int
        0: left or colour; 1: right or depth.
    seed : int
        Of all that is random, not negative.

    Raises
    ------
    ValueError
        Where a number is out of its range.
    """

    first: int = 0
    end: int | None = None
    every: int = 1
    burst: int = 1
    share: float = 1.0
    streams: tuple[int, ...] = (0, 1)
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.first < 0 or self.every < 1 or self.burst < 1 or self.seed < 0:
            raise ValueError(
                "first and seed must be 0 or more, every and burst 1 or more, got "
                f"{self.first}, {self.seed}, {self.every}, {self.burst}"
            )
        if not 0.0 <= self.share <= 1.0:
            raise ValueError(f"share must be in [0, 1], got {self.share}")
        if not set(self.streams) <= {0, 1}:
            raise ValueError(f"streams must be of 0 and 1, got {self.streams}")

    def strikes(self, shot: Shot) -> bool:
        """Tell whether an image is among those that the fault is for."""
        since = shot.frame - self.first
        if shot.image.stream not in self.streams or since < 0:
            return False
        if self.end is not None and shot.frame >= self.end:
            return False
        return since % self.every < self.burst and self._is_chosen(shot.frame)

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield the images with the fault.

        Parameters
        ----------
        shots : iterator of Shot
            Both streams in the order of the recording.
        info : RecordingInfo
            Of the recording.
        """
        yield from shots

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        """Return what the recording says of itself."""
        return info

    def rng(self, shot: Shot) -> np.random.Generator:
        """Return a generator that belongs to one image."""
        return np.random.default_rng([self.seed, shot.frame, shot.image.stream])

    def _is_chosen(self, frame: int) -> bool:
        if self.share >= 1.0:
            return True
        return bool(np.random.default_rng([self.seed, frame]).random() < self.share)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFault(Fault):
    """A fault of single images; a subclass overrides `change_image`."""

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images, those that are struck changed."""
        for shot in shots:
            yield replace(shot, image=self.change_image(shot)) if self.strikes(shot) else shot

    def change_image(self, shot: Shot) -> StampedImage:
        """Return an image that is struck, with the fault."""
        return shot.image


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelFault(Fault):
    """A fault of pixels, done when an image is loaded; a subclass overrides `spoil`.

    Grey and colour images are struck; depth images by the faults that say so.
    """

    def inject(self, shots: Iterator[Shot], info: RecordingInfo) -> Iterator[Shot]:
        """Yield all images; the pixels of those that are struck change as they are loaded."""
        for shot in shots:
            kind: Kind = "depth" if info.sensor == "rgbd" and shot.image.stream == 1 else "image"
            if self.strikes(shot) and kind in self.kinds():
                yield replace(shot, image=replace(shot.image, load=_Spoilt(self, shot)))
            else:
                yield shot

    def kinds(self) -> tuple[Kind, ...]:
        """Return which images can have this fault."""
        return ("image",)

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the pixels with the fault.

        Parameters
        ----------
        pixels : ndarray
            As `StampedImage.load` gives them; is not changed.
        rng : numpy.random.Generator
            Of this image.
        shot : Shot
            Which image it is.
        """
        return pixels


@dataclass(frozen=True, slots=True)
class _Spoilt:
    """Loads an image and spoils it."""

    fault: PixelFault
    shot: Shot

    def __call__(self) -> NDArray[Any]:
        return self.fault.spoil(self.shot.image.load(), self.fault.rng(self.shot), self.shot)


class FaultySource:
    """A recording in which something went wrong; itself a `Source`.

    Parameters
    ----------
    source : Source
        The sound recording, or one with other faults.
    faults : Fault
        Done one after the other, each on what those before it left. All number the frames as in
        `source`.

    Raises
    ------
    ValueError
        For what is no fault.

    Examples
    --------
    >>> import gvo
    >>> from gvo.testing.faults import Black, Dropped, FaultySource
    >>> recording = gvo.SyntheticRecording("driving", n_frames=9, scale=0.3)
    >>> faulty = FaultySource(recording, Dropped(every=3), Black(first=4, end=5))
    >>> [image.load().any().item() for image in faulty.images() if image.stream == 0]
    [True, True, False, True, True, True]
    """

    def __init__(self, source: Source, *faults: Fault) -> None:
        for fault in faults:
            if not isinstance(fault, Fault):
                raise ValueError(f"expected faults, got {type(fault).__name__}")
        self._source = source
        self.faults = faults

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image, wrong where a fault makes it so."""
        info = self._source.info
        for fault in self.faults:
            info = fault.change_info(info)
        return info

    def images(self) -> Iterator[StampedImage]:
        """Yield the images that are left, as they are left."""
        return (shot.image for shot in self.shots())

    def shots(self) -> Iterator[Shot]:
        """Yield the images with their places in the sound recording."""
        info = self._source.info
        shots = _numbered(self._source)
        for fault in self.faults:
            shots = fault.inject(shots, info)
        return shots

    def ground_truth(self) -> Trajectory | None:
        """Return what the sound recording holds: stamps of the true poses are right."""
        return self._source.ground_truth()


def _numbered(source: Source) -> Iterator[Shot]:
    counts = [0, 0]
    for image in source.images():
        yield Shot(image=image, frame=counts[image.stream], stamp_ns=image.stamp_ns)
        counts[image.stream] += 1
