"""The folder of an explained frame: pictures, numbers and a page."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gvo.backend.keyframe_policy import KEYFRAME_OVERLAP, MIN_OVERLAP
from gvo.diagnostics.explain.values import FrameExplanation, Link, Registration, Sorting
from gvo.errors import ConfigurationError, write_faults
from gvo.types import ConstantError, FloatArray, StereoFrame
from gvo.viz.explanation.pictures import TITLES, draw_pictures
from gvo.viz.figures import count_words, style
from gvo.viz.pages import write_page

_RELATIVE = (
    *("T_reference_current", "covariance", "n_matches", "n_inliers", "flow_px"),
    "calibration_errors",
)
_ESTIMATE = "status", "T_world_frame", "covariance"
_LINK = "frame", "stamp_ns", "kind", "overlap", "chi2", "is_accepted", "reason"


def write_explanation(explanation: FrameExplanation, out: Path) -> list[Path]:
    """Write numbered pictures, `explanation.json` and `explanation.html`.

    Parameters
    ----------
    explanation : FrameExplanation
    out : Path
        Folder, created if missing; the pictures of an earlier explanation are removed.

    Returns
    -------
    list of Path
        The files written: the pictures in order, the numbers, the page.

    Raises
    ------
    ConfigurationError
        When the folder cannot be written to.
    """
    with style():
        pictures = draw_pictures(explanation)
        drawn = [each for each in pictures if each.figure is not None]
        files = {out / f"{each.slug}.png": each.png() for each in drawn}
        numbers = json.dumps(_numbers(explanation), indent=2, allow_nan=False, default=_plain)
        files[out / "explanation.json"] = numbers.encode()
        with write_faults(ConfigurationError, out):
            out.mkdir(parents=True, exist_ok=True)
            for name in TITLES:  # of an earlier explanation, which may have had other steps
                (out / f"{name}.png").unlink(missing_ok=True)
            for path, content in files.items():
                path.write_bytes(content)
        page, found = out / "explanation.html", explanation.registration
        write_page(
            page,
            "explanation.html",
            title=f"{explanation.recording}: frame {explanation.index}",
            e=explanation,
            is_stereo=isinstance(explanation.frame, StereoFrame),
            attempts=[] if found is None else found.attempts,
            plots=pictures,
            poses=_poses(explanation),
            count_words=count_words,
            median=np.median,
            min_overlap=MIN_OVERLAP,
            keyframe_overlap=KEYFRAME_OVERLAP,
            **_lengths(found),
        )
    return [*files, page]


def _lengths(found: Registration | None) -> dict[str, Any]:
    """Return by how far matches moved and were off, pixels, and the rms of their residuals."""
    if found is None:
        return {"flow_px": (), "error_px": (), "rms": None}
    matches, kept = found.matches, found.matches.are_kept
    flow_px, error_px = (
        np.linalg.norm(matches.partners[kept] - each[kept], axis=1)
        for each in (matches.pixels, matches.predicted)
    )
    left = None if found.whitened is None else found.whitened[1][found.inliers]
    rms = None if left is None else float(np.sqrt(np.nanmean(left**2)))
    return {"flow_px": flow_px, "error_px": error_px, "rms": rms}


def _poses(explanation: FrameExplanation) -> dict[str, str]:
    """Return the poses found, in words."""
    result = explanation.result
    poses = {
        "Pose by the raw chain": _pose_words(result.raw.T_world_frame, result.raw.covariance),
        "Pose by the window": _pose_words(result.causal.T_world_frame, result.causal.covariance),
    }
    found = result.registration
    if found is None:
        return poses
    name = f"Motion from frame {explanation.reference_index}"
    return {name: _pose_words(found.T_reference_current, found.covariance), **poses}


def _pose_words(T: FloatArray, covariance: FloatArray) -> str:
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    angle = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    position, spread = (
        ", ".join(f"{each:.4f}" for each in values) for values in (T[:3, 3], sigmas[3:])
    )
    return (
        f"x, y, z = {position} m (sigma {spread}), turned by {angle:.4f} deg "
        f"(sigma {np.degrees(np.linalg.norm(sigmas[:3])):.4f})"
    )


def _numbers(explanation: FrameExplanation) -> dict[str, Any]:
    """Return what `explanation.json` holds: null where a step was not reached."""
    result, found = explanation.result, explanation.registration
    is_stereo = isinstance(explanation.frame, StereoFrame)
    measured = _count(explanation.measured)
    return {
        "recording": explanation.recording,
        "frame": explanation.index,
        "stamp_ns": result.stamp_ns,
        "frontend": explanation.config.frontend.kind,
        "reference_frame": explanation.reference_index,
        "status": result.status.value,
        "reason": result.reason,
        "attempts": [] if found is None else found.attempts,
        "rig_offset_px": explanation.offset_px,
        "rig_row_offset_px": explanation.row_offset_px,
        "readout_ms": explanation.readout_ms,
        "stereo": measured if is_stereo else None,
        "depth": None if is_stereo else measured,
        "matches": None if found is None else _matches(found),
        "residuals": None if found is None else _residuals(found),
        "relative_pose": _pick(result.registration, *_RELATIVE) or None,
        "raw": _pick(result.raw, *_ESTIMATE),
        "causal": _pick(result.causal, *_ESTIMATE),
        "links": [_pick(link, *_LINK) | _counts(link) for link in explanation.links],
        "became_keyframe": explanation.became_keyframe,
        "stage_ms": result.stage_ms,
        "configuration": explanation.config.model_dump(),
    }


def _plain(value: Any) -> Any:  # noqa: ANN401 - arrays and numbers of NumPy, and constants
    return asdict(value) if isinstance(value, ConstantError) else value.tolist()


def _pick(value: object, *names: str) -> dict[str, Any]:
    """Return attributes by name; none of None."""
    return {} if value is None else {name: getattr(value, name) for name in names}


def _count(sorting: Sorting) -> dict[str, int]:
    return {"n": len(sorting.pixels), **sorting.counts()}


def _counts(link: Link) -> dict[str, int]:
    found = link.registration
    if found is None:
        return {"n_matches": 0, "n_inliers": 0}
    return {"n_matches": found.n_matches, "n_inliers": found.n_inliers}


def _matches(found: Registration) -> dict[str, Any]:
    names = "radius_px", "is_predicted", "row_motion_px", "n_consensus", "is_known"
    n_inliers = int(np.count_nonzero(found.inliers))
    return _pick(found, *names) | {"n_inliers": n_inliers} | _count(found.matches)


def _residuals(found: Registration) -> dict[str, Any] | None:
    """Return the medians of the absolute residuals, before and after the refinement."""
    if found.residuals_px is None:
        return None
    medians = np.nanmedian(np.abs(found.residuals_px), axis=1).tolist()
    names = "u_px", "v_px", "disparity_px"
    before, after = (dict(zip(names, row, strict=True)) for row in medians)
    return {"before": before, "after": after}
