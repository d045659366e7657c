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
    reference_points, current_points : ndarray of float64, shape (n, 3)
        The same points in the camera frames of reference and current, metres.
    reference_uvd, current_uvd : ndarray of float64, shape (n, 3)
        Pixel and disparity measured in either frame, pixels.
    reference_sigmas, current_sigmas : ndarray of float64, shape (n, 3)
        Standard deviations of these, pixels.
    sensitivities : mapping of str to ndarray of float64, shape (2, n, 3)
        Derivatives of the measurements in reference and current frame by the errors of constants
        of the camera that a registration is to estimate, by name; in units of their sigmas.
    """

    reference_points: FloatArray
    current_points: FloatArray
    reference_uvd: FloatArray
    current_uvd: FloatArray
    reference_sigmas: FloatArray
    current_sigmas: FloatArray
    sensitivities: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.reference_points)

    @classmethod
    def of(
        cls, reference: Observations, current: Observations, matches: IntArray
    ) -> Correspondences:
        """Gather matched observations of two frames; matches (n, 2) are pairs of indices."""
        i, j = matches.T
        return cls(
            reference_points=reference.points_cam[i],
            current_points=current.points_cam[j],
            reference_uvd=np.column_stack([reference.keypoints[i], reference.disparities[i]]),
            current_uvd=np.column_stack([current.keypoints[j], current.disparities[j]]),
            reference_sigmas=reference.sigmas[i],
            current_sigmas=current.sigmas[j],
        )

    @classmethod
    def of_pixels(
        cls,
        uvd: tuple[FloatArray, FloatArray],
        sigmas: tuple[FloatArray, FloatArray],
        camera: StereoCamera,
    ) -> Correspondences:
        """Back-project measurements (n, 3) in reference and current, with their sigmas (n, 3)."""
        reference_points, current_points = (
            camera.unproject_stereo(each[:, :2], each[:, 2]) for each in uvd
        )
        return cls(
            reference_points=reference_points,
            current_points=current_points,
            reference_uvd=uvd[0],
            current_uvd=uvd[1],
            reference_sigmas=sigmas[0],
            current_sigmas=sigmas[1],
        )

    def select(self, chosen: BoolArray | IntArray) -> Correspondences:
        """Return some of the correspondences."""
        return Correspondences(
            reference_points=self.reference_points[chosen],
            current_points=self.current_points[chosen],
            reference_uvd=self.reference_uvd[chosen],
            current_uvd=self.current_uvd[chosen],
            reference_sigmas=self.reference_sigmas[chosen],
            current_sigmas=self.current_sigmas[chosen],
            sensitivities={name: each[:, chosen] for name, each in self.sensitivities.items()},
        )
