"""All numbers of an explanation, as JSON holds them."""

from __future__ import annotations

from typing import Any

import numpy as np

from gvo.diagnostics.explain.values import (
    ConsensusStep,
    FrameExplanation,
    KeyframeLink,
    RefinementStep,
    SampleSearch,
    Sorting,
    SubpixelStep,
    TemporalStep,
)
from gvo.types import Estimate, FloatArray, RelativePose


def explanation_json(explanation: FrameExplanation) -> dict[str, Any]:
    """Return the numbers and counts of an explanation as plain values.

    Steps that were not reached are null. Matrices are lists of rows.
    """
    result, stereo, depth = explanation.result, explanation.stereo, explanation.depth
    relative = result.registration
    return {
        "recording": explanation.recording,
        "frame": explanation.index,
        "stamp_ns": result.stamp_ns,
        "frontend": explanation.config.frontend.kind,
        "reference_frame": explanation.reference_index,
        "status": result.status.value,
        "reason": result.reason,
        "attempts": list(explanation.attempts),
        "rig_offset_px": explanation.offset_px,
        "rig_row_offset_px": explanation.row_offset_px,
        "keypoints": {
            "n_detected": len(explanation.keypoints.detected),
            "n_kept": len(explanation.keypoints.kept),
            "budget": explanation.keypoints.budget,
            "cell_size_px": explanation.keypoints.cell_size_px,
        },
        "stereo": None if stereo is None else _sorted(stereo.sorting),
        "depth": None if depth is None else _sorted(depth.sorting),
        "depth_pixels": None if depth is None else _sorted(depth.pixel_sorting),
        "subpixel": _subpixel(explanation.subpixel),
        "matches": _temporal(explanation.temporal),
        "consensus": _consensus(explanation.consensus),
        "refinement": _refinement(explanation.refinement),
        "relative_pose": None if relative is None else _relative(relative),
        "raw": _estimate(result.raw),
        "causal": _estimate(result.causal),
        "links": [_link(link) for link in explanation.links],
        "became_keyframe": explanation.became_keyframe,
        "configuration": explanation.config.model_dump(),
    }


def _sorted(sorting: Sorting) -> dict[str, Any]:
    return {"n": len(sorting), **sorting.counts()}


def _subpixel(step: SubpixelStep | None) -> dict[str, Any] | None:
    if step is None:
        return None
    return {
        "pixel": _plain(step.pixel),
        "method": step.method,
        "iterates_px": _plain(step.iterates),
        "disparity_px": step.disparity,
        "columns_px": _plain(step.columns),
        "ssd": _plain(step.ssd),
    }


def _temporal(step: TemporalStep | None) -> dict[str, Any] | None:
    if step is None:
        return None
    kept = step.sorting.are_kept
    flow = np.linalg.norm(step.found[kept] - step.reference_pixels[kept], axis=1)
    return {
        "method": step.method,
        "is_wide": step.is_wide,
        "has_prior": step.has_prior,
        "radius_px": step.radius_px,
        "median_flow_px": float(np.median(flow)) if len(flow) else None,
        **_sorted(step.sorting),
    }


def _consensus(step: ConsensusStep | None) -> dict[str, Any] | None:
    if step is None:
        return None
    return {
        "n_matches": len(step.pixels_reference),
        "is_known": step.is_known,
        "n_agreeing_with_prediction": step.n_agreeing,
        "n_inliers": None if step.inliers is None else int(step.inliers.sum()),
        "samples": _samples(step.search),
    }


def _samples(search: SampleSearch) -> dict[str, Any]:
    return {
        "n_drawn": len(search.counts),
        "n_planned": search.n_planned,
        "inliers": search.counts.tolist(),
        "n_near": search.n_near,
        "share_of_near": search.share,
        "n_inliers": None if search.inliers is None else int(search.inliers.sum()),
        "reason": search.reason,
    }


def _refinement(step: RefinementStep | None) -> dict[str, Any] | None:
    if step is None:
        return None
    return {
        "n_steps": step.n_steps,
        "n_within_gate": step.n_within,
        "gate_sigma": step.gate,
        "scale": step.scale,
        "n_inliers": [int(each.sum()) for each in step.inliers],
        "median_abs_residual_px": [_medians(each) for each in step.residuals_px],
        "median_abs_whitened": [_medians(each) for each in step.whitened],
    }


def _medians(residuals: FloatArray) -> dict[str, float | None]:
    finite = residuals[np.isfinite(residuals).all(axis=1)]
    if len(finite) == 0:
        return dict.fromkeys(("u", "v", "disparity"))
    values = np.median(np.abs(finite), axis=0)
    return dict(zip(("u", "v", "disparity"), values.tolist(), strict=True))


def _relative(relative: RelativePose) -> dict[str, Any]:
    return {
        "T_reference_current": _plain(relative.T_reference_current),
        "covariance": _plain(relative.covariance),
        "n_matches": relative.n_matches,
        "n_inliers": relative.n_inliers,
        "flow_px": relative.flow_px,
        "offset_px": relative.offset_px,
    }


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {
        "status": estimate.status.value,
        "T_world_cam": _plain(estimate.T_world_cam),
        "covariance": _plain(estimate.covariance),
    }


def _link(link: KeyframeLink) -> dict[str, Any]:
    registration = link.registration
    return {
        "frame": link.index,
        "stamp_ns": link.reference_ns,
        "kind": link.kind,
        "overlap": link.score,
        "n_matches": 0 if registration is None else registration.n_matches,
        "n_inliers": 0 if registration is None else registration.n_inliers,
        "chi2": link.chi2,
        "is_accepted": link.is_accepted,
        "reason": link.reason,
    }


def _plain(array: FloatArray) -> Any:  # noqa: ANN401 - nested lists
    return array.tolist()
