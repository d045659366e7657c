"""What the layouts of data-set folders share: which images are written, and how prepared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.outputs.conversion import LeftOut, choose_preparers
from gvo.sources.recording import Source, StampedImage
from gvo.trajectory.trajectory import Trajectory


class FolderStreams(ABC):
    """Writes the two streams of a recording in one layout.

    Parameters
    ----------
    source : Source
        The recording.
    left_out : LeftOut
        Gets what cannot be written.
    rectify : bool
        Write raw images rectified and grey.
    """

    def __init__(self, source: Source, left_out: LeftOut, *, rectify: bool) -> None:
        self.info = source.info
        self.left_out = left_out
        self.is_rectifying = rectify and not self.info.calibrations[0].is_rectified
        self._prepare = choose_preparers(self.info, is_rectifying=self.is_rectifying)

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Yield what the layout can hold: images with a stamp of their own."""
        last_ns: list[int | None] = [None, None]
        for image in images:
            before_ns = last_ns[image.stream]
            if before_ns is not None and image.stamp_ns <= before_ns:
                self.leave_out(image, f"the stamp does not advance from {before_ns} ns")
                continue
            last_ns[image.stream] = image.stamp_ns
            yield image

    @abstractmethod
    def add(self, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read."""

    @abstractmethod
    def add_truth(self, truth: Trajectory) -> int:
        """Write T_world_cam of the rectified camera, and return the number of poses."""

    @abstractmethod
    def close(self) -> None:
        """Write what is known at the end."""

    def load(self, image: StampedImage) -> NDArray[Any] | None:
        """Return the pixels to write; None, with a note, where they cannot be read."""
        prepare = self._prepare[image.stream]
        try:
            pixels = image.load()
            return pixels if prepare is None else prepare(pixels)
        except RecordingError as error:
            self.leave_out(image, str(error))
            return None

    def leave_out(self, image: StampedImage, reason: str) -> None:
        """Note an image that is not written."""
        self.left_out.add_image(
            f"{self.info.stream_names[image.stream]} image", image.stamp_ns, reason
        )
