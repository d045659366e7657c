"""What a fault is, a recording with faults, and faults of the calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory

Pixels: TypeAlias = NDArray[Any]
Kind: TypeAlias = Literal["image", "depth"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaultyImage:
    """An image of a faulty recording, and its place in the original one.

    Parameters
    ----------
    given : StampedImage
        The image, with the faults so far.
    frame : int
        Its number in its stream of the original recording, from 0.
    stamp_ns : int
        Its stamp in the original recording, nanoseconds.
    """

    given: StampedImage
    frame: int
    stamp_ns: int

    def with_pixels(self, load: Callable[[], Pixels]) -> FaultyImage:
        """Return the image with the same stamp and other pixels."""
        return replace(self, given=replace(self.given, load=load))

    def with_stamp(self, stamp_ns: int) -> FaultyImage:
        """Return the image with the same pixels and another stamp in nanoseconds."""
        return replace(self, given=replace(self.given, stamp_ns=stamp_ns))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault of some images of a recording; the base class changes nothing.

    A subclass overrides `inject`, and `change_info` if the calibration is wrong. The same fault
    on the same recording gives the same bytes, in whatever order images are loaded.

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

    Raises
    ------
    ValueError
        For a number out of its range.
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

    def applies_to(self, image: FaultyImage) -> bool:
        """Tell whether an image is affected."""
        since = image.frame - self.first
        is_over = self.end is not None and image.frame >= self.end
        if image.given.stream not in self.streams or since < 0 or is_over:
            return False
        chance = np.random.default_rng([self.seed, image.frame]).random()
        return since % self.every < self.burst and chance < self.share

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield the images with the fault.

        Parameters
        ----------
        images : iterator of FaultyImage
            Both streams in the order of the recording.
        info : RecordingInfo
            Of the original recording.
        """
        yield from images

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        """Return the description of the recording, with the fault."""
        return info

    def rng(self, image: FaultyImage) -> np.random.Generator:
        """Return the random generator of one image."""
        return np.random.default_rng([self.seed, image.frame, image.given.stream])


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFault(Fault):
    """A fault of single images; a subclass overrides `change_image`."""

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images, affected ones changed."""
        for image in images:
            yield self.change_image(image) if self.applies_to(image) else image

    def change_image(self, image: FaultyImage) -> FaultyImage:
        """Return an affected image, with the fault."""
        return image


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelFault(Fault):
    """A fault of pixels, applied when an image is loaded; a subclass overrides `spoil`.

    It affects grey and colour images, and depth images if `kinds` holds "depth".
    """

    def inject(self, images: Iterator[FaultyImage], info: RecordingInfo) -> Iterator[FaultyImage]:
        """Yield all images; the pixels of affected ones change as they are loaded."""
        for image in images:
            kind: Kind = "depth" if info.sensor == "rgbd" and image.given.stream == 1 else "image"
            is_affected = self.applies_to(image) and kind in self.kinds()
            yield image.with_pixels(partial(self._load, image)) if is_affected else image

    def kinds(self) -> tuple[Kind, ...]:
        """Return the kinds of images that can have this fault."""
        return ("image",)

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the pixels with the fault.

        Parameters
        ----------
        pixels : ndarray
            As `StampedImage.load` gives them; not to be changed.
        rng : numpy.random.Generator
            Of this image.
        image : FaultyImage
            The image before the fault.
        """
        return pixels

    def _load(self, image: FaultyImage) -> Pixels:
        return self.spoil(image.given.load(), self.rng(image), image)


class FaultySource:
    """A recording with faults; itself a `Source`.

    Parameters
    ----------
    source : Source
        The original recording, or one with other faults.
    faults : Fault
        Applied one after the other. All number the frames as in `source`.

    Raises
    ------
    ValueError
        For an argument that is no fault.

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
        """What is known before the first image, with the faults of the calibration."""
        info = self._source.info
        for fault in self.faults:
            info = fault.change_info(info)
        return info

    def images(self) -> Iterator[StampedImage]:
        """Yield the images with the faults."""
        return (image.given for image in self.faulty_images())

    def faulty_images(self) -> Iterator[FaultyImage]:
        """Yield the images with the faults and with their places in the original recording."""
        info = self._source.info
        images = _numbered(self._source)
        for fault in self.faults:
            images = fault.inject(images, info)
        return images

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the original recording, with the right stamps."""
        return self._source.ground_truth()


def _numbered(source: Source) -> Iterator[FaultyImage]:
    counts = [0, 0]
    for image in source.images():
        yield FaultyImage(given=image, frame=counts[image.stream], stamp_ns=image.stamp_ns)
        counts[image.stream] += 1


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationFault(Fault):
    """A wrong calibration; a subclass overrides `miscalibrate`.

    It holds for the whole recording: `first`, `end`, `every` and `share` are not used.
    """

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        """Return the info with wrong calibrations."""
        calibrations = tuple(
            self.miscalibrate(calibration) if stream in self.streams else calibration
            for stream, calibration in enumerate(info.calibrations)
        )
        return replace(info, calibrations=calibrations)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return a wrong calibration in place of the right one."""
        return calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongBaseline(CalibrationFault):
    """A baseline in another unit, or of another rig.

    Parameters
    ----------
    factor : float
        Wrong value over right value.
    """

    factor: float = 2.0

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with P[0, 3] multiplied."""
        P = calibration.P.copy()
        P[:, 3] *= self.factor
        return replace(calibration, P=P)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongFocalLength(CalibrationFault):
    """The focal length of another lens, or of another image size; the baseline stays right.

    Parameters
    ----------
    factor : float
        Wrong value over right value.
    """

    factor: float = 1.3

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with fx, fy and fx * baseline multiplied."""
        K, P = calibration.K.copy(), calibration.P.copy()
        K[:2, :2] *= self.factor
        P[:2, [0, 1, 3]] *= self.factor
        return replace(calibration, K=K, P=P)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongPrincipalPoint(CalibrationFault):
    """The principal point of another camera, or of a cropped image.

    Parameters
    ----------
    by : tuple of two float
        (u, v), as shares of width and height.
    """

    by: tuple[float, float] = (0.1, 0.1)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with cx and cy shifted."""
        K, P = calibration.K.copy(), calibration.P.copy()
        shift = np.array([self.by[0] * calibration.width, self.by[1] * calibration.height])
        K[:2, 2] += shift
        P[:2, 2] += shift
        return replace(calibration, K=K, P=P)
