"""Whether the depth of one frame, moved as registered, agrees with the depth of the other.

A few hundred corners decide a registration, but an RGB-D camera measures all of the surface. If
the camera moved as claimed, what the reference measured lies where the current frame measures
it, or is hidden. It cannot lie in front of what the current frame sees: there is free space.
"""

from __future__ import annotations

import numpy as np

from gvo._trace import note
from gvo.config import DepthConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.types import Contradiction, DepthArray, Failure, FloatArray, RelativePose

# Points along each side of the grid that is compared.
_N_GRID = 24
# In sigmas of the difference of two depths: beyond, it is no noise.
_GATE = 3.0
# Fewer points that both frames measure say nothing.
_MIN_POINTS = 100
# Edges, holes and what moves by itself contradict right motions too, but never most of the view.
_MIN_AGREEING = 0.5


def check_depths(
    result: RelativePose,
    depths: tuple[DepthArray, DepthArray],
    camera: StereoCamera,
    config: DepthConfig,
) -> RelativePose | Failure:
    """Refuse a motion of which the depth images see through most of the surface.

    Parameters
    ----------
    result : RelativePose
        From the reference to the current frame.
    depths : tuple of two ndarrays of float32, shape (height, width)
        Of the reference and of the current frame, metres, NaN where unknown.
    camera : StereoCamera
        The depth camera with its virtual baseline.
    config : DepthConfig
        Range and noise of the depth.

    Returns
    -------
    RelativePose or Failure
    """
    differences = compare_depths(depths, result.T_reference_current, camera, config)
    n_agreeing = int(np.count_nonzero(np.abs(differences) <= _GATE))
    # Nearer than expected is hidden, and says nothing; farther is seen through.
    n_pierced = int(np.count_nonzero(differences < -_GATE))
    n = n_agreeing + n_pierced
    note("registration.depths", n_agreeing=n_agreeing, n_pierced=n_pierced)
    if len(differences) < _MIN_POINTS or n_agreeing >= _MIN_AGREEING * n:
        return result
    return Contradiction(
        reason=f"depth contradicts the motion: {n_pierced} of {n} points of the reference lie in "
        "free space",
        n_matches=result.n_matches,
        n_inliers=result.n_inliers,
    )


def compare_depths(
    depths: tuple[DepthArray, DepthArray],
    T_reference_current: FloatArray,
    camera: StereoCamera,
    config: DepthConfig,
) -> FloatArray:
    """Return how a grid of the reference's points differs from the depth of the current frame.

    Parameters
    ----------
    depths : tuple of two ndarrays of float32, shape (height, width)
        Of the reference and of the current frame, metres, NaN where unknown.
    T_reference_current : ndarray of float64, shape (4, 4)
        The motion in question.
    camera : StereoCamera
        The depth camera with its virtual baseline.
    config : DepthConfig
        Range and noise of the depth.

    Returns
    -------
    ndarray of float64, shape (n,)
        Disparity measured less disparity expected, in sigmas, of the n points that both frames
        measure; negative where the current frame sees farther.
    """
    height, width = depths[0].shape
    rows = np.linspace(0.0, height - 1.0, _N_GRID).astype(np.int64)
    columns = np.linspace(0.0, width - 1.0, _N_GRID).astype(np.int64)
    grid = depths[0][np.ix_(rows, columns)].astype(np.float64)
    v, u = np.nonzero((grid >= config.min_depth_m) & (grid <= config.max_depth_m))
    pixels = np.column_stack([columns[u], rows[v]]).astype(np.float64)
    points = camera.unproject_stereo(pixels, camera.depth_to_disparity(grid[v, u]))
    points = se3.transform_points(se3.invert(T_reference_current), points)
    points = points[points[:, 2] > config.min_depth_m]
    expected = camera.project_stereo(points)
    seen = np.rint(expected[:, :2]).astype(np.int64)
    is_inside = np.all((seen >= 0) & (seen < [width, height]), axis=1)
    measured = depths[1][seen[is_inside, 1], seen[is_inside, 0]].astype(np.float64)
    is_known = (measured >= config.min_depth_m) & (measured <= config.max_depth_m)
    disparities = camera.depth_to_disparity(measured[is_known])
    sigma = np.sqrt(2.0) * config.sigma_px
    return np.asarray((disparities - expected[is_inside, 2][is_known]) / sigma)
