"""Registration of frames that nothing is known of, to tell whether a place was seen before.

No prediction narrows the search, so that descriptors of the whole image are compared, and only
matches count that no other point of the image rivals.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.frontend.registration import register_correspondences
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import Failure, FloatArray, IntArray, Observations, RelativePose

# Best over second best distance of a match (D. Lowe, 2004, doi:10.1023/B:VISI.0000029664.99615.94).
_MAX_RATIO = 0.8
# Of the few matches that are left more may be wrong than between neighbouring frames.
_N_HYPOTHESES = 1000
# Chance finds few that agree; a place that is seen again has many, and most of them agree.
_MIN_INLIERS_FACTOR = 2
_MIN_INLIER_SHARE = 0.4
# Of the points that should be in view. In rendered streets of repeated facades, places that only
# look alike reach 0.16 and the same place, seen from 10 m behind, 0.26; in a room it has 0.45.
_MIN_SHARE_OF_VIEW = 0.25
_MIN_DEPTH_M = 1e-3


def match_anywhere(reference: Observations, current: Observations) -> IntArray:
    """Match descriptors wherever they are: ratio test, reciprocal.

    Parameters
    ----------
    reference, current : Observations

    Returns
    -------
    ndarray of int64, shape (m, 2)
        Indices into reference and current, each at most once.
    """
    first, second = reference.descriptors_left, current.descriptors_left
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    forth, back = _best(first, second), _best(second, first)
    indices = np.flatnonzero(forth >= 0)
    is_mutual = back[forth[indices]] == indices
    pairs = np.column_stack([indices, forth[indices]])
    return np.asarray(pairs[is_mutual])


def relocalize_observations(
    reference: Observations,
    current: Observations,
    camera: StereoCamera,
    config: Config,
    *,
    offset_px: float,
) -> RelativePose | Failure:
    """Estimate the motion between two frames that may be far apart in time and place.

    Parameters
    ----------
    reference, current : Observations
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`; more matches must agree than between neighbours.
    offset_px : float
        To be taken off all disparities.

    Returns
    -------
    RelativePose or Failure
    """
    matches = match_anywhere(reference, current)
    n_hypotheses = max(config.ransac.n_hypotheses, _N_HYPOTHESES)
    ransac = config.ransac.model_copy(update={"n_hypotheses": n_hypotheses})
    result = register_correspondences(
        Correspondences.of(reference, current, matches).without_offset(offset_px, camera),
        matches,
        camera,
        config.model_copy(update={"ransac": ransac}),
        stamps_ns=(reference.stamp_ns, current.stamp_ns),
    )
    if isinstance(result, Failure):
        return result
    n_needed = max(
        _MIN_INLIERS_FACTOR * config.ransac.min_inliers, _MIN_INLIER_SHARE * len(matches)
    )
    if result.n_inliers < n_needed:
        return Failure(
            reason=f"{result.n_inliers} of {len(matches)} matches agree, too few to know a place "
            f"again: {n_needed:.0f} are needed",
            n_matches=len(matches),
            n_inliers=result.n_inliers,
        )
    return result


def check_view(
    result: RelativePose | Failure, points_reference: FloatArray, camera: StereoCamera
) -> RelativePose | Failure:
    """Refuse a place that looks alike: most of what should be in view must be there.

    Facades, carpets and trees repeat: a part of the image then agrees with another place as well
    as with its own. What tells them apart is what else should be seen from there.

    Parameters
    ----------
    result : RelativePose or Failure
        By matches that were searched all over the view that it predicts.
    points_reference : ndarray of float64, shape (n, 3)
        Points of the reference, in its `cam` frame, metres.
    camera : StereoCamera

    Returns
    -------
    RelativePose or Failure
        The same where it is a failure, or stands.
    """
    if isinstance(result, Failure):
        return result
    T_current_reference = se3.invert(result.T_reference_current)
    points = se3.transform_points(T_current_reference, points_reference)
    points = points[points[:, 2] > _MIN_DEPTH_M]
    n_in_view = int(np.count_nonzero(camera.is_in_view(camera.project(points))))
    if result.n_inliers >= _MIN_SHARE_OF_VIEW * n_in_view:
        return result
    return Failure(
        reason=f"{result.n_inliers} of {n_in_view} points in view are seen again, "
        f"{_MIN_SHARE_OF_VIEW:.0%} are needed to know a place again",
        n_matches=result.n_matches,
        n_inliers=result.n_inliers,
    )


def _best(first: NDArray[Any], second: NDArray[Any]) -> IntArray:
    """Return for each descriptor the one that nothing rivals, shape (n,); -1: there is none."""
    norm = cv2.NORM_HAMMING if first.dtype == np.uint8 else cv2.NORM_L2
    nearest = cv2.BFMatcher(norm).knnMatch(first, second, k=2)
    best = np.array([pair[0].trainIdx for pair in nearest], dtype=np.int64)
    distances: FloatArray = np.array([[match.distance for match in pair] for pair in nearest])
    return np.where(distances[:, 0] <= _MAX_RATIO * distances[:, 1], best, -1)
