"""The folder of an explained frame: pictures, numbers and a page."""

from __future__ import annotations

import json
from base64 import b64encode
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gvo._text import html_text
from gvo.diagnostics.explain.steps import has_prior
from gvo.diagnostics.explain.values import FrameExplanation, Sorting, Step
from gvo.errors import ConfigurationError, write_faults
from gvo.types import ConstantError, StereoFrame
from gvo.viz.explanation import extraction, motion
from gvo.viz.explanation.sheet import TITLES, Picture
from gvo.viz.report.page import write_page

_RELATIVE = "T_reference_current", "covariance", "n_matches", "n_inliers", "flow_px"
_ESTIMATE = "status", "T_world_frame", "covariance"


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
    pictures = draw_pictures(explanation)
    files = {out / f"{each.name}.png": each.png for each in pictures if each.png is not None}
    numbers = json.dumps(explanation_json(explanation), indent=2, allow_nan=False, default=_plain)
    files[out / "explanation.json"] = numbers.encode()
    with write_faults(ConfigurationError, out):
        out.mkdir(parents=True, exist_ok=True)
        for name in TITLES:  # of an earlier explanation, which may have had other steps
            (out / f"{name}.png").unlink(missing_ok=True)
        for path, content in files.items():
            path.write_bytes(content)
    page, title = out / "explanation.html", f"{explanation.recording}: frame {explanation.index}"
    opening = f"<h1>{html_text(title)}</h1>\n<p>{html_text(_summary(explanation))}</p>"
    write_page(page, title, [opening, *map(_section, pictures)])
    return [*files, page]


def draw_pictures(explanation: FrameExplanation) -> list[Picture]:
    """Draw the steps that were reached, in order; say of the others why not."""
    is_stereo = isinstance(explanation.frame, StereoFrame)
    of_sensor = extraction.OF_STEREO if is_stereo else extraction.OF_DEPTH
    drawers = extraction.draw_keypoints, *of_sensor, extraction.draw_histograms, *motion.DRAWERS
    return [draw(explanation) for draw in drawers]


def _summary(explanation: FrameExplanation) -> str:
    """Return the result of the frame in words."""
    result = explanation.result
    text = (
        f"Stamp {result.stamp_ns} ns, front-end {explanation.config.frontend.kind}, status "
        f"{result.status.value}. {result.n_keypoints} keypoints, {result.n_points} of them "
        f"measured in 3-D; {result.n_matches} matches, {result.n_inliers} inliers; "
        f"edges in the window: {result.n_links}."
    )
    return f"{text} Not registered: {result.reason}." if result.reason else text


def _section(picture: Picture) -> str:
    """Return a picture, with its caption as text that can be searched and read aloud."""
    title, image = html_text(picture.title), ""
    if picture.panels_png is not None:
        data = b64encode(picture.panels_png).decode()
        image = f'<div class="panel"><img src="data:image/png;base64,{data}" alt="{title}"></div>\n'
    caption = "<br>".join(map(html_text, picture.caption.split("\n")))
    heading = f"{int(picture.name[:2])}. {title}"
    return f"<section>\n<h2>{heading}</h2>\n{image}<p>{caption}</p>\n</section>"


def explanation_json(explanation: FrameExplanation) -> dict[str, Any]:
    """Return the numbers of an explanation as plain values.

    Steps that were not reached are null. Matrices are lists of rows.
    """
    result, keypoints = explanation.result, explanation.keypoints
    measured, is_stereo = _count(explanation.measured), isinstance(explanation.frame, StereoFrame)
    budget, cell_size_px = extraction.budget_of(explanation.config)
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
        "readout_ms": explanation.readout_ms,
        "row_motion_px": explanation.row_motion_px,
        "keypoints": {
            "n_detected": len(keypoints),
            "n_kept": keypoints.counts()["kept"],
            "budget": budget,
            "cell_size_px": cell_size_px,
        },
        "stereo": measured if is_stereo else None,
        "depth": None if is_stereo else measured,
        "depth_pixels": _count(explanation.depth_pixels),
        "subpixel": explanation.subpixel,
        "matches": _matches(explanation),
        "consensus": explanation.consensus,
        "refinement": explanation.refinement,
        "relative_pose": _pick(result.registration, *_RELATIVE, "calibration_errors"),
        "raw": _pick(result.raw, *_ESTIMATE),
        "causal": _pick(result.causal, *_ESTIMATE),
        "links": explanation.links,
        "became_keyframe": explanation.became_keyframe,
        "configuration": explanation.config.model_dump(),
    }


def _plain(value: Any) -> Any:  # noqa: ANN401 - steps, and arrays and numbers of NumPy
    if isinstance(value, Step):
        return {name: each for name, each in vars(value).items() if name != "drawn"}
    return asdict(value) if isinstance(value, ConstantError) else value.tolist()


def _pick(value: object, *names: str) -> dict[str, Any] | None:
    """Return attributes by name; None of None."""
    return None if value is None else {name: getattr(value, name) for name in names}


def _count(sorting: Sorting | None) -> dict[str, int] | None:
    return None if sorting is None else {"n": len(sorting), **sorting.counts()}


def _matches(explanation: FrameExplanation) -> dict[str, Any] | None:
    matches, begin = explanation.matches, explanation.attempt.find("attempt")
    if matches is None:
        return None
    flow = np.linalg.norm(matches.partners - matches.pixels, axis=1)[matches.are_kept]
    return {
        **{name: begin[name] for name in ("method", "is_wide", "radius_px")},
        "has_prior": has_prior(explanation.attempt),
        "median_flow_px": float(np.median(flow)) if len(flow) else None,
        "n": len(matches),
        **matches.counts(),
    }
