"""A zoom from one frame to the next: the view grows or shrinks, as it does by no motion.

All rays turn away from the optical axis, or towards it, those of near points as those of far ones.
Points as the last step moves them on, and where they are seen, differ by a similarity then: its
scale is the zoom. A motion that is found in its place leads metres ahead within a frame, and all
that follow are registered by a focal length that is wrong.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import FloatArray

HARDEST_MPS2: Final = 30.0
"""No car brakes and no hand shakes a camera harder; raw steps of recordings reach 14 m/s^2."""
LONGEST_S: Final = 0.25
"""A longer step is not foretold by the one before, seconds."""
# Share of the tracks that a zoom moves, of so many at least, and how far they may be from its
# similarity, pixels. The smallest zoom that is told: without one similarities reach 1.2 %.
_MIN_SHARE, _MIN_TRACKS, _FITS_PX, _LEAST = 0.7, 30, 2.0, 0.03


def find_zoom(found: Correspondences, T: FloatArray, camera: StereoCamera) -> float | None:
    """Return the focal length of the current frame over that of the reference.

    Parameters
    ----------
    found : Correspondences
    T : ndarray of float64, shape (4, 4)
        T_reference_current by the step before: the one that was found is part of the fault.
    camera : StereoCamera

    Returns
    -------
    float or None
        None without a zoom.
    """
    if len(found) < _MIN_TRACKS:
        return None
    points = se3.transform_points(se3.invert(T), found.reference_points)
    expected, seen = camera.project(points), np.ascontiguousarray(found.current_uvd[:, :2])
    similarity, fits = cv2.estimateAffinePartial2D(expected, seen, ransacReprojThreshold=_FITS_PX)
    ratio = 1.0 if similarity is None else float(np.hypot(*similarity[:, 0]))
    return ratio if abs(ratio - 1.0) > _LEAST and np.mean(fits) > _MIN_SHARE else None
