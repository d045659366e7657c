"""What the front-end of tracks keeps of a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gvo.types import FloatArray, Frame, ImageArray, StereoFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltCorners:
    """The corners of a frame that are measured in 3-D.

    Parameters
    ----------
    keypoints : ndarray of float64, shape (n, 2)
        Pixels (u, v) in the left or colour image.
    disparities : ndarray of float64, shape (n,)
        Disparity in pixels, as measured; for RGB-D the virtual one, fx * baseline / depth.
    points_cam : ndarray of float64, shape (n, 3)
        Points in the `cam` frame, metres, by what was known of the disparities' offset then.
    n_keypoints : int
        Corners detected, measured or not.
    row_shift_px : float or None
        By how much the rows of left and right still differ; None where that is not known.
    """

    keypoints: FloatArray
    disparities: FloatArray
    points_cam: FloatArray
    n_keypoints: int
    row_shift_px: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltObservations:
    """A frame that others' corners are followed into, and its own corners.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    find_corners : callable
        Returns its KltCorners. They may still be looked for on another thread: only when the
        next frame comes are they needed.
    """

    frame: Frame
    find_corners: Callable[[], KltCorners]

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.frame.stamp_ns

    @property
    def image(self) -> ImageArray:
        """The image that is tracked in, left or colour."""
        return image_of(self.frame)

    @property
    def keypoints(self) -> FloatArray:
        """Pixels (u, v) of the corners, shape (n, 2)."""
        return self.find_corners().keypoints

    @property
    def disparities(self) -> FloatArray:
        """Disparities of the corners as measured, shape (n,)."""
        return self.find_corners().disparities

    @property
    def points_cam(self) -> FloatArray:
        """The corners as points in the `cam` frame, metres, shape (n, 3)."""
        return self.find_corners().points_cam

    @property
    def n_keypoints(self) -> int:
        """Corners detected, measured or not."""
        return self.find_corners().n_keypoints

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.keypoints)


def image_of(frame: Frame) -> ImageArray:
    """Return the image that is tracked in, left or colour."""
    return frame.left if isinstance(frame, StereoFrame) else frame.image
