"""The steps of a frame from image to pose; a step that was not reached is None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gvo.config import Config
from gvo.frontend.klt import image_of
from gvo.frontend.offsets import RigOffsets
from gvo.geometry.camera import StereoCamera
from gvo.types import (
    BoolArray,
    Failure,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    IntArray,
    RelativePose,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sorting:
    """Pixels that were kept, and those dropped with the first test that each failed.

    Parameters
    ----------
    tests : mapping of str to ndarray of bool, shape (n,)
        In order, True for pixels that pass.
    pixels : ndarray of float64, shape (n, 2)
        (u, v) in the left or colour image; of matches, in that of the reference.
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
    def codes(self) -> IntArray:
        """Index of the first test that a pixel fails, their number for those kept, shape (n,)."""
        passed = np.array([*self.tests.values(), np.zeros(len(self.pixels), dtype=np.bool_)])
        return np.asarray(np.argmin(passed, axis=0))

    @property
    def are_kept(self) -> BoolArray:
        """Tell which pixels were kept, shape (n,)."""
        return np.asarray(self.codes == len(self.tests))

    def counts(self) -> dict[str, int]:
        """Count the pixels that fail each test first, and those kept."""
        numbers = np.bincount(self.codes, minlength=len(self.tests) + 1).tolist()
        return dict(zip((*self.tests, "kept"), numbers, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corner:
    """One corner: its patch in two images, and the correlation along the row of the second.

    The second image is the right one of a stereo pair, or the current one of an RGB-D camera,
    whose reference is the first.

    Parameters
    ----------
    pixel, partner : ndarray of float64, shape (2,)
        (u, v) in the first and in the second image.
    patches : ndarray of float64, shape (2, size, size)
    columns : ndarray of float64, shape (n,)
        Disparities of a stereo pair; columns less that of the partner for RGB-D.
    correlations : ndarray of float64, shape (n,)
        Of the first patch with those of the second image there, -1 to 1.
    end : float
        Where among the columns the search ended.
    """

    pixel: FloatArray
    partner: FloatArray
    patches: FloatArray
    columns: FloatArray
    correlations: FloatArray
    end: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The last attempt to register the frame with its reference, from matches to motion.

    Parameters
    ----------
    attempts : tuple of str
        All attempts, one a line.
    matches : Sorting
        The points of the reference.
    radius_px : float
        Half size of the windows tracked, or the radius in which descriptors are compared.
    is_predicted : bool
        The search began where a predicted motion shows the points.
    n_consensus : int
        How many matches the refinement began with; 0 where too few agreed.
    is_known : bool
        Most matches agreed with the prediction, so that RANSAC was left out.
    inliers : ndarray of bool, shape (m,)
        Of the matches kept.
    residuals_px, whitened : ndarray of float64, shape (2, m, 3), or None
        (u, v, disparity) measured less predicted, before and after the refinement, in pixels and
        in sigmas; NaN behind the camera. None where nothing was registered.
    row_motion_px : float
        By how much matches were moved at most to the middle of the exposure.
    """

    attempts: tuple[str, ...]
    matches: Sorting
    radius_px: float
    is_predicted: bool
    n_consensus: int = 0
    is_known: bool = False
    inliers: BoolArray
    residuals_px: FloatArray | None = None
    whitened: FloatArray | None = None
    row_motion_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Link:
    """What an earlier frame, of number `frame`, contributed.

    `kind` is that of its edge, "keyframe" or "not linked" where there is none, `reason` why;
    `overlap` is the share of its points that the frame shows.
    """

    frame: int
    stamp_ns: int
    image: ImageArray
    kind: str
    overlap: float
    chi2: float | None
    is_accepted: bool
    reason: str
    registration: RelativePose | Failure | None


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
        The frame, and the one it was registered with.
    reference_index : int or None
    result : FrameResult
        As of `gvo run`, to the last bit.
    offsets : RigOffsets
        What was learnt of the rig before.
    measured : Sorting
        Keypoints with their disparities, or depths of an RGB-D frame.
    corner : Corner or None
        One of those kept; None for descriptors.
    registration : Registration or None
    links : tuple of Link
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
    offsets: RigOffsets
    measured: Sorting
    corner: Corner | None
    registration: Registration | None
    links: tuple[Link, ...]

    @property
    def image(self) -> ImageArray:
        """The left or colour image."""
        return image_of(self.frame)

    @property
    def is_klt(self) -> bool:
        """Whether corners are tracked; else descriptors are compared."""
        return self.config.frontend.kind == "klt"

    @property
    def became_keyframe(self) -> bool:
        """The frame was kept as a keyframe."""
        return self.result.stamp_ns in self.result.keyframes_ns
