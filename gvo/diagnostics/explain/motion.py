"""How the frame was registered: the attempts repeated by the front-end's own functions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from gvo.config import Config
from gvo.diagnostics.explain.extraction import as_mask, distance_tests
from gvo.diagnostics.explain.values import Registration, Sorting
from gvo.frontend.descriptor import WIDE, DescriptorFrontend, is_step
from gvo.frontend.klt import KltFrontend
from gvo.frontend.matching import compare_within, predict_pixels
from gvo.frontend.registration import find_consensus
from gvo.frontend.rig import Measurements
from gvo.frontend.tracking import WINDOW_RADIUS_PX
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import StereoResiduals
from gvo.types import Contradiction, Failure, FloatArray, MotionPrior, RelativePose

OwnFrontend: TypeAlias = KltFrontend | DescriptorFrontend
"""The front-ends whose steps are known."""

_MIN_DEPTH_M = 1e-3


class Asked(NamedTuple):
    """Arguments and result of a registration."""

    reference: Any
    current: Any
    prior: MotionPrior | None
    result: RelativePose | Failure


# Where the search for points began, whether it was wide, what it found, and where in words.
_Attempt: TypeAlias = tuple[MotionPrior | None, bool, Measurements, str]
_BY_MOTION, _BY_DESCRIPTORS = "predicted pixels", "pixels that descriptors predict"


def explain_registration(frontend: OwnFrontend, asked: Asked, config: Config) -> Registration:
    """Repeat a registration step by step.

    The same arguments give the same result, so what is shown is what happened.
    """
    attempts = list(_attempts(frontend, asked, config))
    prior, is_wide, measured, _ = attempts[-1]
    start = prior
    if isinstance(frontend, KltFrontend):
        radius_px = float(WINDOW_RADIUS_PX)
        matches = _sort_tracks(frontend, asked, attempts[-1])
        start = None if is_wide else prior
    else:
        radius_px = (WIDE if is_wide else 1.0) * config.temporal.radius_px
        matches = _sort_descriptors(frontend, asked, attempts[-1], radius_px, config)
    return Registration(
        attempts=tuple(_describe(attempts, asked.result)),
        matches=matches,
        radius_px=radius_px,
        is_predicted=prior is not None and not np.array_equal(prior.T_predicted, np.eye(4)),
        **_find_motion(frontend, measured, start, asked.result, config),
    )


def _attempts(frontend: OwnFrontend, asked: Asked, config: Config) -> Iterator[_Attempt]:
    """Yield the attempts of a front-end, up to the one that found the result's pixels."""
    given = asked.reference, asked.current
    ways = [(asked.prior, True)]
    if asked.prior is not None:
        ways.insert(0, (asked.prior, False))
    for prior, is_wide in ways:
        measured = frontend.measure(*given, prior, is_wide=is_wide)
        yield prior, is_wide, measured, "previous pixels" if prior is None else _BY_MOTION
        if _is_end(measured, asked.result):
            return
    if not isinstance(frontend, KltFrontend):
        return  # its wide search is the last one
    rough = frontend.calibrated.register(measured, config, prior=None, is_step=True)
    place = _BY_MOTION
    if asked.prior is None and not isinstance(rough, RelativePose | Contradiction):
        rough = frontend.register_places(*map(frontend.describe, given))
        place = _BY_DESCRIPTORS
    if isinstance(rough, RelativePose):
        found = MotionPrior(T_predicted=rough.T_reference_current)
        yield found, False, frontend.measure(*given, found, is_wide=False), place


def _describe(attempts: list[_Attempt], result: RelativePose | Failure) -> Iterator[str]:
    """Yield how each attempt searched, and what came of it."""
    for number, (_, is_wide, _, place) in enumerate(attempts, start=1):
        if number < len(attempts):
            is_start = is_wide and attempts[number][3] == _BY_MOTION
            answer = "its motion predicts the next attempt" if is_start else "not registered"
        elif isinstance(result, Failure):
            answer = result.reason
        else:
            answer = f"registered, {result.n_inliers} inliers of {result.n_matches} matches"
        yield f"{'wide' if is_wide else 'near'} search around the {place}: {answer}"


