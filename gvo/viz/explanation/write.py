"""The folder of an explained frame: pictures, numbers and a page."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar

import numpy as np

from gvo._trace import Trace
from gvo.diagnostics.explain.motion import has_prior
from gvo.diagnostics.explain.values import (
    ConsensusStep,
    FrameExplanation,
    KeyframeLink,
    RefinementStep,
    Sorting,
    SubpixelStep,
)
from gvo.errors import ConfigurationError
from gvo.types import Estimate, FloatArray, RelativePose
from gvo.viz.explanation.extraction import (
    budget_of,
    draw_depth,
    draw_depth_keypoints,
    draw_histograms,
    draw_keypoints,
    draw_stereo,
    draw_subpixel,
)
from gvo.viz.explanation.motion import draw_consensus, draw_matches, draw_residuals
from gvo.viz.explanation.pose import draw_links, draw_pose
from gvo.viz.explanation.sheet import Picture
from gvo.viz.report.page import write_page

_T = TypeVar("_T")


def write_explanation(explanation: FrameExplanation, out: Path) -> list[Path]:
    """Write numbered pictures, `explanation.json` and `explanation.html`.

    Parameters
    ----------
    explanation : FrameExplanation
    out : Path
        Folder, created if missing.

    Returns
    -------
    list of Path
        The files written: the pictures in order, the numbers, the page.

    Raises
    ------
    ConfigurationError
        When the folder cannot be written to.
    """
    open_folder(out)
    pictures = draw_pictures(explanation)
    files = {out / f"{each.name}.png": each.png for each in pictures if each.png is not None}
    numbers = json.dumps(explanation_json(explanation), indent=2, allow_nan=False)
    files[out / "explanation.json"] = numbers.encode()
    try:
        for path, content in files.items():
            path.write_bytes(content)
    except OSError as error:
        raise ConfigurationError(f"{out}: cannot be written: {error.strerror}") from error
    page, title = out / "explanation.html", f"{explanation.recording}: frame {explanation.index}"
    opening = f"<h1>{escape(title)}</h1>\n<p>{escape(_summary(explanation))}</p>"
    write_page(page, title, [opening, *map(_section, pictures)])
    return [*files, page]


def open_folder(out: Path) -> None:
    """Create the folder and check that it can be written to, before anything is computed.

    Raises
    ------
    ConfigurationError
        When it cannot be written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"{out}: cannot be written: {error.strerror}; give a folder to write into"
        ) from error


def draw_pictures(explanation: FrameExplanation) -> list[Picture]:
    """Draw the steps that were reached, in order; say of the others why not."""
    missing = explanation.result.reason or "this is the first frame, there is none to compare with"

    def draw(
        step: _T | None,
        drawer: Callable[[FrameExplanation, _T], Picture],
        name: str,
        title: str,
        why: str = f"Not reached: {missing}.",
    ) -> Picture:
        if step is None:
            return Picture(name=name, title=title, caption=why)
        return drawer(explanation, step)

    pictures = [draw_keypoints(explanation)]
    if explanation.depth_pixels is None:
        pictures.append(draw_stereo(explanation))
        texts = "03_subpixel", "Sub-pixel disparity", "No match was kept."
        pictures.append(draw(explanation.subpixel, draw_subpixel, *texts))
    else:
        pictures.append(draw_depth(explanation, explanation.depth_pixels))
        pictures.append(draw_depth_keypoints(explanation))
    residuals = "Residuals before and after the refinement"
    return [
        *pictures,
        draw_histograms(explanation),
        draw(explanation.matches, draw_matches, "05_matches", "Matches"),
        draw(explanation.consensus, draw_consensus, "06_consensus", "Consensus"),
        draw(explanation.refinement, draw_residuals, "07_residuals", residuals),
        draw_pose(explanation),
        draw_links(explanation),
    ]


def _summary(explanation: FrameExplanation) -> str:
    """Return the result of the frame in words."""
    result = explanation.result
    text = (
        f"Stamp {result.stamp_ns} ns, front-end {explanation.config.frontend.kind}, status "
        f"{result.status.value}. {result.n_keypoints} keypoints, {result.n_points} of them "
        f"measured in 3-D; {result.n_matches} matches, {result.n_inliers} inliers; "
        f"{result.n_links} edges in the window."
    )
    return f"{text} Not registered: {result.reason}." if result.reason else text


def _section(picture: Picture) -> str:
    """Return a picture, with its caption as text that can be searched and read aloud."""
    title, image = escape(picture.title), ""
    if picture.png is not None:
        data = b64encode(picture.png).decode()
        style = "display: block; width: 100%; height: auto"
        image = f'<div class="panel"><img src="data:image/png;base64,{data}" alt="{title}" '
        image += f'style="{style}"></div>\n'
    caption = escape(picture.caption).replace("\n", "<br>")
    heading = f"{int(picture.name[:2])}. {title}"
    return f"<section>\n<h2>{heading}</h2>\n{image}<p>{caption}</p>\n</section>"


