"""The steps of a frame from image to pose; a step that was not reached is None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo._trace import Trace
from gvo.config import Config
from gvo.frontend.klt import image_of
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

KEPT = "kept"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sorting:
    """Pixels that were kept, and those dropped with the first test that each failed.

    Parameters
    ----------
    names : tuple of str
        The tests in order, then `kept`.
    codes : ndarray of int64, shape (n,)
        Index into the names.
    pixels : ndarray of float64, shape (n, 2)
        (u, v) in the left or colour image; matches: of the reference.
    partners : ndarray of float64, shape (n, 2)
        Pixels found, or the best candidates, in the other image; NaN = none.
    predicted : ndarray of float64, shape (n, 2)
        Where matches were expected; NaN = out of view.
    values : ndarray of float64, shape (n,)
        Disparities, pixels, or depths, metres; NaN = not measured.
    """

    names: tuple[str, ...]
    codes: IntArray
    pixels: FloatArray
    partners: FloatArray
    predicted: FloatArray
    values: FloatArray

    @classmethod
    def by(
        cls,
        tests: Mapping[str, BoolArray],
        pixels: FloatArray,
        *,
        partners: FloatArray | None = None,
        predicted: FloatArray | None = None,
        values: FloatArray | None = None,
    ) -> Sorting:
        """Sort pixels by the first test that fails; a test is True for those that pass."""
        codes = np.full(len(pixels), len(tests), dtype=np.int64)
        for code, passes in reversed(list(enumerate(tests.values()))):
            codes[~passes] = code
        nowhere = np.full((len(pixels), 2), np.nan)
        return cls(
            names=(*tests, KEPT),
            codes=codes,
            pixels=pixels,
            partners=nowhere if partners is None else partners,
            predicted=nowhere if predicted is None else predicted,
            values=nowhere[:, 0] if values is None else values,
        )

    def __len__(self) -> int:
        """Return the number of pixels."""
        return len(self.codes)

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
class SubpixelStep:
    """The sub-pixel disparity of one keypoint.

    Parameters
    ----------
    pixel : ndarray of float64, shape (2,)
        In the left image.
    left, right : ndarray of float32, shape (s, s)
        Patches at the pixel and at its disparity.
    columns_px, ssd : ndarray of float64, shape (m,)
        Disparities, and the sums of squared differences of the patches there, means removed.
    iterates_px : ndarray of float64, shape (k,)
        Disparities at the start and after each step.
    disparity_px : float
        The result.
    method : {"gauss-newton", "parabola", "none"}
    """

    pixel: FloatArray
    left: NDArray[np.float32]
    right: NDArray[np.float32]
    columns_px: FloatArray
    ssd: FloatArray
    iterates_px: FloatArray
    disparity_px: float
    method: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConsensusStep:
    """The matches that agree on a motion, and the samples of RANSAC.

    Parameters
    ----------
    pixels_reference, pixels_current : ndarray of float64, shape (n, 2)
        The matches.
    inliers : ndarray of bool, shape (n,), or None
        None where no motion was found.
    n_agreeing_with_prediction : int or None
        None without a prediction.
    n_needed : float
        From how many on no samples are drawn.
    is_known : bool
        As many agreed; the samples are those that RANSAC would have drawn.
    n_planned, n_near : int
        Samples at most, and points with enough disparity, from which they are drawn.
    counts : ndarray of int64, shape (k,)
        Inliers of each sample drawn; -1 for three points on a line.
    share_of_near : float
        Inliers of the best sample among the near points.
    sampled : ndarray of bool, shape (n,), or None
        Inliers of the motion refitted to the best sample; None if too few agree.
    reason : str
        Why too few agree.
    """

    pixels_reference: FloatArray
    pixels_current: FloatArray
    inliers: BoolArray | None
    n_agreeing_with_prediction: int | None
    n_needed: float
    is_known: bool
    n_planned: int
    n_near: int
    counts: IntArray
    share_of_near: float
    sampled: BoolArray | None
    reason: str

    @property
    def is_stopped_early(self) -> bool:
        """Fewer samples were drawn than planned."""
        return len(self.counts) < self.n_planned


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinementStep:
    """The pose before and after the refinement: first and second row of each array.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (2, 4, 4)
    residuals_px, whitened : ndarray of float64, shape (2, n, 3)
        (u, v, disparity) measured less predicted, in pixels and in sigmas.
    inliers : ndarray of bool, shape (2, n)
    depths : ndarray of float64, shape (n,)
        Of the matches in the current frame, metres.
    n_within_gate : int or None
        After the first steps; None without a gate.
    n_steps : int
        Of Gauss-Newton.
    gate_sigma : float
    scale : float
        Root mean square of the whitened residuals of the inliers, weighted.
    """

    T_target_source: FloatArray
    residuals_px: FloatArray
    whitened: FloatArray
    inliers: BoolArray
    depths: FloatArray
    n_within_gate: int | None
    n_steps: int
    gate_sigma: float
    scale: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeLink:
    """What an earlier frame contributed.

    Parameters
    ----------
    reference_ns, index : int
        Stamp and number of the earlier frame.
    kind : {"step", "keyframe", "standstill", "not linked"}
    image : ndarray of uint8, shape (height, width)
    overlap : float or None
        Share of a keyframe's points in view, 0 to 1.
    registration : RelativePose, Failure or None
        Of the current frame against it; None where that was not tried.
    chi2 : float or None
        Of the edge, against the poses of the window, 6 degrees of freedom.
    is_accepted : bool
    reason : str
        Why there is no edge, or why it was refused.
    """

    reference_ns: int
    index: int
    kind: str
    image: ImageArray
    overlap: float | None
    registration: RelativePose | Failure | None
    chi2: float | None
    is_accepted: bool
    reason: str


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
    keypoints : Sorting
    measured : Sorting
        Keypoints with their disparities, or depths of an RGB-D frame.
    depth_pixels : Sorting or None
        All pixels of the depth image, row by row; None for stereo.
    subpixel, matches, consensus, refinement
        Steps of the last attempt to register the frame; matches are points of the reference.
    attempt : Trace
        Its events; empty if there was none.
    attempts : tuple of str
        All of them, one a line.
    links : tuple of KeyframeLink
        Predecessor first, then the keyframes, oldest first.
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
    keypoints: Sorting
    measured: Sorting
    depth_pixels: Sorting | None
    subpixel: SubpixelStep | None
    matches: Sorting | None
    consensus: ConsensusStep | None
    refinement: RefinementStep | None
    attempt: Trace
    attempts: tuple[str, ...]
    links: tuple[KeyframeLink, ...]

    @property
    def image(self) -> ImageArray:
        """The left or colour image."""
        return image_of(self.frame)

    @property
    def became_keyframe(self) -> bool:
        """The frame was kept as a keyframe."""
        return self.result.stamp_ns in self.result.keyframes_ns
