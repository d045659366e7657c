"""What conversions of recordings share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvo.errors import GvoError, RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.bag.source import BagSource
from gvo.io.frames import ImagePreparer, make_preparers
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

BODY_FRAME = "body"
"""Name in tf of what the calibration of a data set places its cameras on."""

_N_NAMED = 5


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
    """What a conversion leaves out, in as few lines as tell it."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._n_images: Counter[str] = Counter()

    def add(self, line: str) -> None:
        """Note one thing."""
        self._lines.append(line)

    def add_image(self, name: str, stamp_ns: int, reason: str) -> None:
        """Note an image of a stream; of many the first ones are named, and the rest counted.

        Parameters
        ----------
        name : str
            Of the stream.
        stamp_ns : int
            Nanoseconds.
        reason : str
            One line.
        """
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

    Parameters
    ----------
    path : Path
        To be made.

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
    """Refuse what no recording can be read from again.

    Parameters
    ----------
    n_images : tuple of two int
        Written of each stream.
    source : Source
        The recording.
    left_out : LeftOut
        Why the others were not.

    Raises
    ------
    RecordingError
        When a stream has no image.
    """
    if not all(n_images):
        name = source.info.stream_names[0 if n_images[0] == 0 else 1]
        reason = "; ".join(left_out.lines()[:1]) or "the recording holds none"
        raise RecordingError(f"{source.info.name}: no {name} image can be written: {reason}")


def readable_images(source: Source, left_out: LeftOut) -> Iterator[StampedImage]:
    """Yield the images up to where a recording cannot be read on, which is noted.

    Parameters
    ----------
    source : Source
        The recording.
    left_out : LeftOut
        Gets the reason.
    """
    try:
        yield from source.images()
    except RecordingError as error:
        left_out.add(str(error))


def true_poses(source: Source, left_out: LeftOut) -> Trajectory | None:
    """Return the ground truth of a recording if it can be written as poses.

    Parameters
    ----------
    source : Source
        The recording.
    left_out : LeftOut
        Gets the reason where it cannot.

    Returns
    -------
    Trajectory or None
        T_world_cam of the rectified left or colour camera.
    """
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


def ideal_calibration(calibration: Calibration) -> Calibration:
    """Return the calibration of the rectified images of a camera, the same for all who read it.

    Parameters
    ----------
    calibration : Calibration
        Of raw images, or of rectified ones with K and R of the raw camera beside.
    """
    return Calibration(
        width=calibration.width,
        height=calibration.height,
        K=calibration.P[:, :3].copy(),
        D=np.zeros(5),
        R=np.eye(3),
        P=calibration.P,
        is_rectified=True,
    )


def choose_preparers(
    info: RecordingInfo, *, is_rectifying: bool
) -> tuple[ImagePreparer | None, ImagePreparer | None]:
    """Return what makes the images of each stream those that are written.

    Parameters
    ----------
    info : RecordingInfo
        Of the recording.
    is_rectifying : bool
        They are to be rectified and grey.

    Returns
    -------
    tuple of two ImagePreparer, or None where the images stay as they are
        Depth of a camera of its own is moved to colour, even to colour that stays.
    """
    first, second = make_preparers(info)
    is_moving = info.depth_view is not None
    return (
        first if is_rectifying else None,
        second if is_rectifying or is_moving else None,
    )


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
    if BODY_FRAME not in buffer.frames or not buffer.is_static(BODY_FRAME, info.frame_id):
        return None
    found = buffer.lookup(BODY_FRAME, info.frame_id, 0)
    return None if isinstance(found, Failure) else found
