"""What is told of a frame, step by step; a step that was not reached is None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import (
    BoolArray,
    DepthArray,
    Failure,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    IntArray,
    RelativePose,
    StereoFrame,
)

KEPT = "kept"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sorting:
    """Why each of n things was kept or dropped; each has one reason.

    Parameters
    ----------
    names : tuple of str
        The reasons in the order of the tests; the last one is `kept`.
    codes : ndarray of int64, shape (n,)
        Index into the names.
    """

    names: tuple[str, ...]
    codes: IntArray

    @classmethod
    def by(cls, tests: Mapping[str, BoolArray], n: int) -> Sorting:
        """Sort by the first test that fails; each tells with True what passes it."""
        codes = np.full(n, len(tests), dtype=np.int64)
        for code, passes in reversed(list(enumerate(tests.values()))):
            codes[~passes] = code
        return cls(names=(*tests, KEPT), codes=codes)

    def __len__(self) -> int:
        """Return the number of things."""
        return len(self.codes)

    def are(self, name: str) -> BoolArray:
        """Tell which have a reason, shape (n,)."""
        return np.asarray(self.codes == self.names.index(name))

    @property
    def are_kept(self) -> BoolArray:
        """Tell which were kept, shape (n,)."""
        return self.are(KEPT)

    def counts(self) -> dict[str, int]:
        """Return how many have each reason, in the order of the tests."""
        numbers = np.bincount(self.codes, minlength=len(self.names))
        return {name: int(number) for name, number in zip(self.names, numbers, strict=True)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeypointStep:
    """Keypoints of the left or colour image.

    Parameters
    ----------
    detected, kept : ndarray of float64, shape (n, 2), (m, 2)
        Pixels (u, v): all that were found, and those within the budget.
    cell_size_px : int
        Of the grid whose cells share the budget.
    budget : int
    """

    detected: FloatArray
    kept: FloatArray
    cell_size_px: int
    budget: int

    def per_cell(self, pixels: FloatArray, shape: tuple[int, ...]) -> IntArray:
        """Count pixels by cell, shape (rows, columns) of an image of (height, width)."""
        rows, columns = (-(-size // self.cell_size_px) for size in shape)
        cells = (pixels[:, ::-1] // self.cell_size_px).astype(np.int64)
        counts = np.zeros((rows, columns), dtype=np.int64)
        np.add.at(counts, tuple(cells.T), 1)
        return counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoStep:
    """Keypoints of the left image and their partners in the right one.

    Parameters
    ----------
    pixels : ndarray of float64, shape (n, 2)
        Keypoints in the left image.
    partners : ndarray of float64, shape (n, 2)
        Where they are in the right image, or where the best candidate is; NaN where none is.
    disparities : ndarray of float64, shape (n,)
        As measured, pixels; NaN where it did not come to that.
    sorting : Sorting
    min_disparity_px, max_disparity_px : float
        Those of the depth limits.
    """

    pixels: FloatArray
    partners: FloatArray
    disparities: FloatArray
    sorting: Sorting
    min_disparity_px: float
    max_disparity_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthStep:
    """Keypoints of the colour image and the depth there.

    Parameters
    ----------
    pixels : ndarray of float64, shape (n, 2)
    depths : ndarray of float64, shape (n,)
        Metres, NaN = unknown.
    sorting : Sorting
        Of the keypoints.
    depth : ndarray of float32, shape (height, width)
        The image.
    pixel_sorting : Sorting
        Of all pixels of the image, row by row, by the same test.
    """

    pixels: FloatArray
    depths: FloatArray
    sorting: Sorting
    depth: DepthArray
    pixel_sorting: Sorting


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SubpixelStep:
    """How the disparity of one keypoint was found to a fraction of a pixel.

    Parameters
    ----------
    pixel : ndarray of float64, shape (2,)
        In the left image.
    left, right : ndarray of float32, shape (s, s)
        The patches at the pixel and where its disparity leads.
    columns : ndarray of float64, shape (m,)
        Disparities of whole columns, pixels.
    ssd : ndarray of float64, shape (m,)
        Squared differences of the patches there, less those of their means.
    iterates : ndarray of float64, shape (k,)
        Disparities on the way: the start, and after each step.
    disparity : float
        Where it ended.
    method : {"gauss-newton", "parabola", "none"}
    """

    pixel: FloatArray
    left: NDArray[np.float32]
    right: NDArray[np.float32]
    columns: FloatArray
    ssd: FloatArray
    iterates: FloatArray
    disparity: float
    method: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemporalStep:
    """Points of the reference looked for in the current image.

    Parameters
    ----------
    method : {"tracks", "descriptors"}
    is_wide : bool
        Whether the wider search was used.
    has_prior : bool
        Whether a motion was predicted.
    radius_px : float
        Of the search around the predicted pixel (descriptors); half size of the window (tracks).
    reference_pixels, predicted, found : ndarray of float64, shape (n, 2)
        In the reference image; where they are expected in the current one and where they were
        found, NaN where not.
    sorting : Sorting
    """

    method: str
    is_wide: bool
    has_prior: bool
    radius_px: float
    reference_pixels: FloatArray
    predicted: FloatArray
    found: FloatArray
    sorting: Sorting


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleSearch:
    """The samples of RANSAC.

    Parameters
    ----------
    counts : ndarray of int64, shape (k,)
        Inliers of each sample drawn; -1 where its points lie on a line.
    n_planned : int
        Samples that would have been drawn at most.
    share : float
        Of inliers among the near points, from which the samples are drawn, at the end.
    n_near : int
    inliers : ndarray of bool, shape (n,), or None
        Of the motion refitted to the best sample; None where too few agreed.
    reason : str
        Why there is none.
    """

    counts: IntArray
    n_planned: int
    share: float
    n_near: int
    inliers: BoolArray | None
    reason: str

    @property
    def is_stopped_early(self) -> bool:
        """Tell that not all samples had to be drawn."""
        return len(self.counts) < self.n_planned


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConsensusStep:
    """Which matches agree on a motion.

    Parameters
    ----------
    pixels_reference, pixels_current : ndarray of float64, shape (n, 2)
        Of the matches.
    is_known : bool
        Most matches agreed with the predicted motion; no samples were drawn.
    n_agreeing : int or None
        Matches that agree with the predicted motion; None without one.
    n_needed : float
        From how many on no samples are drawn.
    inliers : ndarray of bool, shape (n,), or None
        The consensus; None where there is none.
    search : SampleSearch
        What the samples found, or would have found.
    """

    pixels_reference: FloatArray
    pixels_current: FloatArray
    is_known: bool
    n_agreeing: int | None
    n_needed: float
    inliers: BoolArray | None
    search: SampleSearch


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinementStep:
    """The pose before and after the refinement.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (3, 4, 4)
        At the start, where matches were chosen again, and at the end.
    residuals_px : ndarray of float64, shape (2, n, 3)
        (u, v, disparity) measured less predicted, at the start and at the end, pixels.
    whitened : ndarray of float64, shape (2, n, 3)
        The same in sigmas.
    gate : float
        Sigmas.
    inliers : ndarray of bool, shape (2, n)
        The matches at the start and at the end.
    n_within : int or None
        How many passed the gate after the first steps; None where none were made. Where they are
        less than half of those at the start, the latter stay.
    n_steps : int
        Of Gauss-Newton.
    scale : float
        Root mean square of the whitened residuals that the pose rests on, weighted.
    correspondences : Correspondences
    """

    T_target_source: FloatArray
    residuals_px: FloatArray
    whitened: FloatArray
    gate: float
    inliers: BoolArray
    n_within: int | None
    n_steps: int
    scale: float
    correspondences: Correspondences


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeLink:
    """What one earlier frame contributed.

    Parameters
    ----------
    reference_ns : int
        Stamp.
    index : int
        Of that frame in the recording.
    kind : {"step", "keyframe", "standstill", "not linked"}
    image : ndarray of uint8, shape (height, width)
    score : float or None
        Share of the keyframe's points in view, 0 to 1; None for what is no keyframe.
    registration : RelativePose, Failure or None
        Of the current frame against it, where that was tried.
    chi2 : float or None
        Of the edge, against the window's poses, of 6 degrees of freedom.
    is_accepted : bool
    reason : str
        Why there is no edge, or why it was refused.
    """

    reference_ns: int
    index: int
    kind: str
    image: ImageArray
    score: float | None
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
        Its name.
    index : int
        Of the frame.
    config : Config
    camera : StereoCamera
        Of RGB-D with the virtual baseline.
    frame, reference : StereoFrame or RgbdFrame
        The frame, and the one that it was registered against; None for a first frame.
    reference_index : int or None
    result : FrameResult
        As a run gives it.
    rig_offsets : RigOffsets or None
        What was learnt of the rig, with this frame.
    offset_px, row_offset_px : float
        What was known of the rig before: taken off disparities, added to rows.
    keypoints : KeypointStep
    stereo, depth, subpixel, temporal, consensus, refinement
        The steps; None where they were not reached, or are those of another sensor.
    attempts : tuple of str
        The ways to a registration that were tried, a line each.
    links : tuple of KeyframeLink
        Predecessor first, then the keyframes, oldest first.
    became_keyframe : bool
    """

    recording: str
    index: int
    config: Config
    camera: StereoCamera
    frame: Frame
    reference: Frame | None
    reference_index: int | None
    result: FrameResult
    rig_offsets: RigOffsets | None
    offset_px: float
    row_offset_px: float
    keypoints: KeypointStep
    stereo: StereoStep | None
    depth: DepthStep | None
    subpixel: SubpixelStep | None
    temporal: TemporalStep | None
    consensus: ConsensusStep | None
    refinement: RefinementStep | None
    attempts: tuple[str, ...]
    links: tuple[KeyframeLink, ...]
    became_keyframe: bool

    @property
    def image(self) -> ImageArray:
        """The left or colour image."""
        return self.frame.left if isinstance(self.frame, StereoFrame) else self.frame.image
