"""Points seen in two frames, as registration wants them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.types import BoolArray, FloatArray, IntArray, Observations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """3D-3D correspondences with what each frame measured of them.

    Parameters
    ----------
    source_points, target_points : ndarray of float64, shape (n, 3)
        The same points in the camera frames of source and target, metres.
    source_uvd, target_uvd : ndarray of float64, shape (n, 3)
        Pixel and disparity measured in either frame, pixels.
    source_sigmas, target_sigmas : ndarray of float64, shape (n, 3)
        Standard deviations of these, pixels.
    """

    source_points: FloatArray
    target_points: FloatArray
    source_uvd: FloatArray
    target_uvd: FloatArray
    source_sigmas: FloatArray
    target_sigmas: FloatArray

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.source_points)

    @classmethod
    def of(cls, source: Observations, target: Observations, matches: IntArray) -> Correspondences:
        """Gather the matched observations of two frames; matches (n, 2) are indices."""
        i, j = matches.T
        return cls(
            source_points=source.points_cam[i],
            target_points=target.points_cam[j],
            source_uvd=np.column_stack([source.keypoints[i], source.disparities[i]]),
            target_uvd=np.column_stack([target.keypoints[j], target.disparities[j]]),
            source_sigmas=source.sigmas[i],
            target_sigmas=target.sigmas[j],
        )

    def select(self, chosen: BoolArray | IntArray) -> Correspondences:
        """Return some of the correspondences."""
        return Correspondences(
            source_points=self.source_points[chosen],
            target_points=self.target_points[chosen],
            source_uvd=self.source_uvd[chosen],
            target_uvd=self.target_uvd[chosen],
            source_sigmas=self.source_sigmas[chosen],
            target_sigmas=self.target_sigmas[chosen],
        )
