"""The KLT front-end: corners tracked by Lucas-Kanade, measured in 3-D in both frames."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gvo._trace import note
from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend, as_stereo
from gvo.frontend.registration import check_view, register_correspondences, relocalize_observations
from gvo.frontend.rgbd import check_depths, sample_depth
from gvo.frontend.stereo.corners import CornerDisparities, measure_corners
from gvo.frontend.stereo.disparity import follow_disparities, measure_disparities
from gvo.frontend.stereo.matching import is_in_depth_range
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.frontend.tracking import detect_corners, track_pixels
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.correspondences import Correspondences
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

_MIN_DEPTH_M = 1e-3
# Gauss-Newton steps from the predicted disparity of a track.
_N_TRACK_STEPS = 4
# Number of frames whose descriptors are cached.
_N_DESCRIBED = 3


class KltFrontend:
    """Tracks the corners of a reference into the current frame and registers both.

    Each registration starts from the corners of its reference, so that patches do not drift
    over many frames. The tracked corners are measured in 3-D in the current frame too: in its
    right image, or in its depth. Constant offsets of a stereo rig are calibrated online
    (`rig_offsets`) and subtracted.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Stereo pair, or the colour camera of an RGB-D sensor.
    config : Config
    """

    def __init__(self, camera: StereoCamera | PinholeCamera, config: Config) -> None:
        self.camera = as_stereo(camera, config)
        self.rig_offsets = RigOffsets(config.stereo, is_stereo=isinstance(camera, StereoCamera))
        self._config = config
        self._descriptors = DescriptorFrontend(camera, config)
        self._described: dict[int, Observations] = {}
        self._pool = ThreadPoolExecutor(1, "corners") if config.runtime.threads > 2 else None

    def extract(self, frame: Frame) -> KltObservations:
        """Return a frame with its corners that are measured in 3-D.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
        """
        self.rig_offsets.advance()
        offsets_px = self._offsets_px()
        if self._pool is not None:
            pending = self._pool.submit(self._find_corners, frame, *offsets_px)
            return KltObservations(frame=frame, find_corners=pending.result)
        corners = self._find_corners(frame, *offsets_px)
        return KltObservations(frame=frame, find_corners=lambda: corners)

    def _find_corners(self, frame: Frame, offset_px: float, row_offset_px: float) -> KltCorners:
        corners = detect_corners(image_of(frame), self._config.klt)
        row_shift_px = None
        if isinstance(frame, StereoFrame):
            measured = self._measure_corners(frame, corners, row_offset_px)
            disparities, row_shift_px = measured.disparities, measured.row_shift_px
            is_valid = measured.are_reliable & self._is_in_range(disparities, offset_px)
        else:
            disparities, is_valid = self._measure_depth(frame, corners)
        note("klt.corners", corners=corners, disparities=disparities, is_valid=is_valid)
        keypoints, disparities = corners[is_valid], disparities[is_valid]
        return KltCorners(
            keypoints=keypoints,
            disparities=disparities,
            points_cam=self.camera.unproject_stereo(keypoints, disparities - offset_px),
            n_keypoints=len(corners),
            row_shift_px=row_shift_px,
        )

    def _measure_corners(
        self, frame: StereoFrame, corners: FloatArray, row_offset_px: float
    ) -> CornerDisparities:
        config, images = self._config.stereo, (frame.left, frame.right)
        limit = float(self.camera.depth_to_disparity(config.min_depth_m))
        return measure_corners(
            images, corners, config, max_disparity=limit, row_offset_px=row_offset_px
        )

    def _offsets_px(self) -> tuple[float, float]:
        """Return the offsets of disparities and of rows of the right image."""
        return self.rig_offsets.disparity.value_px, self.rig_offsets.row.value_px

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
            is the prior of a second round. The same is done where a prior with a recent mean
            motion fails: the camera may have moved as never before. A keyframe, whose prior has
            none, is not worth that.

        Returns
        -------
        RelativePose or Failure
            The second column of `matches` is -1: tracks do not end at observations.
        """
        result = self._register(reference, current, prior)
        if isinstance(result, RelativePose):
            result = self._check_depth(reference, current, result)
        if isinstance(result, RelativePose):
            self.rig_offsets.note(result, current.stamp_ns)
            row_shift_px = reference.find_corners().row_shift_px
            self.rig_offsets.note_rows(row_shift_px, reference.stamp_ns)
        return result

    def _register(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        if prior is None:
            return self._register_widely(reference, current, None)
        is_step = prior.T_recent is not None
        result = self._register_from(prior, reference, current, is_step=is_step)
        if not is_step or isinstance(result, RelativePose | Contradiction):
            return result
        return self._register_widely(reference, current, prior)

    def _register_widely(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        """Register in two rounds: over more levels of the pyramid, and from the result."""
        start = MotionPrior(T_predicted=np.eye(4)) if prior is None else prior
        rough = self._register_from(start, reference, current, is_wide=True)
        if prior is None and not isinstance(rough, RelativePose | Contradiction):
            rough = self._register_descriptors(reference, current)
        if isinstance(rough, Failure):
            return rough
        found = MotionPrior(T_predicted=rough.T_reference_current)
        result = self._register_from(found, reference, current, is_step=True)
        # Nothing predicted it: what else it predicts must be there too.
        return check_view(result, reference.points_cam, self.camera)

    def relocalize(
        self, reference: KltObservations, current: KltObservations
    ) -> RelativePose | Failure:
        """Estimate the motion between frames that may be far apart, by descriptors and tracks."""
        first, second = self._describe(reference), self._describe(current)
        offset_px = self._offsets_px()[0]
        rough = relocalize_observations(
            first, second, self.camera, self._config, offset_px=offset_px
        )
        self._forget_described()
        if isinstance(rough, Failure):
            return rough
        prior = MotionPrior(T_predicted=rough.T_reference_current)
        result = self._register_from(prior, reference, current)
        result = check_view(result, reference.points_cam, self.camera)
        if isinstance(result, Failure):
            return result
        return self._check_depth(reference, current, result)

    def _check_depth(
        self, reference: KltObservations, current: KltObservations, result: RelativePose
    ) -> RelativePose | Failure:
        """Refuse a motion that the depth images of an RGB-D camera contradict."""
        first, second = reference.frame, current.frame
        if isinstance(first, RgbdFrame) and isinstance(second, RgbdFrame):
            depths = first.depth, second.depth
            return check_depths(result, depths, self.camera, self._config.depth)
        return result

    def _register_descriptors(
        self, reference: KltObservations, current: KltObservations
    ) -> RelativePose | Failure:
        """Register by descriptors, which match corners that moved too far for a track."""
        result = self._descriptors.register(self._describe(reference), self._describe(current))
        self._forget_described()
        return result

    def _forget_described(self) -> None:
        for stamp_ns in sorted(self._described)[:-_N_DESCRIBED]:
            del self._described[stamp_ns]

    def _describe(self, observations: KltObservations) -> Observations:
        stamp_ns = observations.stamp_ns
        if stamp_ns not in self._described:
            self._described[stamp_ns] = self._descriptors.extract(observations.frame)
        return self._described[stamp_ns]

    def _register_from(
        self,
        prior: MotionPrior,
        reference: KltObservations,
        current: KltObservations,
        *,
        is_wide: bool = False,
        is_step: bool = False,
    ) -> RelativePose | Failure:
        """Track from the pixels that a motion predicts, measure in 3-D, register."""
        source_uvd, target_uvd, indices = self._track(
            prior.T_predicted, reference, current, is_wide=is_wide
        )
        result = register_correspondences(
            self._correspondences(
                source_uvd[indices], target_uvd, is_stereo=isinstance(current.frame, StereoFrame)
            ),
            np.column_stack([indices, np.full_like(indices, -1)]),
            self.camera,
            self._config,
            stamps_ns=(reference.stamp_ns, current.stamp_ns),
            prior=None if is_wide else prior,
            with_offset=is_step and self.rig_offsets.is_learning,
        )
        if isinstance(result, Failure):
            return result
        return replace(result, covariance=self._config.klt.sigma_factor**2 * result.covariance)

    def _track(
        self,
        T_reference_current: FloatArray,
        reference: KltObservations,
        current: KltObservations,
        *,
        is_wide: bool,
    ) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return all (u, v, disparity) of the reference, those tracked, and whose these are."""
        klt = self._config.klt
        source_uvd = np.column_stack([reference.keypoints, reference.disparities])
        predicted, indices = self._predict(T_reference_current, source_uvd)
        pixels, is_tracked = track_pixels(
            (reference.image, current.image),
            source_uvd[indices, :2],
            predicted[:, :2],
            klt,
            n_levels=klt.n_wide_levels if is_wide else klt.n_levels,
            is_checked=is_wide,
        )
        note(
            "attempt",
            method="tracks",
            prior=T_reference_current,
            is_wide=is_wide,
            radius_px=float(klt.window_radius_px),
            source_uvd=source_uvd,
            indices=indices,
            predicted=predicted,
            pixels=pixels,
            is_tracked=is_tracked,
        )
        pixels, predicted, indices = pixels[is_tracked], predicted[is_tracked], indices[is_tracked]
        disparities, is_valid = self._measure(current.frame, pixels, predicted[:, 2], is_wide)
        note("klt.measured", pixels=pixels, disparities=disparities, is_valid=is_valid)
        target_uvd = np.column_stack([pixels, disparities])[is_valid]
        return source_uvd, target_uvd, indices[is_valid]

    def _predict(
        self, T_reference_current: FloatArray, source_uvd: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Return (u, v, disparity), as measured, of the points in view of the current camera."""
        offset_px, _ = self._offsets_px()
        points = se3.transform_points(
            se3.invert(T_reference_current),
            self.camera.unproject_stereo(source_uvd[:, :2], source_uvd[:, 2] - offset_px),
        )
        in_front = np.flatnonzero(points[:, 2] > _MIN_DEPTH_M)
        uvd = self.camera.project_stereo(points[in_front])
        uvd[:, 2] += offset_px
        is_in_view = self.camera.is_in_view(uvd[:, :2])
        return uvd[is_in_view], in_front[is_in_view]

    def _correspondences(
        self, source_uvd: FloatArray, target_uvd: FloatArray, *, is_stereo: bool
    ) -> Correspondences:
        config = self._config
        disparity = config.klt.disparity_sigma_px if is_stereo else config.depth.sigma_px
        pixel = config.klt.pixel_sigma_px
        offset = np.array([0.0, 0.0, self._offsets_px()[0]])
        shape = (len(source_uvd), 1)
        return Correspondences.of_pixels(
            (source_uvd - offset, target_uvd - offset),
            # A corner is where it was cut out: only the track into the current frame is noisy.
            (np.tile([0.0, 0.0, disparity], shape), np.tile([pixel, pixel, disparity], shape)),
            self.camera,
        )

    def _measure(
        self, frame: Frame, pixels: FloatArray, predicted: FloatArray, is_wide: bool
    ) -> tuple[FloatArray, BoolArray]:
        """Measure the disparities of tracks, virtual ones of RGB-D."""
        if isinstance(frame, RgbdFrame):
            return self._measure_depth(frame, pixels)
        return self._measure_stereo(frame, pixels, predicted, is_wide=is_wide)

    def _measure_stereo(
        self, frame: StereoFrame, pixels: FloatArray, predicted: FloatArray, *, is_wide: bool
    ) -> tuple[FloatArray, BoolArray]:
        """Measure the disparities of tracks near predicted ones."""
        config, images = self._config.stereo, (frame.left, frame.right)
        offset_px, row_offset_px = self._offsets_px()
        measure = (
            partial(measure_disparities, reach_px=config.search_radius_px)
            if is_wide
            else partial(follow_disparities, n_steps=_N_TRACK_STEPS)
        )
        disparities, is_valid = measure(
            images, pixels, predicted, config, row_offset_px=row_offset_px
        )
        note("klt.followed", disparities=disparities, is_at_rest=is_valid)
        return disparities, is_valid & self._is_in_range(disparities, offset_px)

    def _is_in_range(self, disparities: FloatArray, offset_px: float) -> BoolArray:
        return is_in_depth_range(disparities - offset_px, self.camera, self._config.stereo)

    def _measure_depth(self, frame: RgbdFrame, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        depths, is_valid = sample_depth(frame.depth, pixels, self._config.depth)
        return self.camera.depth_to_disparity(np.where(is_valid, depths, np.nan)), is_valid


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
        Points in the `cam` frame, metres, the disparities corrected by the offset known then.
    n_keypoints : int
        Corners detected, measured or not.
    row_shift_px : float or None
        Remaining row offset of the right image; None where not measured.
    """

    keypoints: FloatArray
    disparities: FloatArray
    points_cam: FloatArray
    n_keypoints: int
    row_shift_px: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltObservations:
    """A frame to track corners into, and its own corners.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    find_corners : callable
        Returns its KltCorners, which another thread may still be detecting: they are needed
        only when the next frame comes.
    """

    frame: Frame
    find_corners: Callable[[], KltCorners]

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.frame.stamp_ns

    @property
    def image(self) -> ImageArray:
        """The image to track in, left or colour."""
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
    """Return the image to track in, left or colour."""
    return frame.left if isinstance(frame, StereoFrame) else frame.image
