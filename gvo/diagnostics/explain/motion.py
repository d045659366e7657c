"""From matches to a motion: which agree, and what the refinement changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gvo._trace import Event, watched
from gvo.config import Config
from gvo.diagnostics.explain.attempts import Attempt
from gvo.diagnostics.explain.extraction import find_event
from gvo.diagnostics.explain.values import ConsensusStep, RefinementStep, SampleSearch
from gvo.frontend.registration import search_consensus
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus
from gvo.geometry.refinement import Refinement
from gvo.geometry.residuals import StereoResiduals, whiten_in_place
from gvo.types import Failure, FloatArray

_MIN_DEPTH_M = 1e-3


def explain_consensus(
    attempt: Attempt, camera: StereoCamera, config: Config
) -> ConsensusStep | None:
    """Return which matches agree; None where it did not come to that."""
    begin, done = attempt.find("registration.begin"), attempt.find("registration.consensus")
    if begin is None or done is None:
        return None
    matches: Correspondences = begin.values["correspondences"]
    consensus: Consensus | Failure = done.values["consensus"]
    is_known = bool(done.values["is_known"])
    events, found = attempt.events, consensus
    if is_known:
        with watched() as events:
            found = search_consensus(matches, camera, config, begin.values["stamps_ns"])
    known = attempt.find("registration.known")
    return ConsensusStep(
        pixels_reference=matches.source_uvd[:, :2],
        pixels_current=matches.target_uvd[:, :2],
        is_known=is_known,
        n_agreeing=None if known is None else int(np.count_nonzero(known.values["inliers"])),
        n_needed=0.0 if known is None else float(known.values["n_needed"]),
        inliers=None if isinstance(consensus, Failure) else consensus.inliers,
        search=_search(events, found),
    )


def _search(events: Sequence[Event], found: Consensus | Failure) -> SampleSearch:
    drawn = find_event(list(events), "ransac.samples")
    blocks = [event.values for event in events if event.name == "ransac.block"]
    return SampleSearch(
        counts=_counts(blocks),
        n_planned=0 if drawn is None else len(drawn.values["samples"]),
        share=float(blocks[-1]["share"]) if blocks else 0.0,
        n_near=0 if drawn is None else len(drawn.values["near"]),
        inliers=None if isinstance(found, Failure) else found.inliers,
        reason=found.reason if isinstance(found, Failure) else "",
    )


def _counts(blocks: Sequence[Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Return the inliers by sample; -1 where three points lie on a line."""
    n_drawn = max((block["n_before"] + len(block["is_valid"]) for block in blocks), default=0)
    counts = np.full(n_drawn, -1, dtype=np.int64)
    for block in blocks:
        counts[block["n_before"] + np.flatnonzero(block["is_valid"])] = block["counts"]
    return counts


def explain_refinement(
    attempt: Attempt, camera: StereoCamera, config: Config
) -> RefinementStep | None:
    """Return the residuals before and after; None where there was no refinement."""
    names = ("registration.begin", "registration.consensus", "refinement.begin")
    begin, done, opened = (attempt.find(name) for name in names)
    last = attempt.find("registration.refined")
    if begin is None or done is None or opened is None or last is None:
        return None
    consensus, refined = done.values["consensus"], last.values["refined"]
    if not isinstance(refined, Refinement):
        return None
    gated = attempt.find("refinement.gated")
    start = consensus.T_target_source
    between = start if gated is None else gated.values["T_target_source"]
    residuals: StereoResiduals = opened.values["residuals"]
    matches: Correspondences = begin.values["correspondences"]
    ends = [_residuals(T, matches, camera) for T in (start, refined.T_target_source)]
    return RefinementStep(
        T_target_source=np.stack([start, between, refined.T_target_source]),
        residuals_px=np.stack(ends),
        whitened=np.stack([_whiten(each, residuals) for each in ends]),
        gate=config.registration.gate,
        inliers=np.stack([consensus.inliers, refined.inliers]),
        n_within=None
        if gated is None
        else int(np.count_nonzero(residuals.within(between, config.registration.gate))),
        n_steps=len(attempt.all("refinement.step")),
        scale=refined.scale,
        correspondences=matches,
    )


def _residuals(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    """Return (u, v, disparity) measured less predicted, shape (n, 3); NaN behind the camera."""
    points = se3.transform_points(T, matches.source_points)
    points[points[:, 2] < _MIN_DEPTH_M] = np.nan
    return np.asarray(matches.target_uvd - camera.project_stereo(points))


def _whiten(residuals_px: FloatArray, residuals: StereoResiduals) -> FloatArray:
    rows = residuals_px.T.copy()
    whiten_in_place(residuals.columns[6:12], rows)
    return np.ascontiguousarray(rows.T)
