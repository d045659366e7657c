"""What conversions of recordings share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
_Calibrations: TypeAlias = tuple[Calibration, ...]
_Preparers: TypeAlias = tuple[ImagePreparer | None, ImagePreparer | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion wrote.

    Parameters
    ----------
    path : Path
        The new bag or folder.
    n_images : int
        Images written, of both streams.
    n_poses : int
        Poses of the ground truth written.
    skipped : tuple of str
        What was left out and why, a line each: an image, the ground truth, the rest of a
        recording that cannot be read on.
    """

    path: Path
    n_images: int
    n_poses: int
    skipped: tuple[str, ...]


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


def check_new(path: Path) -> None:
    """Refuse a target that exists, or whose folder does not.

    Raises
    ------
    RecordingError
        With what to do.
    """
    if path.exists():
        raise RecordingError(f"{path}: exists already; give another path or remove it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: cannot be written: {path.parent} is no folder")


def check_images(n_images: tuple[int, int], source: Source, left_out: LeftOut) -> None:
    """Check that there are images of both streams, as every reader needs.

    Raises
    ------
    RecordingError
        When no image of a stream was written.
    """
    if not all(n_images):
        name = source.info.stream_names[0 if n_images[0] == 0 else 1]
        reason = "; ".join(left_out.lines()[:1]) or "the recording holds none"
        raise RecordingError(f"{source.info.name}: no {name} image can be written: {reason}")


def readable_images(source: Source, left_out: LeftOut) -> Iterator[StampedImage]:
    """Yield the images up to where a recording cannot be read on; note why."""
    try:
        yield from source.images()
    except RecordingError as error:
        left_out.add(str(error))


def true_poses(source: Source, left_out: LeftOut) -> Trajectory | None:
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


def plan_images(info: RecordingInfo, *, rectify: bool) -> tuple[_Calibrations, _Preparers]:
    """Decide how the images of a recording are written.

    Parameters
    ----------
    info : RecordingInfo
        Depth of a camera of its own is moved to the rectified colour image.
    rectify : bool
        Write raw images rectified and grey.

    Returns
    -------
    calibrations : tuple of Calibration
        Of the images that are written.
    preparers : tuple of two ImagePreparer, or None where the images stay as they are
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


def load_image(
    image: StampedImage, prepare: ImagePreparer | None, name: str, left_out: LeftOut
) -> NDArray[Any] | None:
    """Return the pixels to write; None, with a note, where they cannot be read."""
    try:
        pixels = image.load()
        return pixels if prepare is None else prepare(pixels)
    except RecordingError as error:
        left_out.add_image(name, image.stamp_ns, str(error))
        return None


def pose_of_right(info: RecordingInfo) -> FloatArray:
    """Return T_left_right of the rectified cameras of a stereo pair, shape (4, 4), metres."""
    left, right = info.calibrations
    baseline = float(left.P[0, 3] - right.P[0, 3]) / float(left.P[0, 0])
    return se3.make_transform(np.eye(3), np.array([baseline, 0.0, 0.0]))


def pose_on_body(source: Source) -> FloatArray | None:
    """Return where the camera sits on the body of its calibration.

    Parameters
    ----------
    source : Source
        Whose `T_body_cam` counts; of a bag also what tf calls `body`.

    Returns
    -------
    ndarray of float64, shape (4, 4), or None
        T_body_cam of the rectified left or colour camera, metres.
    """
    info = source.info
    if info.T_body_cam is not None or not isinstance(source, BagSource) or not info.frame_id:
        return info.T_body_cam
    buffer = source.transforms((BODY_FRAME, info.frame_id))
    if BODY_FRAME not in buffer.frames or len(buffer.edge_stamps_ns(BODY_FRAME, info.frame_id)):
        return None
    found = buffer.lookup(BODY_FRAME, info.frame_id, 0)
    return None if isinstance(found, Failure) else found
