"""The folder of an explained frame: pictures and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gvo.backend.keyframe_policy import KEYFRAME_OVERLAP, MIN_OVERLAP
from gvo.diagnostics.explain.values import FrameExplanation, Registration
from gvo.errors import ConfigurationError, write_faults
from gvo.types import FloatArray, StereoFrame
from gvo.viz.explanation.pictures import TITLES, draw_pictures
from gvo.viz.figures import count_words, style
from gvo.viz.pages import write_page


def write_explanation(explanation: FrameExplanation, out: Path) -> list[Path]:
    """Write numbered pictures and `explanation.html`.

    Parameters
    ----------
    explanation : FrameExplanation
    out : Path
        Folder, created if missing; the pictures of an earlier explanation are removed.

    Returns
    -------
    list of Path
        The files written: the pictures in order, the page.

    Raises
    ------
    ConfigurationError
        When the folder cannot be written to.
    """
    with style():
        pictures = draw_pictures(explanation)
        drawn = [each for each in pictures if each.figure is not None]
        files = {out / f"{each.slug}.png": each.png() for each in drawn}
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
