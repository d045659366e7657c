"""What all forms in which a recording is written share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.config import SyncConfig
from gvo.errors import GvoError, RecordingError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.io.bag.source import BagSource
from gvo.io.calibration.camera_info import rectified_calibration
from gvo.io.frames import ImagePreparer, make_preparers
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

BODY_FRAME = "body"
"""Name in tf of what the calibration of a data set places its cameras on."""

_N_NAMED = 5
_Preparers: TypeAlias = tuple[ImagePreparer | None, ImagePreparer | None]


class LeftOut:
    """Collects what a conversion leaves out, and why."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._n_images: Counter[str] = Counter()

    def add(self, line: str) -> None:
        """Note one thing."""
        self._lines.append(line)

    def add_image(self, name: str, stamp_ns: int, reason: str) -> None:
        """Note an image of a stream; of many the first ones are named, and the rest counted."""
        self._n_images[name] += 1
        if self._n_images[name] <= _N_NAMED:
            self._lines.append(f"{name} at {stamp_ns} ns: {reason}")

    def lines(self) -> tuple[str, ...]:
        """Return a line for each."""
        rest = (
            f"{name}: {n_images - _N_NAMED} more images left out"
            for name, n_images in self._n_images.items()
            if n_images > _N_NAMED
        )
        return (*self._lines, *rest)


class Options(NamedTuple):
    """How a recording is written: rectified, images of bags as PNG, what a pair is."""

    rectify: bool
    compress: bool
    sync: SyncConfig


class Target(AbstractContextManager["Target"], ABC):
    """A new bag or folder: takes images one by one inside a `with` block, in the end `finish`.

    Attributes
    ----------
    path : Path
        The file or folder.
    n_images : list of two int
        Images written, by stream.
    n_poses : int
        True poses written, once it is finished.
    """

    def __init__(self, path: Path, source: Source, left_out: LeftOut, options: Options) -> None:
        self.path, self.left_out, self.info = path, left_out, source.info
        self.n_images, self.n_poses = [0, 0], 0
        self.names = tuple(f"{name} image" for name in self.info.stream_names)
        self.calibrations, self.preparers = plan_images(self.info, rectify=options.rectify)
        self.truth = _true_poses(source, left_out)

    def __exit__(self, *exception: object) -> None:
        """Close what is open."""

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Yield the images that the form can hold: those with a stamp of their own."""
        last_ns: list[int | None] = [None, None]
        for image in images:
            before_ns = last_ns[image.stream]
            if before_ns is not None and image.stamp_ns <= before_ns:
                reason = f"the stamp does not advance from {before_ns} ns"
                self.left_out.add_image(self.names[image.stream], image.stamp_ns, reason)
                continue
            last_ns[image.stream] = image.stamp_ns
            yield image

    def add(self, image: StampedImage) -> None:
        """Write an image; note where it cannot be read."""
        prepare = self.preparers[image.stream]
        try:
            pixels = image.load()
            pixels = pixels if prepare is None else prepare(pixels)
        except RecordingError as error:
            self.left_out.add_image(self.names[image.stream], image.stamp_ns, str(error))
            return
        self.write(image, pixels)
        self.n_images[image.stream] += 1

    @abstractmethod
    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write the pixels of an image."""

    @abstractmethod
    def finish(self) -> None:
        """Write what is known at the end: calibrations, tables, true poses."""


def readable_images(source: Source, left_out: LeftOut) -> Iterator[StampedImage]:
    """Yield the images up to where a recording cannot be read on; note why."""
    try:
        yield from source.images()
    except RecordingError as error:
        left_out.add(str(error))


def _true_poses(source: Source, left_out: LeftOut) -> Trajectory | None:
    """Return T_world_cam of the rectified first camera; None, with a note, if not poses."""
    try:
        truth = source.ground_truth()
    except GvoError as error:
        left_out.add(f"ground truth: {error}")
        return None
    if truth is not None and not truth.has_rotations:
        left_out.add(
            f"ground truth: {len(truth)} positions without rotations are no poses of the camera"
        )
        return None
    return truth


def plan_images(
    info: RecordingInfo, *, rectify: bool
) -> tuple[tuple[Calibration, ...], _Preparers]:
    """Return the calibrations of the images as written, and what makes them of those read.

    Depth of a camera of its own is moved to the rectified colour image.
    """
    is_raw = not info.calibrations[0].is_rectified
    is_moved = info.depth_view is not None
    is_rectifying = is_raw and (rectify or is_moved)
    first, second = make_preparers(info)
    preparers = first if is_rectifying else None, second if is_rectifying or is_moved else None
    if is_raw and not is_rectifying:
        return info.calibrations, preparers
    # without K and R of the raw camera: the same for all who read it
    ideal = (
        rectified_calibration(raw.P, width=raw.width, height=raw.height)
        for raw in info.calibrations
    )
    return tuple(ideal), preparers


def pose_of_right(info: RecordingInfo) -> FloatArray:
    """Return T_left_right of the rectified cameras of a stereo pair, shape (4, 4), metres."""
    left, right = info.calibrations
    baseline = float(left.P[0, 3] - right.P[0, 3]) / float(left.P[0, 0])
    return se3.make_transform(np.eye(3), np.array([baseline, 0.0, 0.0]))


def pose_on_body(source: Source) -> FloatArray | None:
    """Return T_body_cam of the rectified first camera, metres: of the calibration, or of tf."""
    info = source.info
    if info.T_body_cam is not None or not isinstance(source, BagSource) or not info.frame_id:
        return info.T_body_cam
    buffer = source.transforms((BODY_FRAME, info.frame_id))
    if BODY_FRAME not in buffer.frames or len(buffer.edge_stamps_ns(BODY_FRAME, info.frame_id)):
        return None
    found = buffer.lookup(BODY_FRAME, info.frame_id, 0)
    return None if isinstance(found, Failure) else found
