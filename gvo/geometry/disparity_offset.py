"""What the matches of one registration tell of a constant offset of a rig's disparities.

Where every disparity is too large by the same amount, in both frames, near and far points
disagree about the motion: so the offset is a seventh parameter beside the pose. It is eliminated
after the fact, by one step of least squares from the pose that assumes it is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from gvo.geometry.camera import StereoCamera
from gvo.geometry.residuals import Linearization, source_jacobian, whiten_in_place
from gvo.types import FloatArray

# Information on the offset, as a share of what target disparities would tell of it if nothing else
# explained them: below, it is rounding.
_MIN_SHARE = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class DisparityOffset:
    """By how much disparities are measured too large.

    Parameters
    ----------
    offset_px, sigma_px : float
        Estimate and standard deviation, pixels.
    """

    offset_px: float
    sigma_px: float


def estimate_disparity_offset(
    T_target_source: FloatArray, source_points: FloatArray, at: Linearization, camera: StereoCamera
) -> DisparityOffset | None:
    """Estimate a constant offset of the disparities of both frames.

    The sigma comes from the spread that the matches show, not from the one their sigmas promise.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        The refined pose.
    source_points : ndarray of float64, shape (3, n)
        Points in the source frame, metres.
    at : Linearization
        Of the residuals, at the refined pose.
    camera : StereoCamera
        Of both frames.

    Returns
    -------
    DisparityOffset or None
        None where an offset changes no residual, as for a camera at rest, or acts as a motion.
    """
    # An offset moves the measurement in the target by itself, the prediction by the source's.
    J_offset = -source_jacobian(T_target_source, source_points, camera)[2]
    J_offset[2] += 1.0
    whiten_in_place(at.factors, J_offset)
    flat = J_offset.ravel()
    h_pose_offset = at.J.reshape(6, -1) @ flat
    _, motion, info = dposv(at.H, h_pose_offset)
    # Of the offset, what no motion explains (Schur complement).
    information = float(flat @ flat - h_pose_offset @ motion)
    if info != 0 or not information > _MIN_SHARE * np.sum(at.factors[5] ** 2):
        return None
    scores = np.einsum("in,in->n", J_offset, at.r) - motion @ at.scores()
    return DisparityOffset(
        offset_px=float(np.sum(scores)) / information,
        sigma_px=float(np.sqrt(scores @ scores)) / information,
    )