def explanation_json(explanation: FrameExplanation) -> dict[str, Any]:
    """Return the numbers of an explanation as plain values.

    Steps that were not reached are null. Matrices are lists of rows.
    """
    result, keypoints = explanation.result, explanation.keypoints
    measured, is_stereo = _count(explanation.measured), explanation.depth_pixels is None
    budget, cell_size_px = budget_of(explanation.config)
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
            "n_detected": len(keypoints),
            "n_kept": keypoints.counts()["kept"],
            "budget": budget,
            "cell_size_px": cell_size_px,
        },
        "stereo": measured if is_stereo else None,
        "depth": None if is_stereo else measured,
        "depth_pixels": _of(explanation.depth_pixels, _count),
        "subpixel": _of(explanation.subpixel, _subpixel),
        "matches": _of(explanation.matches, partial(_matches, explanation.attempt)),
        "consensus": _of(explanation.consensus, _consensus),
        "refinement": _of(explanation.refinement, _refinement),
        "relative_pose": _of(result.registration, _relative),
        "raw": _estimate(result.raw),
        "causal": _estimate(result.causal),
        "links": [_link(link) for link in explanation.links],
        "became_keyframe": explanation.became_keyframe,
        "configuration": explanation.config.model_dump(),
    }


def _of(step: _T | None, numbers: Callable[[_T], dict[str, Any]]) -> dict[str, Any] | None:
    return None if step is None else numbers(step)


def _pick(value: object, *names: str) -> dict[str, Any]:
    """Return attributes as plain values."""
    picked = {name: getattr(value, name) for name in names}
    return {
        name: each.tolist() if isinstance(each, np.ndarray) else each
        for name, each in picked.items()
    }


def _count(sorting: Sorting) -> dict[str, Any]:
    return {"n": len(sorting), **sorting.counts()}


def _subpixel(step: SubpixelStep) -> dict[str, Any]:
    return _pick(step, "pixel", "method", "iterates_px", "disparity_px", "columns_px", "ssd")


def _matches(attempt: Trace, matches: Sorting) -> dict[str, Any]:
    flow = np.linalg.norm(matches.partners - matches.pixels, axis=1)[matches.are_kept]
    begin = attempt[0].values
    return {
        **{name: begin[name] for name in ("method", "is_wide", "radius_px")},
        "has_prior": has_prior(attempt),
        "median_flow_px": float(np.median(flow)) if len(flow) else None,
        **_count(matches),
    }


def _consensus(step: ConsensusStep) -> dict[str, Any]:
    return {
        "n_matches": len(step.pixels_reference),
        **_pick(step, "is_known", "n_agreeing_with_prediction"),
        "n_inliers": None if step.inliers is None else int(step.inliers.sum()),
        "samples": {
            "n_drawn": len(step.counts),
            **_pick(step, "n_planned", "n_near", "share_of_near", "reason"),
            "inliers": step.counts.tolist(),
            "n_inliers": None if step.sampled is None else int(step.sampled.sum()),
        },
    }


def _refinement(step: RefinementStep) -> dict[str, Any]:
    return {
        **_pick(step, "n_steps", "n_within_gate", "gate_sigma", "scale"),
        "n_inliers": step.inliers.sum(axis=1).tolist(),
        "median_abs_residual_px": [_medians(each) for each in step.residuals_px],
        "median_abs_whitened": [_medians(each) for each in step.whitened],
    }


def _medians(residuals: FloatArray) -> dict[str, float | None]:
    finite = residuals[np.isfinite(residuals).all(axis=1)]
    medians = np.median(np.abs(finite), axis=0).tolist() if len(finite) else [None] * 3
    return dict(zip(("u", "v", "disparity"), medians, strict=True))


def _relative(relative: RelativePose) -> dict[str, Any]:
    matrices = "T_reference_current", "covariance"
    return _pick(relative, *matrices, "n_matches", "n_inliers", "flow_px", "offset_px")


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {"status": estimate.status.value, **_pick(estimate, "T_world_frame", "covariance")}


def _link(link: KeyframeLink) -> dict[str, Any]:
    registration = link.registration
    return {
        "frame": link.index,
        "stamp_ns": link.reference_ns,
        **_pick(link, "kind", "overlap", "chi2", "is_accepted", "reason"),
        "n_matches": 0 if registration is None else registration.n_matches,
        "n_inliers": 0 if registration is None else registration.n_inliers,
    }
