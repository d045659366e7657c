"""Recordings in memory, whose images and stamps can be changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

from numpy.typing import NDArray

import gvo
from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.recording import RecordingInfo, Sensor, Source, StampedImage
from gvo.io.synthetic import SensorNoise, SyntheticRecording
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame, Frame

Item = tuple[int, int, NDArray[Any] | Exception]
"""Stream, stamp, and pixels or what loading raises."""
Change = Callable[[NDArray[Any]], NDArray[Any]]
_NONE = ("grey_sigma", "exposure_drift", "exposure_mismatch", "depth_sigma", "depth_step")
PERFECT = SensorNoise(
    **dict.fromkeys((*_NONE, "hole_share", "min_depth_m"), 0.0),
    edge_radius_px=0,
    max_depth_m=float("inf"),
)
"""A sensor without noise or limits."""


@dataclass(eq=False)
class Held:
    """A recording as a list of images; where damage is told of, it ends with that."""

    info: RecordingInfo
    items: list[StampedImage]
    truth: Trajectory | None = None
    damage: str = ""

    def images(self) -> Iterator[StampedImage]:
        yield from self.items
        if self.damage:
            raise RecordingError(self.damage)

    def ground_truth(self) -> Trajectory | None:
        return self.truth

    def stream(self, number: int) -> list[StampedImage]:
        return [image for image in self.items if image.stream == number]

    def mapped(self, change: Callable[[StampedImage, int], StampedImage | None]) -> Held:
        """Return the recording with each image changed; the number counts within its stream."""
        numbers = [0, 0]
        items = []
        for image in self.items:
            changed = change(image, numbers[image.stream])
            numbers[image.stream] += 1
            if changed is not None:
                items.append(changed)
        return replace(self, items=items)

    def with_pixels(self, change: Change, *, stream: int | None = None) -> Held:
        """Return the recording with the pixels of one stream (or both) changed."""

        def alter(image: StampedImage, _: int) -> StampedImage:
            if stream not in (None, image.stream):
                return image
            return replace(image, load=lambda: change(image.load()))

        return self.mapped(alter)

    def with_stamps(self, change: Callable[[int, int], int], *, stream: int | None = None) -> Held:
        """Return the recording with the stamps changed, given stamp and number."""

        def alter(image: StampedImage, number: int) -> StampedImage:
            if stream not in (None, image.stream):
                return image
            return replace(image, stamp_ns=change(image.stamp_ns, number))

        return self.mapped(alter)

    def cut(self, n_frames: int) -> Held:
        truth = None if self.truth is None else self.truth.select(slice(0, n_frames))
        info = replace(self.info, n_images=n_frames)
        return Held(info=info, items=self.items[: 2 * n_frames], truth=truth)


def held(
    sensor: Sensor,
    items: Sequence[Item],
    *,
    calibrations: tuple[Calibration, ...],
    truth: Trajectory | None = None,
) -> Held:
    """Return a recording of given images."""
    images = [
        StampedImage(stream=stream, stamp_ns=stamp_ns, load=partial(_give, pixels))
        for stream, stamp_ns, pixels in items
    ]
    n_images = sum(image.stream == 0 for image in images)
    info = RecordingInfo(name="list", sensor=sensor, calibrations=calibrations, n_images=n_images)
    return Held(info=info, items=images, truth=truth)


def _give(pixels: NDArray[Any] | Exception) -> NDArray[Any]:
    if isinstance(pixels, Exception):
        raise pixels
    return pixels


def frames_of(source: Source) -> list[Frame]:
    """Return all frames that are not faulty."""
    return [each for each in gvo.frames(source) if not isinstance(each, FaultyFrame)]


def hold(source: SyntheticRecording, *, every: int = 1) -> Held:
    """Return every so many frames of a recording, each image rendered once at most."""
    images = [replace(image, load=cache(image.load)) for image in source.images()]
    items = [image for index, image in enumerate(images) if index // 2 % every == 0]
    truth = source.ground_truth().select(slice(None, None, every))
    return Held(info=replace(source.info, n_images=len(truth)), items=items, truth=truth)
