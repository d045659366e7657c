"""What is written down of a frame, and what a page shows of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo.types import FloatArray, FrameLink, FrameResult, ImageArray, Status
from gvo.view.clouds import Cloud


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """All that a page shows of one frame.

    Parameters
    ----------
    index : int
        Of the frame in the recording, from 0; faulty ones count.
    n_done : int
        Frames that are done: the index of the last one, and 1.
    stamp_ns : int
        Of the frame, nanoseconds.
    result : FrameResult or None
        None for a faulty frame; without `registration`, whose pictures and points are here.
    reason : str
        Why there is no pose, or no registration; empty where there are.
    image, overlay : ndarray of uint8, shape (height, width, 3)
        The current image, small, and with what was matched in it, BGR.
    cloud_cam : ndarray of float32, shape (n, 3)
        What the frame measured, in the `cam` frame, metres.
    colours : ndarray of uint8, shape (n, 3)
        Of these points, RGB.
    T_world_cam : ndarray of float64, shape (4, 4)
        Causal pose; for a faulty frame that of the frame before, the identity before any.
    window_poses : dict of int to ndarray of float64, shape (4, 4)
        T_world_cam of the poses in the window by their stamps; of a window that keeps all, the
        newest ones and the keyframes.
    window_covariances : dict of int to ndarray of float64, shape (6, 6)
        Of the same, in the poses' own frames.
    fault : str
        What the player has to tell; empty while all is well.
    """

    index: int
    n_done: int
    stamp_ns: int
    result: FrameResult | None
    reason: str
    image: ImageArray
    overlay: ImageArray
    cloud_cam: NDArray[np.float32]
    colours: NDArray[np.uint8]
    T_world_cam: FloatArray
    window_poses: dict[int, FloatArray]
    window_covariances: dict[int, FloatArray]
    fault: str = ""

    @property
    def status(self) -> Status | None:
        """What ties the frame to earlier ones; None for a faulty frame."""
        return None if self.result is None else self.result.status

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Stamps of the kept frames, oldest first."""
        return () if self.result is None else self.result.keyframes_ns

    @property
    def links(self) -> tuple[FrameLink, ...]:
        """The edges that were offered to the window with the frame."""
        return () if self.result is None else self.result.links


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entry:
    """What is written down of a frame.

    Parameters
    ----------
    stamp_ns, result, reason, image, overlay, window_poses, window_covariances
        As of `Moment`.
    cloud : tuple of points and colours
        In the `cam` frame.
    """

    stamp_ns: int
    result: FrameResult | None
    reason: str
    image: ImageArray
    overlay: ImageArray
    cloud: Cloud
    window_poses: dict[int, FloatArray]
    window_covariances: dict[int, FloatArray]
