"""The KLT front-end: corners tracked by Lucas-Kanade, measured in 3-D in both frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Literal, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.frontend.depth_icp import DepthImage
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.features import describe_pixels, thin
from gvo.frontend.offsets import KLT_SIGMA_FACTOR, RigOffsets
from gvo.frontend.registration import check_view, match_anywhere, register_anywhere
from gvo.frontend.rgbd import check_depths, is_seen_again, sample_depth
from gvo.frontend.rig import CalibratedCamera, FrameMotion, Measurements, note_step
from gvo.frontend.stereo.disparity import (
    follow_disparities,
    measure_corners,
    measure_disparities,
)
from gvo.frontend.stereo.matching import is_in_depth_range
from gvo.frontend.tracking import (
    N_WIDE_LEVELS,
    SPACING_PX,
    Templates,
    cut_patches,
    detect_corners,
    halve,
    track_pixels,
    track_roughly,
)
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.kernels import prediction
from gvo.kernels.templates import RADIUS_PX
from gvo.types import (
    BoolArray,
    Contradiction,
    Failure,
    FloatArray,
    Frame,
    ImageArray,
    IntArray,
    MotionPrior,
    Observations,
    RelativePose,
    RgbdFrame,
    StereoFrame,
)

# Standard deviations of a tracked pixel, and of the disparity of a corner or track, for stereo.
_PIXEL_SIGMA_PX = 0.15
_DISPARITY_SIGMA_PX = 0.15
# Gauss-Newton steps from the predicted disparity of a track.
_N_TRACK_STEPS = 4
# An alignment that ends farther from its track was of something else.
_MAX_ALIGN_PX = 3.0
# Patches of a place are described in another size too: it is seen again from farther, or nearer.
_WIDE = 1.5
# By how much more corners of a lost camera are looked for.
_DENSITY = 3
# Median displacement of a step that tells which corners stay, riding with the camera.
_TELLING_PX = 1.0
# How tracks are found: over more levels of the pyramid; near the predicted pixels, without its
# finest one; by alignment alone, where the prediction is that of poses that are known.
_Search: TypeAlias = Literal["wide", "near", "aligned"]


class KltFrontend:
    """Tracks the corners of a reference into the current frame and registers both.

    Each registration starts from the corners of its reference, so that patches do not drift
    over many frames. The tracked corners are measured in 3-D in the current frame too: in its
    right image, or in its depth. Constant errors of the camera are calibrated online
    (`rig_offsets`) and taken off.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Stereo pair, or the colour camera of an RGB-D sensor.
    config : Config
    rig_offsets : RigOffsets, optional
        What was learnt of the camera before.
    """

    def __init__(
        self,
        camera: StereoCamera | PinholeCamera,
        config: Config,
        *,
        rig_offsets: RigOffsets | None = None,
    ) -> None:
        self.camera = as_stereo(camera)
        self._is_stereo = isinstance(camera, StereoCamera)
        self.rig_offsets = rig_offsets or RigOffsets(self.camera, config, is_stereo=self._is_stereo)
        self.calibrated = CalibratedCamera(self.camera, self.rig_offsets)
        self._config = config

    def extract(self, frame: Frame) -> KltObservations:
        """Return a frame with its corners that are measured in 3-D.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
        """
        self.rig_offsets.advance()
        image, depth = image_of(frame), None
        if isinstance(frame, RgbdFrame):
            depth = DepthImage(frame, self.camera, self._config.depth)
        half = halve(image)
        return KltObservations(
            stamp_ns=frame.stamp_ns,
            frame=frame,
            image=image,
            half=half,
            corners=self._find_corners(frame, half, self._config.klt.n_corners),
            depth=depth,
        )

    def _find_corners(
        self, frame: Frame, half: ImageArray, n_corners: int, *, spacing_px: int = SPACING_PX
    ) -> KltCorners:
        corners = detect_corners(
            image_of(frame), n_corners, spacing_px=spacing_px, half=half, mask=frame.mask
        )
        is_carried = self.rig_offsets.carried.holds(corners)
        carried, corners = corners[is_carried], corners[~is_carried]
        self.rig_offsets.carried.n_corners += len(carried)
        row_shifts_px = np.full(len(corners), np.nan)
        if isinstance(frame, StereoFrame):
            config, images = self._config.stereo, (frame.left, frame.right)
            limit = float(self.camera.depth_to_disparity(config.min_depth_m))
            halves = half, halve(frame.right)
            row_offsets_px = self.rig_offsets.row_errors(corners)
            measured = measure_corners(
                images, halves, corners, config, max_disparity=limit, row_offsets_px=row_offsets_px
            )
            disparities, slopes = measured.disparities, measured.slopes
            row_shifts_px = measured.row_shifts_px + row_offsets_px
            is_valid = measured.are_reliable & self._is_in_range(corners, disparities)
            is_valid &= is_unmasked(frame, corners, disparities)
        else:
            disparities, is_valid = self._measure_depth(frame, corners)
            slopes = np.zeros_like(corners)
        uvd = np.column_stack([corners, disparities])[is_valid]
        ideal = self.rig_offsets.take_off(uvd)
        return KltCorners(
            uvd=uvd,
            slopes=slopes[is_valid],
            points_cam=self.camera.unproject_stereo(ideal[:, :2], ideal[:, 2]),
            n_keypoints=len(corners),
            row_shifts_px=row_shifts_px[is_valid],
            carried=carried,
            templates=Templates.of(image_of(frame), uvd[:, :2]),
        )

    def register(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None = None
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame.

        Parameters
        ----------
        reference, current : KltObservations
        prior : MotionPrior, optional
            Tracks start at the pixels it predicts. Without it they start at the previous pixels,
            over more levels of the pyramid; where that fails descriptors are matched; the result
            is the prior of a second round. The same is done where a prior with a recent median
            motion fails: the camera may have moved as never before. A keyframe, whose prior has
            none, is not worth that.

        Returns
        -------
        RelativePose or Failure
            The second column of `matches` is -1: tracks do not end at observations.
        """
        result = self._register(reference, current, prior)
        result = self._check_depth(result, reference.depth_points, current.frame)
        if isinstance(result, RelativePose):
            is_step = prior is None or prior.T_recent is not None
            self.calibrated.accept(result, self._config, is_step=is_step)
            if is_step:
                corners = reference.corners
                self.rig_offsets.carried.note(result)
                if len(corners.carried) and (result.flow_px or 0.0) > _TELLING_PX:
                    images = reference.image, current.image
                    self.rig_offsets.carried.watch(images, corners.carried)
                self.rig_offsets.note_rows(corners.uvd, corners.row_shifts_px)
        return result

    def _register(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        if prior is None:
            return self._register_widely(reference, current, None)
        if prior.T_recent is None:
            result = self._register_link(prior, reference, current)
        else:
            result = self._register_step(prior, reference, current, "near")
            if not isinstance(result, RelativePose | Contradiction):
                return self._register_widely(reference, current, prior)
        if prior.is_confirmed:
            return result
        return check_view(result, reference.points_cam, self.camera)

    def _register_widely(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        """Register in two rounds: over more levels of the pyramid, and from the result."""
        rough = self._register_step(prior, reference, current, "wide")
        if prior is None and not isinstance(rough, RelativePose | Contradiction):
            places = self.describe(reference), self.describe(current)
            rough = self.register_places(*places) or rough
        if isinstance(rough, Failure):
            return rough
        found = MotionPrior(T_predicted=rough.T_reference_current)
        result = self._register_step(found, reference, current, "near")
        # Nothing predicted it: what else it predicts must be there too.
        return self._check_view(result, reference, reference.depth_points, current.frame)

    def align_depth(
        self, reference: KltObservations, current: KltObservations, T_reference_current: FloatArray
    ) -> RelativePose | Failure:
        """Estimate the motion from a start value by ICP of the depth images of an RGB-D camera."""
        if reference.depth is None or current.depth is None:
            return Failure(reason="a stereo camera has no depth images")
        return reference.depth.align(current.depth, T_reference_current)

    def describe(self, observations: KltObservations) -> KltPlace:
        """Return a frame as a place: small, but for its image all that `recognize` needs."""
        return self._describe(observations, observations.corners)

    def describe_densely(self, observations: KltObservations) -> KltPlace:
        """Return a frame as a place with more corners, which find more of another place's."""
        n_corners, spacing_px = _DENSITY * self._config.klt.n_corners, 2 * SPACING_PX // 3
        corners = self._find_corners(
            observations.frame, observations.half, n_corners, spacing_px=spacing_px
        )
        return self._describe(observations, corners)

    def _describe(self, observations: KltObservations, corners: KltCorners) -> KltPlace:
        image, chosen = observations.image, thin(len(corners.uvd))
        uvd, grid = corners.uvd[chosen], observations.depth_points
        keypoints = uvd[:, :2]
        return KltPlace(
            stamp_ns=observations.stamp_ns,
            uvd=uvd.astype(np.float32),
            points=corners.points_cam[chosen].astype(np.float32),
            slopes=corners.slopes[chosen].astype(np.float32),
            patches=cut_patches(image, keypoints, RADIUS_PX + 1),
            descriptors_left=describe_pixels(image, keypoints),
            descriptors_wide=describe_pixels(image, keypoints, _WIDE),
            depth_points=None if grid is None else grid.astype(np.float32),
            motion=observations.motion,
        )

    def recognize(
        self, reference: KltPlace, current: KltPlace, observations: KltObservations
    ) -> RelativePose | Failure:
        """Estimate the motion from a place to a frame: by descriptors, then by its patches.

        Parameters
        ----------
        reference, current : KltPlace
        observations : KltObservations
            Of the current frame.

        Returns
        -------
        RelativePose or Failure
        """
        rough = self.register_places(reference, current)
        if isinstance(rough, Failure):
            return rough
        prior = MotionPrior(T_predicted=rough.T_reference_current)
        corners, grid = reference.unpack(), reference.depth_points
        result = self._register_link(prior, corners, observations)
        points = None if grid is None else grid.astype(np.float64)
        checked = self._check_view(result, corners, points, observations.frame)
        return self._check_depth(checked, points, observations.frame)

    def _check_view(
        self,
        result: RelativePose | Failure,
        reference: KltReference,
        points: FloatArray | None,
        frame: Frame,
    ) -> RelativePose | Failure:
        """Refuse a motion that too few points in view confirm, or depth images for them."""
        checked = check_view(result, reference.points_cam, self.camera)
        if isinstance(result, Failure) or points is None or not isinstance(frame, RgbdFrame):
            return checked
        depths = points, frame.depth, self.camera, self._config.depth
        if isinstance(checked, Failure) and is_seen_again(result, *depths):
            return check_view(result, reference.points_cam, self.camera, depths_agree=True)
        return checked

    def register_places(self, reference: KltPlace, current: KltPlace) -> RelativePose | Failure:
        """Register by descriptors, which match corners that moved too far for a track."""
        first, second = (self._as_observations(place) for place in (reference, current))
        matches = match_anywhere(reference.descriptors, current.descriptors)
        offsets = self.rig_offsets
        return register_anywhere(first, second, matches, self.camera, self._config, offsets=offsets)

    def _as_observations(self, place: KltPlace) -> Observations:
        sigmas = np.ones((len(place.uvd), 3)) * [1.0, 1.0, self._sigmas(1)[0][0, 2]]
        uvd = place.uvd.astype(np.float64)
        return Observations(
            stamp_ns=place.stamp_ns,
            keypoints=uvd[:, :2],
            disparities=uvd[:, 2],
            points_cam=place.points_cam,
            sigmas=sigmas,
            descriptors_left=place.descriptors_left,
        )

    def _check_depth(
        self, result: RelativePose | Failure, points: FloatArray | None, frame: Frame
    ) -> RelativePose | Failure:
        """Refuse a motion that the depth images of an RGB-D camera contradict."""
        if isinstance(result, Failure) or points is None or not isinstance(frame, RgbdFrame):
            return result
        return check_depths(result, points, frame.depth, self.camera, self._config.depth)

    def _register_step(
        self,
        prior: MotionPrior | None,
        reference: KltObservations,
        current: KltObservations,
        search: _Search,
    ) -> RelativePose | Failure:
        """Track from the pixels that a motion predicts, measure in 3-D, register."""
        is_wide = search == "wide"
        return self.calibrated.register(
            self.measure(reference, current, prior, is_wide=is_wide),
            self._config,
            prior=None if is_wide else prior,
            is_step=True,
        )

    def measure(
        self,
        reference: KltObservations,
        current: KltObservations,
        prior: MotionPrior | None,
        *,
        is_wide: bool,
    ) -> Measurements:
        """Track the corners of a step from the pixels that its prior predicts; measure them."""
        T_predicted = None if prior is None else prior.T_predicted
        note_step(reference, current, T_predicted)
        T = np.eye(4) if T_predicted is None else T_predicted
        expected = self.predict(T, reference, current)
        measured = self._track(reference, current, expected, "wide" if is_wide else "near")
        return self.rig_offsets.carried.drop(measured, self._config.ransac)

    def _register_link(
        self, prior: MotionPrior, reference: KltReference, current: KltObservations
    ) -> RelativePose | Failure:
        """Align corners where they are expected, measure, register; velocities stay as they are."""
        expected = self.predict(prior.T_predicted, reference, current)
        measured = self._track(reference, current, expected, "aligned")
        return self.calibrated.register(measured, self._config, prior=prior, is_step=False)

    def _sigmas(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return the sigmas of (u, v, disparity) of corners and of their tracks."""
        disparity = _DISPARITY_SIGMA_PX if self._is_stereo else self._config.depth.sigma_px
        # A corner is where it was cut out: only the track into the current frame is noisy.
        corner = [0.0, 0.0, disparity]
        track = [_PIXEL_SIGMA_PX, _PIXEL_SIGMA_PX, disparity]
        return np.tile(corner, (n, 1)), np.tile(track, (n, 1))

    def _track(
        self,
        reference: KltReference,
        current: KltObservations,
        expected: Expected,
        search: _Search,
    ) -> Measurements:
        """Find expected corners in the current frame, and measure them there."""
        pixels, is_tracked = self.find_tracks(reference, current, expected, search)
        tracked = np.flatnonzero(is_tracked)
        pixels, expected = pixels.take(tracked, axis=0), expected.take(tracked)
        disparities, is_valid = self._measure(current.frame, pixels, expected, search)
        valid = np.flatnonzero(is_valid)
        indices = expected.indices.take(valid)
        uvd = np.column_stack([pixels, disparities]).take(valid, axis=0)
        return Measurements(
            frames=(reference, current),
            uvd=(reference.corners.uvd.take(indices, axis=0), uvd),
            sigmas=self._sigmas(len(indices)),
            matches=np.column_stack([indices, np.full_like(indices, -1)]),
            sigma_factor=KLT_SIGMA_FACTOR,
        )

    def predict(
        self, T_reference_current: FloatArray, reference: KltReference, current: KltObservations
    ) -> Expected:
        """Return the corners that are in view of the current camera after a motion."""
        corners, n = reference.corners, len(reference.corners.uvd)
        indices, uvd, warps = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 2, 2))
        slopes = np.empty((n, 2))
        n_seen = prediction.predict(
            *(corners.uvd, corners.slopes, np.array(T_reference_current)),
            *self.calibrated.bends(reference, current),
            *(self.camera.parameters, indices, uvd, warps, slopes),
        )
        return Expected(
            T_reference_current=T_reference_current,
            indices=indices[:n_seen],
            uvd=uvd[:n_seen],
            warps=warps[:n_seen],
            slopes=slopes[:n_seen],
        )

    def find_tracks(
        self,
        reference: KltReference,
        current: KltObservations,
        expected: Expected,
        search: _Search,
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels of expected corners in the current image, and which are found.

        Lucas-Kanade finds a patch wherever it went, but as if it had only been moved. From there,
        or from a good prediction, the patch is aligned as it looks after the predicted motion;
        a wide search has no such motion.
        """
        start = expected.uvd[:, :2]
        if search == "aligned":
            return self._align(reference, current, expected, start)
        kept = cast(KltObservations, reference)  # a place is only aligned
        places = kept.keypoints[expected.indices], start
        if search == "wide":
            images = kept.image, current.image
            return track_pixels(images, *places, n_levels=N_WIDE_LEVELS, is_checked=True)
        pixels, is_tracked = track_roughly((kept.half, current.half), *places)
        tracked = np.flatnonzero(is_tracked)
        roughly = pixels.take(tracked, axis=0)
        aligned, is_found = self._align(reference, current, expected.take(tracked), roughly)
        is_found &= np.hypot(*(aligned - roughly).T) < _MAX_ALIGN_PX
        pixels[tracked], is_tracked[tracked] = aligned, is_found
        return pixels, is_tracked

    def _align(
        self,
        reference: KltReference,
        current: KltObservations,
        expected: Expected,
        start: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        templates = reference.corners.templates
        searched = current.image, expected.indices, start, expected.warps
        pixels, is_found = templates.align(*searched)
        return pixels, is_found & self.camera.is_in_view(pixels)

    def _measure(
        self, frame: Frame, pixels: FloatArray, expected: Expected, search: _Search
    ) -> tuple[FloatArray, BoolArray]:
        """Measure the disparities of tracks, virtual ones of RGB-D."""
        if isinstance(frame, RgbdFrame):  # depth that is masked is not known
            return self._measure_depth(frame, pixels)
        config, images = self._config.stereo, (frame.left, frame.right)
        row_offsets_px = self.rig_offsets.row_errors(pixels)
        follow = partial(follow_disparities, n_steps=_N_TRACK_STEPS, slopes=expected.slopes)
        measure = measure_disparities if search == "wide" else follow
        disparities, is_valid = measure(
            images, pixels, expected.uvd[:, 2], config, row_offsets_px=row_offsets_px
        )
        is_valid &= self._is_in_range(pixels, disparities)
        return disparities, is_valid & is_unmasked(frame, pixels, disparities)

    def _is_in_range(self, pixels: FloatArray, disparities: FloatArray) -> BoolArray:
        ideal = self.rig_offsets.take_off(np.column_stack([pixels, disparities]))
        return is_in_depth_range(ideal[:, 2], self.camera, self._config.stereo)

    def _measure_depth(self, frame: RgbdFrame, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        depths, is_valid = sample_depth(frame.depth, pixels, self._config.depth)
        return self.camera.depth_to_disparity(np.where(is_valid, depths, np.nan)), is_valid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltCorners:
    """The corners of a frame that are measured in 3-D.

    Parameters
    ----------
    uvd : ndarray of float64, shape (n, 3)
        Pixels (u, v) in the left or colour image, and disparities, as measured; for RGB-D the
        virtual ones, fx * baseline / depth.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparity per pixel, along rows and columns; zero for RGB-D.
    points_cam : ndarray of float64, shape (n, 3)
        Points in the `cam` frame, metres, without the errors of the lens known then.
    templates : Templates
        The patches around them.
    n_keypoints : int
        Corners detected, measured or not.
    row_shifts_px : ndarray of float64, shape (n,)
        By how much their rows are larger in the right image; NaN where not measured.
    carried : ndarray of float64, shape (m, 2)
        Pixels of other corners, which ride with the camera.
    """

    uvd: FloatArray
    slopes: FloatArray
    points_cam: FloatArray
    templates: Templates
    n_keypoints: int
    row_shifts_px: FloatArray
    carried: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Expected:
    """The corners of a reference that a motion brings into view of another frame.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        The motion, metres.
    indices : ndarray of int64, shape (n,)
        Of the corners, among those of the reference.
    uvd : ndarray of float64, shape (n, 3)
        Pixels and disparities that the other frame should measure.
    warps : ndarray of float64, shape (n, 2, 2)
        See `patch_warps`.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparities per pixel, there.
    """

    T_reference_current: FloatArray
    indices: IntArray
    uvd: FloatArray
    warps: FloatArray
    slopes: FloatArray

    def take(self, chosen: IntArray) -> Expected:
        """Select corners by index."""
        return Expected(
            T_reference_current=self.T_reference_current,
            indices=self.indices.take(chosen),
            uvd=self.uvd.take(chosen, axis=0),
            warps=self.warps.take(chosen, axis=0),
            slopes=self.slopes.take(chosen, axis=0),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltReference:
    """Corners to be tracked into another frame: those of a frame, or of a place.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the frame, nanoseconds.
    corners : KltCorners
    motion : FrameMotion
        Filled in by the steps before and after the frame.
    """

    stamp_ns: int
    corners: KltCorners
    motion: FrameMotion = field(default_factory=FrameMotion, compare=False)

    @property
    def points_cam(self) -> FloatArray:
        """The corners as points in the `cam` frame, metres, shape (n, 3)."""
        return self.corners.points_cam


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltObservations(KltReference):
    """A frame to track corners into, and its own corners, tracked when the next frame comes.

    Parameters
    ----------
    stamp_ns, corners, motion
        See `KltReference`.
    frame : StereoFrame or RgbdFrame
    image : ndarray of uint8, shape (height, width)
        Its image to track in, left or colour.
    half : ndarray of uint8, shape (height // 2, width // 2)
        The same, of half the size.
    depth : DepthImage or None
        None for stereo.
    """

    frame: Frame
    image: ImageArray
    half: ImageArray
    depth: DepthImage | None = field(default=None, compare=False)

    @property
    def keypoints(self) -> FloatArray:
        """Pixels (u, v) of the corners, shape (n, 2)."""
        return self.corners.uvd[:, :2]

    @property
    def depth_points(self) -> FloatArray | None:
        """A grid of the depth image as points in the `cam` frame, metres; None for stereo."""
        return None if self.depth is None else self.depth.grid

    @property
    def n_keypoints(self) -> int:
        """Corners detected, measured or not."""
        return self.corners.n_keypoints

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.corners.uvd)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltPlace:
    """A frame kept small: its corners with their descriptors and patches.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the frame, nanoseconds.
    uvd : ndarray of float32, shape (n, 3)
        Pixels and disparities as measured.
    points : ndarray of float32, shape (n, 3)
        In the `cam` frame, metres.
    slopes : ndarray of float32, shape (n, 2)
        Of the disparities.
    patches : ndarray of uint8, shape (n, 11, 11)
    descriptors_left, descriptors_wide : ndarray of uint8, shape (n, 32)
        Of patches of two sizes.
    depth_points : ndarray of float32, shape (m, 3), or None
        A grid of the depth image as points, metres.
    motion : FrameMotion
        That of the frame.
    """

    stamp_ns: int
    uvd: NDArray[np.float32]
    points: NDArray[np.float32]
    slopes: NDArray[np.float32]
    patches: NDArray[np.uint8]
    descriptors_left: NDArray[np.uint8]
    descriptors_wide: NDArray[np.uint8]
    depth_points: NDArray[np.float32] | None
    motion: FrameMotion = field(compare=False)

    @property
    def descriptors(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The descriptors of the corners, of both sizes."""
        return self.descriptors_left, self.descriptors_wide

    @property
    def points_cam(self) -> FloatArray:
        """The corners as points in the `cam` frame, metres, shape (n, 3)."""
        return self.points.astype(np.float64)

    def unpack(self) -> KltReference:
        """Return its corners with their patches prepared anew."""
        corners = KltCorners(
            uvd=self.uvd.astype(np.float64),
            slopes=self.slopes.astype(np.float64),
            points_cam=self.points_cam,
            templates=Templates.of_patches(self.patches),
            n_keypoints=len(self.uvd),
            row_shifts_px=np.full(len(self.uvd), np.nan),
        )
        return KltReference(stamp_ns=self.stamp_ns, corners=corners, motion=self.motion)


def is_unmasked(frame: StereoFrame, pixels: FloatArray, disparities: FloatArray) -> BoolArray:
    """Tell which pixels (n, 2) with these disparities no mask covers, left and right."""
    rows, columns = np.rint(pixels[:, 1]).astype(np.int64), pixels[:, 0]
    is_used = np.ones(len(pixels), np.bool_)
    for mask, u in (
        (frame.mask, columns),
        (frame.right_mask, columns - np.nan_to_num(disparities)),
    ):
        if mask is not None:
            is_used &= mask[rows, np.clip(np.rint(u), 0, mask.shape[1] - 1).astype(np.int64)] > 0
    return is_used


def image_of(frame: Frame) -> ImageArray:
    """Return the image to track in, left or colour."""
    return frame.left if isinstance(frame, StereoFrame) else frame.image
