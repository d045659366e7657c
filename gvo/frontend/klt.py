"""The front-end of tracks: corners followed by Lucas-Kanade, measured in 3-D in both frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gvo.config import Config
from gvo.frontend.corners import detect_corners
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.disparity import COARSE_ERROR_PX, measure_disparities, search_disparities
from gvo.frontend.registration import register_correspondences
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.tracking import track_pixels
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import (
    BoolArray,
    Failure,
    FloatArray,
    Frame,
    ImageArray,
    IntArray,
    RelativePose,
    RgbdFrame,
    StereoFrame,
)

_MIN_DEPTH_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KltObservations:
    """The corners of a frame that are measured in 3-D, and the frame to follow others into.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    keypoints : ndarray of float64, shape (n, 2)
        Pixels (u, v) in the left or colour image.
    disparities : ndarray of float64, shape (n,)
        Disparity in pixels; for RGB-D the virtual one, fx * baseline / depth.
    points_cam : ndarray of float64, shape (n, 3)
        Points in the `cam` frame, metres.
    n_keypoints : int
        Corners detected, measured or not.
    """

    frame: Frame
    keypoints: FloatArray
    disparities: FloatArray
    points_cam: FloatArray
    n_keypoints: int

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.frame.stamp_ns

    @property
    def image(self) -> ImageArray:
        """The image that is tracked in, left or colour."""
        return _image_of(self.frame)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.keypoints)


class KltFrontend:
    """Tracks the corners of a reference into the current frame and registers both.

    Each registration starts from the corners of its reference, so that patches do not drift
    over many frames. The tracked corners are measured in 3-D in the current frame too: in its
    right image, or in its depth.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Stereo pair, or the colour camera of an RGB-D sensor.
    config : Config
    """

    def __init__(self, camera: StereoCamera | PinholeCamera, config: Config) -> None:
        self.camera = as_stereo(camera, config)
        self._config = config

    def extract(self, frame: Frame) -> KltObservations:
        """Return the corners of a frame that are measured in 3-D.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
        """
        corners = detect_corners(_image_of(frame), self._config.klt)
        if isinstance(frame, StereoFrame):
            disparities, is_valid = self._search_stereo(frame, corners)
        else:
            disparities, is_valid = self._measure_depth(frame, corners)
        keypoints, disparities = corners[is_valid], disparities[is_valid]
        return KltObservations(
            frame=frame,
            keypoints=keypoints,
            disparities=disparities,
            points_cam=self.camera.unproject_stereo(keypoints, disparities),
            n_keypoints=len(corners),
        )

    def register(
        self, reference: KltObservations, current: KltObservations, prior: FloatArray | None = None
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame.

        Parameters
        ----------
        reference, current : KltObservations
        prior : ndarray of float64, shape (4, 4), optional
            Predicted T_reference_current; tracks start at the pixels it predicts. Without it
            they start at the previous pixels. Then, and where the prediction leads to nothing,
            more levels of the pyramid are searched, and what this gives is the prediction of
            a second round.

        Returns
        -------
        RelativePose or Failure
            The second column of `matches` is -1: tracks do not end at observations.
        """
        config = self._config.klt
        if prior is not None:
            result = self._register_from(prior, reference, current, config.n_levels)
            if isinstance(result, RelativePose):
                return result
        start = np.eye(4) if prior is None else prior
        rough = self._register_from(start, reference, current, config.n_wide_levels)
        if isinstance(rough, Failure):
            return rough
        return self._register_from(rough.T_reference_current, reference, current, config.n_levels)

    def _register_from(
        self,
        T_reference_current: FloatArray,
        reference: KltObservations,
        current: KltObservations,
        n_levels: int,
    ) -> RelativePose | Failure:
        """Track from the pixels that a motion predicts, measure in 3-D, register."""
        predicted, indices = self._predict(T_reference_current, reference)
        pixels, is_tracked = track_pixels(
            (reference.image, current.image),
            reference.keypoints[indices],
            predicted[:, :2],
            self._config.klt,
            n_levels=n_levels,
        )
        pixels, predicted, indices = pixels[is_tracked], predicted[is_tracked], indices[is_tracked]
        if isinstance(current.frame, StereoFrame):
            disparities, is_valid = self._measure_stereo(
                current.frame, pixels, predicted[:, 2], self._config.stereo.search_radius_px
            )
        else:
            disparities, is_valid = self._measure_depth(current.frame, pixels)
        uvd = np.column_stack([pixels, disparities])[is_valid]
        return self._register_tracks(reference, current, indices[is_valid], uvd)

    def _predict(
        self, T_reference_current: FloatArray, reference: KltObservations
    ) -> tuple[FloatArray, IntArray]:
        """Return (u, v, disparity) of the reference's points in view of the current camera."""
        points = se3.transform_points(se3.invert(T_reference_current), reference.points_cam)
        in_front = np.flatnonzero(points[:, 2] > _MIN_DEPTH_M)
        uvd = self.camera.project_stereo(points[in_front])
        limits = np.array([self.camera.width, self.camera.height]) - 1
        is_in_view = np.all((uvd[:, :2] >= 0) & (uvd[:, :2] <= limits), axis=1)
        return uvd[is_in_view], in_front[is_in_view]

    def _register_tracks(
        self,
        reference: KltObservations,
        current: KltObservations,
        indices: IntArray,
        uvd: FloatArray,
    ) -> RelativePose | Failure:
        sigmas = self._sigmas(current.frame)
        correspondences = Correspondences(
            source_points=reference.points_cam[indices],
            target_points=self.camera.unproject_stereo(uvd[:, :2], uvd[:, 2]),
            source_uvd=np.column_stack([reference.keypoints, reference.disparities])[indices],
            target_uvd=uvd,
            # A corner is where it was cut out: only the track into the current frame is noisy.
            source_sigmas=np.tile(sigmas * [0.0, 0.0, 1.0], (len(uvd), 1)),
            target_sigmas=np.tile(sigmas, (len(uvd), 1)),
        )
        result = register_correspondences(
            correspondences,
            np.column_stack([indices, np.full_like(indices, -1)]),
            self.camera,
            self._config,
            stamps_ns=(reference.stamp_ns, current.stamp_ns),
        )
        if isinstance(result, Failure):
            return result
        factor = self._config.klt.sigma_factor
        return replace(result, covariance=factor**2 * result.covariance)

    def _sigmas(self, frame: Frame) -> FloatArray:
        """Return the standard deviations of (u, v, disparity) of a track, pixels."""
        config = self._config
        is_stereo = isinstance(frame, StereoFrame)
        disparity = config.klt.disparity_sigma_px if is_stereo else config.depth.sigma_px
        return np.array([config.klt.pixel_sigma_px, config.klt.pixel_sigma_px, disparity])

    def _search_stereo(
        self, frame: StereoFrame, corners: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        farthest = float(self.camera.depth_to_disparity(self._config.stereo.min_depth_m))
        rough, is_found = search_disparities((frame.left, frame.right), corners, farthest)
        disparities, is_valid = self._measure_stereo(frame, corners, rough, COARSE_ERROR_PX)
        return disparities, is_valid & is_found

    def _measure_stereo(
        self, frame: StereoFrame, pixels: FloatArray, predicted: FloatArray, reach_px: int
    ) -> tuple[FloatArray, BoolArray]:
        config = self._config.stereo
        disparities, is_valid = measure_disparities(
            (frame.left, frame.right), pixels, predicted, config, reach_px=reach_px
        )
        depths = self.camera.disparity_to_depth(np.where(disparities > 0, disparities, np.nan))
        with np.errstate(invalid="ignore"):
            is_valid &= (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
        return disparities, is_valid

    def _measure_depth(self, frame: RgbdFrame, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        depths, is_valid = sample_depth(frame.depth, pixels, self._config.depth)
        return self.camera.depth_to_disparity(np.where(is_valid, depths, np.nan)), is_valid


def _image_of(frame: Frame) -> ImageArray:
    return frame.left if isinstance(frame, StereoFrame) else frame.image
