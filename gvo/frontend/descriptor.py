"""The front-end of descriptors: sparse stereo or depth, windowed matching, registration."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from gvo.config import Config
from gvo.frontend.features import FeatureExtractor, Features, thin
from gvo.frontend.matching import match_temporal, predict_pixels
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.registration import check_view, match_anywhere, register_anywhere
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.rig import CalibratedCamera, FrameMotion, Measurements, note_step
from gvo.frontend.stereo.matching import is_in_depth_range, match_stereo, refine_disparities
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import (
    Contradiction,
    Failure,
    FloatArray,
    Frame,
    IntArray,
    MotionPrior,
    Observations,
    RelativePose,
    RgbdFrame,
    StereoFrame,
)

# Standard deviations of a keypoint's pixel, and of its disparity, for stereo.
_PIXEL_SIGMA_PX = 0.7
_DISPARITY_SIGMA_PX = 0.3
# Inflation of the sigmas of a registration: errors of the matches correlate.
_SIGMA_FACTOR = 1.2
# An RGB-D camera is treated as a stereo camera of this baseline, that of a Kinect.
_VIRTUAL_BASELINE_M = 0.075
# Without a prediction, or after it gave too few matches, the search is as many times wider.
WIDE = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescriptorObservations(Observations):
    """Observations that know how their frame moved while it was exposed."""

    motion: FrameMotion = field(default_factory=FrameMotion, compare=False)


class DescriptorFrontend:
    """Extracts observations from frames and registers two frames' observations.

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
        is_stereo = isinstance(camera, StereoCamera)
        self.rig_offsets = rig_offsets or RigOffsets(self.camera, config, is_stereo=is_stereo)
        self.calibrated = CalibratedCamera(self.camera, self.rig_offsets)
        self._config = config
        self._extractors = [FeatureExtractor(config.features) for _ in range(2)]
        self._pool = ThreadPoolExecutor(1) if config.runtime.threads > 1 else None

    def extract(self, frame: Frame) -> DescriptorObservations:
        """Return the keypoints of a frame that are measured in 3-D.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
        """
        self.rig_offsets.advance()
        if isinstance(frame, StereoFrame):
            return self._extract_stereo(frame)
        return self._extract_rgbd(frame)

    def _extract_stereo(self, frame: StereoFrame) -> DescriptorObservations:
        left, right = self._extract_both(frame)
        config = self._config.stereo
        pairs = match_stereo(left, right, self.camera, config)
        pixels = left.keypoints[pairs[:, 0]], right.keypoints[pairs[:, 1]]
        disparities, is_valid = refine_disparities((frame.left, frame.right), *pixels, config)
        ideal = self.rig_offsets.take_off(np.column_stack([pixels[0], disparities]))
        is_in_range = is_in_depth_range(ideal[:, 2], self.camera, config)
        is_valid &= is_in_range
        return self._observe(frame.stamp_ns, left, right, pairs[is_valid], disparities[is_valid])

    def _extract_both(self, frame: StereoFrame) -> tuple[Features, Features]:
        first, second = self._extractors
        left, right = (frame.left, frame.mask), (frame.right, frame.right_mask)
        if self._pool is None:
            return first.extract(*left), second.extract(*right)
        pending = self._pool.submit(second.extract, *right)
        return first.extract(*left), pending.result()

    def _extract_rgbd(self, frame: RgbdFrame) -> DescriptorObservations:
        features = self._extractors[0].extract(frame.image, frame.mask)
        depths, is_valid = sample_depth(frame.depth, features.keypoints, self._config.depth)
        chosen = np.flatnonzero(is_valid)
        disparities = self.camera.depth_to_disparity(depths[chosen])
        pairs = np.stack([chosen, chosen], axis=1)
        return self._observe(frame.stamp_ns, features, None, pairs, disparities)

    def _observe(
        self,
        stamp_ns: int,
        left: Features,
        right: Features | None,
        pairs: IntArray,
        disparities: FloatArray,
    ) -> DescriptorObservations:
        keypoints = left.keypoints[pairs[:, 0]]
        ideal = self.rig_offsets.take_off(np.column_stack([keypoints, disparities]))
        return DescriptorObservations(
            stamp_ns=stamp_ns,
            keypoints=keypoints,
            disparities=disparities,
            points_cam=self.camera.unproject_stereo(ideal[:, :2], ideal[:, 2]),
            sigmas=self._sigmas(left.octaves[pairs[:, 0]], is_stereo=right is not None),
            descriptors_left=left.descriptors[pairs[:, 0]],
            descriptors_right=None if right is None else right.descriptors[pairs[:, 1]],
            n_keypoints=len(left),
        )

    def _sigmas(self, octaves: IntArray, *, is_stereo: bool) -> FloatArray:
        config = self._config
        is_sift = config.features.kind == "sift"
        level_ratio = 2.0 if is_sift else config.features.scale_factor
        pixel = _PIXEL_SIGMA_PX * level_ratio**octaves
        disparity = _DISPARITY_SIGMA_PX if is_stereo else config.depth.sigma_px
        return np.column_stack([pixel, pixel, np.full(len(octaves), disparity)])

    def register(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        prior: MotionPrior | None = None,
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame.

        Parameters
        ----------
        reference, current : DescriptorObservations
        prior : MotionPrior, optional
            Matches are searched around the pixels it predicts, then in wider windows. Without
            it, in the wider windows around the previous pixels.

        Returns
        -------
        RelativePose or Failure
        """
        result = self._register(reference, current, prior)
        if isinstance(result, RelativePose):
            self.calibrated.accept(result, self._config, is_step=is_step(prior))
            if is_step(prior):
                self.rig_offsets.carried.note(result)
        return result

    def _register(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        prior: MotionPrior | None,
    ) -> RelativePose | Failure:
        if prior is not None:
            result = self._register_within(reference, current, prior, is_wide=False)
            if not prior.is_confirmed:
                result = check_view(result, reference.points_cam, self.camera)
            if isinstance(result, RelativePose | Contradiction):
                return result
        rough = self._register_within(reference, current, prior, is_wide=True)
        if isinstance(rough, Failure):
            return rough
        # Nothing predicted it: what else it predicts must be there too.
        return self._check_view(reference, current, rough)

    def describe(self, observations: DescriptorObservations) -> DescriptorObservations:
        """Return a frame as a place: fewer points, without what only neighbours need."""
        chosen = thin(len(observations))
        return replace(
            observations,
            keypoints=observations.keypoints[chosen],
            disparities=observations.disparities[chosen],
            points_cam=observations.points_cam[chosen],
            sigmas=observations.sigmas[chosen],
            descriptors_left=observations.descriptors_left[chosen],
            descriptors_right=None,
        )

    def recognize(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        observations: DescriptorObservations,
    ) -> RelativePose | Failure:
        """Estimate the motion from a place to a frame, given with its own place."""
        first, second = reference.descriptors_left, observations.descriptors_left
        rough = register_anywhere(
            *(reference, observations, match_anywhere([first], [second])),
            *(self.camera, self._config),
            offsets=self.rig_offsets,
        )
        if isinstance(rough, Failure):
            return rough
        return self._check_view(reference, observations, rough)

    def _check_view(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        rough: RelativePose,
    ) -> RelativePose | Failure:
        """Match again around the pixels that a motion predicts, and check the view."""
        prior = MotionPrior(T_predicted=rough.T_reference_current)
        result = self._register_within(reference, current, prior, is_wide=False)
        return check_view(result, reference.points_cam, self.camera)

    def _register_within(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        prior: MotionPrior | None,
        *,
        is_wide: bool,
    ) -> RelativePose | Failure:
        return self.calibrated.register(
            self.measure(reference, current, prior, is_wide=is_wide),
            self._config,
            prior=prior,
            is_step=is_step(prior),
        )

    def measure(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        prior: MotionPrior | None,
        *,
        is_wide: bool,
    ) -> Measurements:
        """Match two frames in a window around the pixels that a prior predicts."""
        T_predicted = None if prior is None else prior.T_predicted
        if is_step(prior):
            note_step(reference, current, T_predicted)
        predicted = predict_pixels(reference, T_predicted, self.camera)
        config = self._config.temporal
        radius_px = (WIDE if is_wide else 1.0) * config.radius_px
        matches = match_temporal(reference, current, predicted, config, radius_px=radius_px)
        found = Correspondences.of(reference, current, matches)
        measured = Measurements(
            frames=(reference, current),
            uvd=(found.reference_uvd, found.current_uvd),
            sigmas=(found.reference_sigmas, found.current_sigmas),
            matches=matches,
            sigma_factor=_SIGMA_FACTOR,
        )
        return self.rig_offsets.carried.drop(measured, self._config.ransac)


def is_step(prior: MotionPrior | None) -> bool:
    """Tell whether a registration is a step of the chain; keyframes have no recent motion."""
    return prior is None or prior.T_recent is not None


def as_stereo(camera: StereoCamera | PinholeCamera) -> StereoCamera:
    """Return a stereo camera; an RGB-D camera gets the virtual baseline."""
    if isinstance(camera, StereoCamera):
        return camera
    return StereoCamera.from_pinhole(camera, _VIRTUAL_BASELINE_M)