def _is_end(measured: Measurements, result: RelativePose | Failure) -> bool:
    if isinstance(result, Failure):
        return isinstance(result, Contradiction)
    return np.array_equal(measured.uvd[1][:, :2], result.pixels_current)


def _sort_tracks(frontend: KltFrontend, asked: Asked, attempt: _Attempt) -> Sorting:
    prior, is_wide, measured, _ = attempt
    T = np.eye(4) if prior is None else prior.T_predicted
    expected = frontend.predict(T, asked.reference, asked.current)
    search: Literal["wide", "near"] = "wide" if is_wide else "near"
    pixels, is_tracked = frontend.find_tracks(asked.reference, asked.current, expected, search)
    n = len(asked.reference)
    tracked = expected.indices[is_tracked]
    found, predicted = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    found[tracked], predicted[expected.indices] = pixels[is_tracked], expected.uvd[:, :2]
    tests = {
        "out of view": as_mask(expected.indices, n),
        "track lost": as_mask(tracked, n),
        "no disparity or depth": as_mask(measured.matches[:, 0], n),
    }
    keypoints = asked.reference.keypoints
    return Sorting(tests=tests, pixels=keypoints, partners=found, predicted=predicted)


def _sort_descriptors(
    frontend: OwnFrontend, asked: Asked, attempt: _Attempt, radius_px: float, config: Config
) -> Sorting:
    prior, _, measured, _ = attempt
    reference, current, matches = asked.reference, asked.current, measured.matches
    T = None if prior is None else prior.T_predicted
    expected = predict_pixels(reference, T, frontend.camera)
    tried = compare_within(reference, current, expected, radius_px)
    n, limits = len(reference), config.temporal
    found, predicted = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    found[matches[:, 0]] = current.keypoints[matches[:, 1]]
    predicted[expected[1]] = expected[0]
    tests = {
        "behind the camera": as_mask(expected[1], n),
        "none within the radius": as_mask(tried[0][:, 0], n),
        **distance_tests(*tried, n, max_distance=limits.max_distance, max_ratio=limits.max_ratio),
        "reciprocity": as_mask(matches[:, 0], n),
    }
    return Sorting(tests=tests, pixels=reference.keypoints, partners=found, predicted=predicted)


def _find_motion(
    frontend: OwnFrontend,
    measured: Measurements,
    prior: MotionPrior | None,
    result: RelativePose | Failure,
    config: Config,
) -> dict[str, Any]:
    """Return the consensus of the matches, and their residuals before and after."""
    camera = frontend.camera
    step = isinstance(frontend, KltFrontend) or is_step(prior)
    T_start = frontend.calibrated.begin(measured, config, prior=prior, is_step=step)
    matches = frontend.calibrated.prepare(measured, T_start)
    if T_start is None and prior is not None:
        T_start = prior.T_predicted
    stamps_ns = measured.frames[0].stamp_ns, measured.frames[1].stamp_ns
    consensus = find_consensus(matches, camera, config, stamps_ns, T_start)
    moved = np.abs(matches.current_uvd - frontend.rig_offsets.take_off(measured.uvd[1]))
    motion: dict[str, Any] = {"row_motion_px": float(moved.max(initial=0.0))}
    if isinstance(consensus, Failure):
        return motion | {"inliers": np.zeros(len(matches), np.bool_)}
    motion["n_consensus"] = int(np.count_nonzero(consensus.inliers))
    motion["is_known"] = consensus.T_reference_current is T_start
    if isinstance(result, Failure):
        return motion | {"inliers": consensus.inliers}
    ends = consensus.T_reference_current, result.T_reference_current
    residuals_px = np.stack([_residuals(T, matches, camera) for T in ends])
    known = StereoResiduals.of(ends[0], matches, camera)
    lower = np.zeros((len(matches), 3, 3))
    lower[:, *np.tril_indices(3)] = known.factors
    return motion | {
        "inliers": result.inliers,
        "residuals_px": residuals_px,
        "whitened": np.einsum("nij,knj->kni", lower, residuals_px),
    }


def _residuals(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    points = se3.transform_points(se3.invert(T), matches.reference_points)
    points[points[:, 2] < _MIN_DEPTH_M] = np.nan
    return np.asarray(matches.current_uvd - camera.project_stereo(points))
