"""What of a recording is written, whatever the form."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.config import SyncConfig
from gvo.errors import GvoError, RecordingError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.geometry.imu import ImuSamples
from gvo.io.bag.source import BagSource
from gvo.io.edges.events import InputFaults
from gvo.io.frames import ImagePreparer, make_preparers
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

BODY_FRAME = "body"
"""Name in tf of what the calibration of a data set places its cameras on."""

_Preparers: TypeAlias = tuple[ImagePreparer | None, ImagePreparer | None]


class Form(AbstractContextManager["Form"], ABC):
    """A new bag or folder: takes images one by one inside a `with` block, in the end `finish`.

    Attributes
    ----------
    path : Path
        The file or folder.
    n_poses : int
        True poses written, once it is finished.
    calibrations : tuple of Calibration
        Of the images as they are written.
    truth : Trajectory or None
        T_world_cam of the rectified first camera.
    names : tuple of two str
        Of the streams, for messages.
    notes : list of str
        What is left out and why, a line each, besides images.
    """

    holds_imu = True

    def __init__(
        self, path: Path, source: Source, *, rectify: bool, compress: bool, sync: SyncConfig
    ) -> None:
        self.path, self.source, self.info, self.sync = path, source, source.info, sync
        self.rectify, self.compress = rectify, compress
        self.names = tuple(f"{name} images" for name in self.info.stream_names)
        self.n_poses = 0
        self.notes: list[str] = []
        self._faults = InputFaults()
        self.calibrations, self._preparers = plan_images(self.info, rectify=rectify)
        self.truth = self._true_poses()
        if self.info.imu is not None and not self.holds_imu:
            self.notes.append(f"IMU: {self.info.imu.name} is left out, such a folder holds none")

    @property
    def skipped(self) -> tuple[str, ...]:
        """All that is left out, a line each; images are counted."""
        return (*self.notes, *self._faults.warnings())

    def recorded(self) -> Iterator[StampedImage]:
        """Yield the images up to where the recording cannot be read on; note why."""
        try:
            yield from self.source.images()
        except RecordingError as error:
            self.notes.append(str(error))

    def imu_samples(self) -> Iterator[ImuSamples]:
        """Yield the samples of the IMU up to where they cannot be read on; note why."""
        try:
            yield from () if self.info.imu is None else self.info.imu.samples(0)
        except RecordingError as error:
            self.notes.append(str(error))

    def pixels(self, image: StampedImage) -> NDArray[Any] | None:
        """Return the pixels of an image as they are written; None, noted, if it is damaged."""
        prepare = self._preparers[image.stream]
        try:
            pixels = image.load()
            return pixels if prepare is None else prepare(pixels)
        except RecordingError as error:
            self.leave_out(image.stream, image.stamp_ns, str(error))
            return None

    def leave_out(self, stream: int, stamp_ns: int, reason: str) -> None:
        """Note an image that is not written."""
        self._faults.add(f"{self.names[stream]} were left out", f"at {stamp_ns} ns: {reason}")

    def _true_poses(self) -> Trajectory | None:
        try:
            truth = self.source.ground_truth()
        except GvoError as error:
            self.notes.append(f"ground truth: {error}")
            return None
        if truth is None or truth.has_rotations:
            return truth
        self.notes.append(
            f"ground truth: {len(truth)} positions without rotations are no poses of the camera"
        )
        return None

    def __exit__(self, *exception: object) -> None:
        """Close what is open."""

    def images(self) -> Iterator[StampedImage]:
        """Yield the images that the form can hold: those with a stamp of their own."""
        last_ns: list[int | None] = [None, None]
        for image in self.recorded():
            before_ns = last_ns[image.stream]
            if before_ns is not None and image.stamp_ns <= before_ns:
                reason = f"the stamp does not advance from {before_ns} ns"
                self.leave_out(image.stream, image.stamp_ns, reason)
                continue
            last_ns[image.stream] = image.stamp_ns
            yield image

    @abstractmethod
    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write the pixels of an image."""

    @abstractmethod
    def finish(self) -> None:
        """Write what is known at the end: calibrations, tables, true poses."""


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
    no_lens: dict[str, Any] = {"D": np.zeros(5), "R": np.eye(3), "model": "plumb_bob"}
    ideal = [
        replace(raw, K=raw.P[:, :3], is_rectified=True, **no_lens) for raw in info.calibrations
    ]
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
