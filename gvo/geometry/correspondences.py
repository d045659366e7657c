"""3D-3D correspondences: points seen in two frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gvo.geometry.camera import StereoCamera
from gvo.types import BoolArray, FloatArray, IntArray, Observations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """Points in two frames with their measurements in each.

    Parameters
    ----------
    source_points, target_points : ndarray of float64, shape (n, 3)
        The same points in the camera frames of source and target, metres.
    source_uvd, target_uvd : ndarray of float64, shape (n, 3)
        Pixel and disparity measured in either frame, pixels.
    source_sigmas, target_sigmas : ndarray of float64, shape (n, 3)
        Standard deviations of these, pixels.
    sensitivities : mapping of str to ndarray of float64, shape (2, n, 3)
        Derivatives of the measurements in source and target by the errors of constants of the
        camera that a registration is to estimate, by name; in units of their present sigmas.
    """

    source_points: FloatArray
    target_points: FloatArray
    source_uvd: FloatArray
    target_uvd: FloatArray
    source_sigmas: FloatArray
    target_sigmas: FloatArray
    sensitivities: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.source_points)

    @classmethod
    def of(cls, source: Observations, target: Observations, matches: IntArray) -> Correspondences:
        """Gather matched observations of two frames; matches (n, 2) are pairs of indices."""
        i, j = matches.T
        return cls(
            source_points=source.points_cam[i],
            target_points=target.points_cam[j],
            source_uvd=np.column_stack([source.keypoints[i], source.disparities[i]]),
            target_uvd=np.column_stack([target.keypoints[j], target.disparities[j]]),
            source_sigmas=source.sigmas[i],
            target_sigmas=target.sigmas[j],
        )

    @classmethod
    def of_pixels(
        cls,
        uvd: tuple[FloatArray, FloatArray],
        sigmas: tuple[FloatArray, FloatArray],
        camera: StereoCamera,
    ) -> Correspondences:
        """Back-project measurements (n, 3) in source and target, with their sigmas (n, 3)."""
        source_points, target_points = (
            camera.unproject_stereo(each[:, :2], each[:, 2]) for each in uvd
        )
        return cls(
            source_points=source_points,
            target_points=target_points,
            source_uvd=uvd[0],
            target_uvd=uvd[1],
            source_sigmas=sigmas[0],
            target_sigmas=sigmas[1],
        )

    def without_offset(self, offset_px: float, camera: StereoCamera) -> Correspondences:
        """Subtract a constant offset from all disparities, and back-project again."""
        if offset_px == 0.0:
            return self
        offset = np.array([0.0, 0.0, offset_px])
        uvd = self.source_uvd - offset, self.target_uvd - offset
        return Correspondences.of_pixels(uvd, (self.source_sigmas, self.target_sigmas), camera)

    def select(self, chosen: BoolArray | IntArray) -> Correspondences:
        """Return some of the correspondences."""
        return Correspondences(
            source_points=self.source_points[chosen],
            target_points=self.target_points[chosen],
            source_uvd=self.source_uvd[chosen],
            target_uvd=self.target_uvd[chosen],
            source_sigmas=self.source_sigmas[chosen],
            target_sigmas=self.target_sigmas[chosen],
            sensitivities={name: each[:, chosen] for name, each in self.sensitivities.items()},
        )
