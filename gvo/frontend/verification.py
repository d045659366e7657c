"""Whether the motion that most matches agree on is that of the camera.

A registration with many inliers can still be wrong: a bus that passes before the camera, or what
a mirror shows, agrees with itself as well as the world does. But the world is still there beside
it, and a camera cannot change its motion at once. So where a second motion has a sizeable share
of the matches, the prediction decides between the two; and where it does not tell them apart, or
there is none, the answer is that the data have none.

What pulls off slowly before a camera takes the motion found along by less than a match's sigmas
per frame, and with it the prediction of the next one: when two motions can be told apart, the
last velocity already speaks for the wrong one. The velocity that was usual before does not. And
matches are often far better than their sigmas, those of a camera at rest above all: how well
they fit is measured here by themselves.

References
----------
P. Torr, "Geometric motion segmentation and model selection", Phil. Trans. R. Soc. A 356, 1998,
doi:10.1098/rsta.1998.0224.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gvo._trace import note
from gvo.config import Config
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import ransac_rigid
from gvo.geometry.refinement import Refinement, descend, refine_pose
from gvo.geometry.residuals import StereoResiduals
from gvo.types import BoolArray, Contradiction, Failure, FloatArray

# A second motion counts from such a share of all matches on: below, it is a car in the distance,
# or chance.
SIZEABLE = 0.1
# From such a ratio of the smaller to the larger group on neither is the world beyond doubt.
_DOUBTFUL = 0.4
# The prediction tells two motions apart where one is nearer by this factor; in between it would
# be its own error, not the motion, that decides.
NEARER = 2.0
# A misfit speaks for the prediction where its residual there is shorter by a fifth: where result
# and prediction are the same but for noise, as they mostly are, few do, and nothing is computed.
_BETTER = 0.8
N_STEPS = 1
# Nearer to each other than this, in pixels of the median point, the larger group will do: its error
# is smaller than that of a pose that is guessed.
_APART_PX = 1.0
_MIN_DEPTH_M = 0.1


def verify_motion(
    first: Refinement,
    matches: Correspondences,
    camera: StereoCamera,
    config: Config,
    *,
    T_target_predicted: FloatArray | None,
    make_rng: Callable[[], np.random.Generator],
    with_offset: bool = False,
) -> Refinement | Failure:
    """Return the motion of the camera where matches agree on two.

    Parameters
    ----------
    first : Refinement
        What most matches agree on.
    matches : Correspondences
        All of them, n.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.
    T_target_predicted : ndarray of float64, shape (4, 4), optional
        The motion expected, metres.
    make_rng : callable
        Returns the generator that draws samples where nothing is expected: making one takes longer
        than all the rest where the matches agree.
    with_offset : bool
        As in `refine_pose`.

    Returns
    -------
    Refinement or Failure
        The first motion, the second one, or a failure where nothing tells which one it is.
    """
    n_needed = max(config.ransac.min_inliers, SIZEABLE * len(matches))
    found = _find_other(first, matches, camera, config, T_target_predicted, make_rng, n_needed)
    if found is None:
        return first
    T_other, supporters = found
    refine = partial(
        refine_pose,
        matches=matches,
        camera=camera,
        config=config.registration,
        with_offset=with_offset,
    )
    second = refine(T_other, inliers=supporters)
    if isinstance(second, Failure):
        return first
    # Without the others' matches the first motion is no compromise any more.
    is_second = first.residuals.within(second.T_target_source, config.registration.gate)
    rest = first.inliers & ~is_second
    if np.count_nonzero(rest) >= n_needed:
        alone = refine(first.T_target_source, inliers=rest)
        first = first if isinstance(alone, Failure) else alone
    groups = [_group(each, matches, camera, config, T_target_predicted) for each in (first, second)]
    motions = [group.refined.T_target_source for group in groups]
    apart_px = flow_px(motions[0], motions[1], matches, camera)
    return _decide(groups[0], groups[1], apart_px=apart_px, n_needed=n_needed)


def _find_other(
    first: Refinement,
    matches: Correspondences,
    camera: StereoCamera,
    config: Config,
    T_target_predicted: FloatArray | None,
    make_rng: Callable[[], np.random.Generator],
    n_needed: float,
) -> tuple[FloatArray, BoolArray] | None:
    """Return a second motion, roughly, and the matches that fit it alone; None where few do."""
    residuals, gate = first.residuals, config.registration.gate
    squared = residuals.squared(first.T_target_source)
    misfits = squared >= gate**2
    if np.count_nonzero(misfits) < n_needed:
        return None
    if T_target_predicted is None:
        T_other = _by_samples(matches, misfits, camera, config, make_rng())
    else:
        T_other = _near_prediction(residuals, squared, misfits, T_target_predicted, n_needed)
    if T_other is None:
        return None
    supporters = misfits & residuals.within(T_other, gate)
    note("registration.other", T_target_source=T_other, supporters=supporters, n_needed=n_needed)
    return (T_other, supporters) if np.count_nonzero(supporters) >= n_needed else None


def _near_prediction(
    residuals: StereoResiduals,
    squared: FloatArray,
    misfits: BoolArray,
    T_target_predicted: FloatArray,
    n_needed: float,
) -> FloatArray | None:
    """Return where the misfits lead that fit the prediction better than the result."""
    seeds = misfits & (residuals.squared(T_target_predicted) < _BETTER**2 * squared)
    if np.count_nonzero(seeds) < n_needed:
        return None
    return descend(T_target_predicted, residuals.select(seeds), n_iterations=N_STEPS)


def _by_samples(
    matches: Correspondences,
    misfits: BoolArray,
    camera: StereoCamera,
    config: Config,
    rng: np.random.Generator,
) -> FloatArray | None:
    found = ransac_rigid(matches.select(misfits), camera, config.ransac, weights=None, rng=rng)
    return None if isinstance(found, Failure) else found.T_target_source


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Group:
    """A motion, the matches that fit it, and how far from the prediction it sees points."""

    refined: Refinement
    fitting: BoolArray
    surprise_px: float

    @property
    def n_fitting(self) -> int:
        return int(np.count_nonzero(self.fitting))


def _decide(
    first: _Group, second: _Group, *, apart_px: float, n_needed: float
) -> Refinement | Failure:
    """Return the motion that the prediction speaks for, or a failure where it does for none."""
    note(
        "registration.two_motions",
        n_fitting=(first.n_fitting, second.n_fitting),
        surprises_px=(first.surprise_px, second.surprise_px),
    )
    if np.count_nonzero(first.fitting & ~second.fitting) < n_needed:
        # What was found first was a compromise: hardly anything fits it alone.
        return max(second, first, key=lambda group: group.n_fitting).refined
    if second.surprise_px * NEARER < first.surprise_px:
        return second.refined
    if first.surprise_px * NEARER < second.surprise_px:
        return first.refined
    larger, smaller = sorted((first, second), key=lambda group: -group.n_fitting)
    if smaller.n_fitting < _DOUBTFUL * larger.n_fitting or apart_px < _APART_PX:
        return larger.refined
    expected = (
        "nothing was predicted"
        if np.isinf(larger.surprise_px)
        else f"{larger.surprise_px:.2g} and {smaller.surprise_px:.2g} px from the prediction"
    )
    return Contradiction(
        reason=f"two motions: {larger.n_fitting} matches fit one and {smaller.n_fitting} another, "
        + expected
    )


def _group(
    refined: Refinement,
    matches: Correspondences,
    camera: StereoCamera,
    config: Config,
    T_target_predicted: FloatArray | None,
) -> _Group:
    T = refined.T_target_source
    return _Group(
        refined=refined,
        fitting=refined.residuals.within(T, config.registration.gate),
        surprise_px=np.inf
        if T_target_predicted is None
        else flow_px(T, T_target_predicted, matches, camera),
    )


def flow_px(
    T_first: FloatArray, T_second: FloatArray, matches: Correspondences, camera: StereoCamera
) -> float:
    """Return how far apart two motions see the points, the median, pixels."""
    pixels = []
    for T in (T_first, T_second):
        points = matches.source_points @ T[:3, :3].T + T[:3, 3]
        points[:, 2] = np.maximum(points[:, 2], _MIN_DEPTH_M)
        pixels.append(camera.project(points))
    return float(np.median(np.hypot(*(pixels[0] - pixels[1]).T)))


# The median of the squared length of three residuals of variance one, and what a recording of
# two copies of one image is not trusted below.
_MEDIAN_SQUARED = 2.366
_MIN_SCALE = 0.1
# Noise as large as stated, or nearly: what is to be seen of a second motion, the gate shows.
_MAX_SCALE = 2.0 / 3.0
# Motions nearer to each other, in pixels of the median point, need not be told apart yet.
_APART_RECENT_PX = 0.3
# A residual that is shorter by a fifth speaks for a motion.
_BETTER_RECENT = 0.8


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
    seeds = usually < _BETTER_RECENT**2 * squared
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
    return is_continued and flow_px(T_found, T_other, matches, camera) >= _APART_RECENT_PX
