"""The steps of a frame from image to pose; a step that was not reached is None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from gvo._trace import Trace
from gvo.config import Config
from gvo.frontend.klt import image_of
from gvo.geometry.camera import StereoCamera
from gvo.types import BoolArray, FloatArray, Frame, FrameResult, ImageArray, IntArray

KEPT = "kept"


class Step(SimpleNamespace):
    """Values by name, as in `explanation.json`; `drawn` are those that only its picture needs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sorting:
    """Pixels that were kept, and those dropped with the first test that each failed.

    Arrays are empty where they do not apply.

    Parameters
    ----------
    tests : mapping of str to ndarray of bool, shape (n,)
        In order, True for pixels that pass.
    pixels : ndarray of float64, shape (n, 2)
        (u, v) in the left or colour image; matches: of the reference.
    partners : ndarray of float64, shape (n, 2)
        Pixels found, or the best candidates, in the other image; NaN = none.
    predicted : ndarray of float64, shape (n, 2)
        Where matches were expected; NaN = out of view.
    values : ndarray of float64, shape (n,)
        Disparities, pixels, or depths, metres; NaN = not measured.
    """

    tests: Mapping[str, BoolArray]
    pixels: FloatArray
    partners: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    predicted: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    values: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def names(self) -> tuple[str, ...]:
        """The tests in order, then `kept`."""
        return (*self.tests, KEPT)

    @property
    def codes(self) -> IntArray:
        """Indices into the names: of the first test that a pixel fails, shape (n,)."""
        passed = np.array([*self.tests.values(), np.zeros(len(self), dtype=np.bool_)])
        return np.asarray(np.argmin(passed, axis=0))

    def __len__(self) -> int:
        """Return the number of pixels."""
        return len(self.pixels)

    def are(self, name: str) -> BoolArray:
        """Tell which pixels have a name, shape (n,)."""
        return np.asarray(self.codes == self.names.index(name))

    @property
    def are_kept(self) -> BoolArray:
        """Tell which pixels were kept, shape (n,)."""
        return self.are(KEPT)

    def counts(self) -> dict[str, int]:
        """Count pixels by name, in the order of the tests."""
        numbers = np.bincount(self.codes, minlength=len(self.names)).tolist()
        return dict(zip(self.names, numbers, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameExplanation:
    """One frame from image to pose.

    Parameters
    ----------
    recording : str
    index : int
        Of the frame.
    config : Config
    camera : StereoCamera
        Of RGB-D with the virtual baseline.
    frame, reference : StereoFrame or RgbdFrame
        The frame, and the one it was registered against.
    reference_index : int or None
    result : FrameResult
    offset_px, row_offset_px : float
        Learnt of the rig before: subtracted from disparities, added to rows of the right image.
    readout_ms : float
        Time from the first to the last row that was assumed.
    row_motion_px : float or None
        By how much matches were moved at most for it; None where nothing was registered.
    keypoints : Sorting
    measured : Sorting
        Keypoints with their disparities, or depths of an RGB-D frame.
    depth_pixels : Sorting or None
        All pixels of the depth image, row by row; None for stereo.
    subpixel : Step or None
        How the disparity of one match was found.
    matches : Sorting or None
        Points of the reference; this and what follows are of the last attempt to register.
    consensus, refinement : Step or None
        Which matches agree, what the samples of RANSAC found; residuals before and after.
    attempt : Trace
        Its events; empty if there was none.
    attempts : tuple of str
        All of them, one a line.
    links : tuple of Step
        What earlier frames contributed: predecessor first, then the keyframes, oldest first.
    """

    recording: str
    index: int
    config: Config
    camera: StereoCamera
    frame: Frame
    reference: Frame | None
    reference_index: int | None
    result: FrameResult
    offset_px: float
    row_offset_px: float
    readout_ms: float
    row_motion_px: float | None
    keypoints: Sorting
    measured: Sorting
    depth_pixels: Sorting | None
    subpixel: Step | None
    matches: Sorting | None
    consensus: Step | None
    refinement: Step | None
    attempt: Trace
    attempts: tuple[str, ...]
    links: tuple[Step, ...]

    @property
    def image(self) -> ImageArray:
        """The left or colour image."""
        return image_of(self.frame)

    @property
    def became_keyframe(self) -> bool:
        """The frame was kept as a keyframe."""
        return self.result.stamp_ns in self.result.keyframes_ns
