"""Whether matches continue the usual motion that the result has been drawn away from.

What pulls off slowly before a camera takes the motion found along by less than a match's sigmas
per frame, and with it the prediction of the next one: when two motions can be told apart, the
last velocity already speaks for the wrong one. The velocity that was usual before does not. And
matches are often far better than their sigmas, those of a camera at rest above all: how well
they fit is measured here by themselves.
"""

from __future__ import annotations

import numpy as np

from gvo._trace import note
from gvo.config import Config
from gvo.frontend.verification import N_STEPS, NEARER, SIZEABLE, flow_px
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.refinement import Refinement, descend, refine_pose
from gvo.types import BoolArray, Failure, FloatArray

# The median of the squared length of three residuals of variance one, and what a recording of
# two copies of one image is not trusted below.
_MEDIAN_SQUARED = 2.366
_MIN_SCALE = 0.1
# Noise as large as stated, or nearly: what is to be seen of a second motion, the gate shows.
_MAX_SCALE = 2.0 / 3.0
# Motions nearer to each other, in pixels of the median point, need not be told apart yet.
_APART_PX = 0.3
# A residual that is shorter by a fifth speaks for a motion.
_BETTER = 0.8


def heed_usual_motion(
    found: Refinement,
    matches: Correspondences,
    camera: StereoCamera,
    config: Config,
    *,
    T_target_usual: FloatArray,
    with_offset: bool = False,
) -> Refinement:
    """Return the motion of the matches that continue the usual one, where the result left them.

    Parameters
    ----------
    found : Refinement
        As verified.
    matches : Correspondences
        All of them, n.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.
    T_target_usual : ndarray of float64, shape (4, 4)
        The motion at the usual velocity, metres.
    with_offset : bool
        As in `refine_pose`.

    Returns
    -------
    Refinement
        What was found, but where a tenth of the matches fit another motion alone, which is
        nearer to the usual one by a factor of two.
    """
    n_needed = max(config.ransac.min_inliers, SIZEABLE * len(matches))
    gate = config.registration.gate
    squared = found.residuals.squared(found.T_target_source)
    usually = found.residuals.squared(T_target_usual)
    seeds = usually < _BETTER**2 * squared
    if np.count_nonzero(seeds) < n_needed:
        return found
    # What fits either motion tells the noise.
    scale = np.sqrt(np.median(np.minimum(squared, usually)) / _MEDIAN_SQUARED)
    if scale > _MAX_SCALE:
        return found
    gate *= max(float(scale), _MIN_SCALE)
    misfits = squared >= gate**2
    other = _continue(found, T_target_usual, (seeds & misfits, misfits), gate, n_needed)
    if other is None or not _is_left(found, other[0], T_target_usual, matches, camera):
        return found
    second = refine_pose(
        *(other[0], matches, other[1], camera),
        config.registration.model_copy(update={"gate": gate}),
        with_offset=with_offset,
    )
    return found if isinstance(second, Failure) else second


def _continue(
    found: Refinement,
    T_target_usual: FloatArray,
    seeds_and_misfits: tuple[BoolArray, BoolArray],
    gate: float,
    n_needed: float,
) -> tuple[FloatArray, BoolArray] | None:
    """Return the motion near the usual one, and the matches that fit it alone; None where few."""
    seeds, misfits = seeds_and_misfits
    if np.count_nonzero(seeds) < n_needed:
        return None
    T_other = descend(T_target_usual, found.residuals.select(seeds), n_iterations=N_STEPS)
    if T_other is None:
        return None
    supporters = misfits & found.residuals.within(T_other, gate)
    note("registration.usual", T_target_source=T_other, supporters=supporters, gate=gate)
    return (T_other, supporters) if np.count_nonzero(supporters) >= n_needed else None


def _is_left(
    found: Refinement,
    T_other: FloatArray,
    T_target_usual: FloatArray,
    matches: Correspondences,
    camera: StereoCamera,
) -> bool:
    """Tell whether the result left the usual motion, and the other one did not."""
    T_found = found.T_target_source
    surprise_px = flow_px(T_found, T_target_usual, matches, camera)
    is_continued = NEARER * flow_px(T_other, T_target_usual, matches, camera) <= surprise_px
    return is_continued and flow_px(T_found, T_other, matches, camera) >= _APART_PX
