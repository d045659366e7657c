"""Whether the motion that most matches agree on is that of the camera.

A registration with many inliers can still be wrong: a bus that passes before the camera, or what
a mirror shows, agrees with itself as well as the world does. But the world is still there beside
it, and a camera cannot change its motion at once. So where a second motion has a sizeable share
of the matches, the prediction decides between the two; and where it does not tell them apart, or
there is none, the registration fails.

What passes slowly before a camera biases the motion found by less than a match's sigmas per
frame, and with it the prediction of the next one: when two motions can be told apart, the last
velocity already speaks for the wrong one. The recent median velocity does not. And matches are
often far better than their sigmas, those of a camera at rest above all: how well they fit is
measured here by themselves.

References
----------
P. Torr, "Geometric motion segmentation and model selection", Phil. Trans. R. Soc. A 356, 1998,
doi:10.1098/rsta.1998.0224.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np

from gvo.config import Config
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import ransac_rigid
from gvo.geometry.refinement import GATE, Refinement, descend, refine_pose
from gvo.types import BoolArray, Contradiction, Failure, FloatArray, MotionPrior

# Smallest share of the matches that makes a second motion: below, it is a car in the distance, or
# chance.
_SIZEABLE = 0.1
# From such a ratio of the smaller to the larger group on neither is the world beyond doubt.
_DOUBTFUL = 0.4
# A prediction tells two motions apart where one is nearer by this factor; in between its own error
# would decide.
_NEARER = 2.0
# A match speaks for another motion where its residual there is shorter by a fifth.
_BETTER = 0.8
_N_STEPS = 1
# Motions nearer to each other than this, in pixels of the median point, are not told apart: the
# error of the larger group is smaller than that of a predicted pose.
_APART_PX = 0.3
_APART_UNPREDICTED_PX = 1.0
_MIN_DEPTH_M = 0.1
# The median of the squared length of three residuals of variance one, and the smallest scale of
# the noise: a recording may hold two copies of one image.
_MEDIAN_SQUARED = 2.366
_MIN_SCALE = 0.1
# Noise as large as stated, or nearly: the gate alone separates the motions.
_MAX_SCALE = 2.0 / 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """The matches that motions are fitted to."""

    matches: Correspondences
    camera: StereoCamera
    config: Config

    @property
    def n_needed(self) -> float:
        """The number of matches that make a motion."""
        return max(self.config.ransac.min_inliers, _SIZEABLE * len(self.matches))

    def refine(
        self, T: FloatArray, inliers: BoolArray, *, gate: float = GATE
    ) -> Refinement | Failure:
        return refine_pose(T, self.matches, inliers, self.camera, gate=gate)

    def distance_px(self, T_first: FloatArray, T_second: FloatArray) -> float:
        """Return the median distance of the points as two motions project them."""
        pixels = []
        for T in (T_first, T_second):
            points = (self.matches.reference_points - T[:3, 3]) @ T[:3, :3]
            points[:, 2] = np.maximum(points[:, 2], _MIN_DEPTH_M)
            pixels.append(self.camera.project(points))
        return float(median(np.hypot(*(pixels[0] - pixels[1]).T).tolist()))


def verify_motion(
    found: Refinement,
    matches: Correspondences,
    camera: StereoCamera,
    config: Config,
    *,
    prior: MotionPrior | None,
    make_rng: Callable[[], np.random.Generator],
) -> Refinement | Failure:
    """Return the motion of the camera where matches agree on two.

    Parameters
    ----------
    found : Refinement
        What most matches agree on.
    matches : Correspondences
        All of them, n.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.
    prior : MotionPrior or None
    make_rng : callable
        Returns the generator for the samples where there is no prior; making one is slow.

    Returns
    -------
    Refinement or Failure
        The motion found, or the second one; a failure where nothing tells which one it is.
    """
    problem = _Problem(matches=matches, camera=camera, config=config)
    T_predicted = None if prior is None else prior.T_predicted
    verified = _prefer_predicted_motion(found, problem, T_predicted, make_rng)
    if isinstance(verified, Failure) or prior is None or prior.T_recent is None:
        return verified
    return _prefer_recent_motion(verified, problem, prior.T_recent)


def _prefer_predicted_motion(
    first: Refinement,
    problem: _Problem,
    T_predicted: FloatArray | None,
    make_rng: Callable[[], np.random.Generator],
) -> Refinement | Failure:
    """Return the motion that the prediction speaks for, where there are two."""
    other = _find_other(first, problem, T_predicted, make_rng)
    second = None if other is None else problem.refine(*other)
    if second is None or isinstance(second, Failure):
        return first
    # Without the others' matches the first motion is no compromise any more.
    is_second = first.residuals.within(second.T_reference_current, GATE)
    rest = first.inliers & ~is_second
    if np.count_nonzero(rest) >= problem.n_needed:
        alone = problem.refine(first.T_reference_current, rest)
        first = first if isinstance(alone, Failure) else alone
    return _decide(
        _group(first, problem, T_predicted),
        _group(second, problem, T_predicted),
        apart_px=problem.distance_px(first.T_reference_current, second.T_reference_current),
        n_needed=problem.n_needed,
    )


def _find_other(
    first: Refinement,
    problem: _Problem,
    T_predicted: FloatArray | None,
    make_rng: Callable[[], np.random.Generator],
) -> tuple[FloatArray, BoolArray] | None:
    """Return a second motion, roughly, and the matches that fit it alone; None where few do."""
    residuals, n_needed = first.residuals, problem.n_needed
    squared = residuals.squared(first.T_reference_current)
    misfits = squared >= GATE**2
    if np.count_nonzero(misfits) < n_needed:
        return None
    if T_predicted is None:
        T_other = _sample_motion(problem, misfits, make_rng())
    else:
        seeds = misfits & (residuals.squared(T_predicted) < _BETTER**2 * squared)
        T_other = _descend(first, T_predicted, seeds, n_needed)
    if T_other is None:
        return None
    supporters = misfits & residuals.within(T_other, GATE)
    return (T_other, supporters) if np.count_nonzero(supporters) >= n_needed else None


def _descend(
    found: Refinement, T_start: FloatArray, seeds: BoolArray, n_needed: float
) -> FloatArray | None:
    """Return the motion of the matches that fit a start better than what was found."""
    if np.count_nonzero(seeds) < n_needed:
        return None
    return descend(T_start, found.residuals, seeds, n_iterations=_N_STEPS)


def _sample_motion(
    problem: _Problem, misfits: BoolArray, rng: np.random.Generator
) -> FloatArray | None:
    matches, ransac = problem.matches.select(misfits), problem.config.ransac
    found = ransac_rigid(matches, problem.camera, ransac, weights=None, rng=rng)
    return None if isinstance(found, Failure) else found.T_reference_current


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Group:
    """A motion, the matches that fit it, and its distance from the prediction in the image."""

    refined: Refinement
    fitting: BoolArray
    surprise_px: float

    @property
    def n_fitting(self) -> int:
        return int(np.count_nonzero(self.fitting))


def _group(refined: Refinement, problem: _Problem, T_predicted: FloatArray | None) -> _Group:
    T = refined.T_reference_current
    return _Group(
        refined=refined,
        fitting=refined.residuals.within(T, GATE),
        surprise_px=np.inf if T_predicted is None else problem.distance_px(T, T_predicted),
    )


def _decide(
    first: _Group, second: _Group, *, apart_px: float, n_needed: float
) -> Refinement | Failure:
    """Return the motion that the prediction speaks for, or a failure where it does for none."""
    if np.count_nonzero(first.fitting & ~second.fitting) < n_needed:
        # What was found first was a compromise: hardly anything fits it alone.
        return max(second, first, key=lambda group: group.n_fitting).refined
    if second.surprise_px * _NEARER < first.surprise_px:
        return second.refined
    if first.surprise_px * _NEARER < second.surprise_px:
        return first.refined
    larger, smaller = sorted((first, second), key=lambda group: -group.n_fitting)
    if smaller.n_fitting < _DOUBTFUL * larger.n_fitting or apart_px < _APART_UNPREDICTED_PX:
        return larger.refined
    return _contradict(larger, smaller)


def _contradict(larger: _Group, smaller: _Group) -> Contradiction:
    expected = (
        "nothing was predicted"
        if np.isinf(larger.surprise_px)
        else f"{larger.surprise_px:.2g} and {smaller.surprise_px:.2g} px from the prediction"
    )
    return Contradiction(
        reason=f"two motions: {larger.n_fitting} matches fit one and {smaller.n_fitting} another, "
        + expected
    )


def _prefer_recent_motion(found: Refinement, problem: _Problem, T_recent: FloatArray) -> Refinement:
    """Return the motion of the matches that continue the recent median motion.

    Only where the motion found left it: a tenth of the matches must fit another motion alone,
    which is nearer to the recent one by a factor of two.
    """
    squared = found.residuals.squared(found.T_reference_current)
    recently = found.residuals.squared(T_recent)
    seeds = recently < _BETTER**2 * squared
    if np.count_nonzero(seeds) < problem.n_needed:
        return found
    # The smaller residual of either motion shows the noise.
    scale = math.sqrt(median(np.minimum(squared, recently).tolist()) / _MEDIAN_SQUARED)
    if scale > _MAX_SCALE:
        return found
    gate = GATE * max(scale, _MIN_SCALE)
    misfits = squared >= gate**2
    T_other = _descend(found, T_recent, seeds & misfits, problem.n_needed)
    if T_other is None:
        return found
    supporters = misfits & found.residuals.within(T_other, gate)
    is_enough = np.count_nonzero(supporters) >= problem.n_needed
    if not (is_enough and _is_continued(T_other, found.T_reference_current, T_recent, problem)):
        return found
    second = problem.refine(T_other, supporters, gate=gate)
    return found if isinstance(second, Failure) else second


def _is_continued(
    T_other: FloatArray, T_found: FloatArray, T_recent: FloatArray, problem: _Problem
) -> bool:
    """Tell whether another motion continues the recent one, and the motion found does not."""
    surprise_px = problem.distance_px(T_found, T_recent)
    is_nearer = _NEARER * problem.distance_px(T_other, T_recent) <= surprise_px
    return is_nearer and problem.distance_px(T_found, T_other) >= _APART_PX
