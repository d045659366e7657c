"""What the matches of one registration tell of a constant offset of a rig's disparities.

Where every disparity is too large by the same amount, in both frames, near and far points
disagree about the motion: so the offset is a seventh parameter beside the pose. It is eliminated
after the fact, by one step of least squares from the pose that assumes it is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from gvo.geometry.residuals import (
    Linearization,
    StereoResiduals,
    pose_jacobian,
    source_jacobian,
    whiten_in_place,
)
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
    T_target_source: FloatArray, residuals: StereoResiduals, at: Linearization
) -> DisparityOffset | None:
    """Estimate a constant offset of the disparities of both frames.

    The derivatives are those at the points where both frames together see them. At the points as
    measured, noise of the source would be in the derivatives and in the residuals alike, and pull
    the estimate off zero by some hundredths of a pixel.

    The sigma comes from the spread that the matches show, not from the one their sigmas promise.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        The refined pose.
    residuals : StereoResiduals
        Of the matches it rests on.
    at : Linearization
        Of the residuals, at the refined pose.

    Returns
    -------
    DisparityOffset or None
        None where an offset acts as a motion does, as for points at one depth.
    """
    camera = residuals.camera
    source_points = residuals.settled_points(T_target_source, at)
    # An offset moves the measurement in the target by itself, the prediction by the source's.
    J_offset = -source_jacobian(T_target_source, source_points, camera)[2]
    J_offset[2] += 1.0
    target_points = T_target_source[:3, :3] @ source_points + T_target_source[:3, 3:]
    J = pose_jacobian(target_points, camera)
    for rows in (J_offset, J):
        whiten_in_place(at.factors, rows)
    flat, flat_pose = J_offset.ravel(), J.reshape(6, -1)
    h_pose_offset = flat_pose @ flat
    _, motion, info = dposv(flat_pose @ flat_pose.T, h_pose_offset)
    # Of the offset, what no motion explains (Schur complement).
    information = float(flat @ flat - h_pose_offset @ motion)
    if info != 0 or not information > _MIN_SHARE * np.sum(at.factors[5] ** 2):
        return None
    unexplained = J_offset - np.einsum("k,kin->in", motion, J)
    scores = np.einsum("in,in->n", unexplained, at.r)
    return DisparityOffset(
        offset_px=float(np.sum(scores)) / information,
        sigma_px=float(np.sqrt(scores @ scores)) / information,
    )
