"""Where the points of the reference were found in the current image."""

from __future__ import annotations

import numpy as np

from gvo.config import Config
from gvo.diagnostics.explain.attempts import Attempt
from gvo.diagnostics.explain.extraction import best_candidates, depth_tests, distance_tests, have
from gvo.diagnostics.explain.values import Sorting, TemporalStep
from gvo.frontend.rgbd import sample_depth
from gvo.types import BoolArray, FloatArray, Frame, IntArray, RgbdFrame


def explain_temporal(attempt: Attempt, frame: Frame, config: Config) -> TemporalStep:
    """Return the matches of an attempt and why the other points have none."""
    if attempt.is_of_tracks:
        return _explain_tracks(attempt, frame, config)
    return _explain_descriptors(attempt, config)


def _explain_tracks(attempt: Attempt, frame: Frame, config: Config) -> TemporalStep:
    values = attempt.start.values
    reference, indices = values["source_uvd"][:, :2], values["indices"]
    n, is_tracked = len(reference), values["is_tracked"]
    predicted, found = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    predicted[indices] = values["predicted"][:, :2]
    tracked = indices[is_tracked]
    found[tracked] = values["pixels"][is_tracked]
    tests = {"out of view": _mask(indices, n), "track lost": _mask(tracked, n)}
    for name, passes in _measured(attempt, frame, config).items():
        tests[name] = _mask(tracked[passes], n)
    return TemporalStep(
        method="tracks",
        is_wide=bool(values["is_wide"]),
        has_prior=not np.array_equal(values["prior"], np.eye(4)),
        radius_px=float(config.klt.window_radius_px),
        reference_pixels=reference,
        predicted=predicted,
        found=found,
        sorting=Sorting.by(tests, n),
    )


def _measured(attempt: Attempt, frame: Frame, config: Config) -> dict[str, BoolArray]:
    """Tell which tracks pass the tests of their measurement in 3-D, in order."""
    measured = attempt.find("klt.measured")
    if measured is None:
        return {}
    is_valid = measured.values["is_valid"]
    if isinstance(frame, RgbdFrame):
        depths, _ = sample_depth(frame.depth, measured.values["pixels"], config.depth)
        return depth_tests(depths, is_valid, config.depth)
    followed = attempt.find("klt.followed")
    if followed is None:
        return {"depth out of range": is_valid}
    return {
        "patch leaves an image": np.isfinite(followed.values["disparities"]),
        "no rest of the steps": followed.values["is_at_rest"],
        "depth out of range": is_valid,
    }


def _explain_descriptors(attempt: Attempt, config: Config) -> TemporalStep:
    values, temporal = attempt.start.values, config.temporal
    reference, current = values["pixels"]
    pixels, indices = values["predicted"]
    n = len(reference)
    predicted, found = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    predicted[indices] = pixels
    pairs, distances = _candidates(attempt)
    best = best_candidates(pairs, distances, n)
    found[best >= 0] = current[best[best >= 0]]
    matches = _matches(attempt)
    found[matches[:, 0]] = current[matches[:, 1]]
    tests = {
        "behind the camera": _mask(indices, n),
        "none within the radius": have(pairs, n),
        **distance_tests(
            pairs,
            distances,
            n,
            max_distance=temporal.max_distance,
            max_ratio=temporal.max_ratio,
        ),
        "reciprocity": have(matches, n),
    }
    return TemporalStep(
        method="descriptors",
        is_wide=values["radius_px"] == temporal.wide_radius_px,
        has_prior=values["prior"] is not None,
        radius_px=float(values["radius_px"]),
        reference_pixels=reference,
        predicted=predicted,
        found=found,
        sorting=Sorting.by(tests, n),
    )


def _candidates(attempt: Attempt) -> tuple[IntArray, FloatArray]:
    event = attempt.find("temporal.candidates")
    if event is None:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    return event.values["pairs"], event.values["distances"]


def _matches(attempt: Attempt) -> IntArray:
    event = attempt.find("registration.begin")
    return np.zeros((0, 2), np.int64) if event is None else event.values["matches"]


def _mask(indices: IntArray, n: int) -> BoolArray:
    mask = np.zeros(n, dtype=np.bool_)
    mask[indices] = True
    return mask
