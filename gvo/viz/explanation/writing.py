"""Write an explained frame."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryFile

from gvo.diagnostics.explain.values import FrameExplanation
from gvo.errors import ConfigurationError
from gvo.viz.explanation.extraction import (
    draw_depth,
    draw_depth_keypoints,
    draw_histograms,
    draw_keypoints,
    draw_stereo,
)
from gvo.viz.explanation.motion import draw_consensus, draw_matches, draw_residuals
from gvo.viz.explanation.numbers import explanation_json
from gvo.viz.explanation.page import explanation_page
from gvo.viz.explanation.pose import draw_links, draw_pose
from gvo.viz.explanation.sheet import Picture, words_only
from gvo.viz.explanation.subpixel import draw_subpixel


def write_explanation(explanation: FrameExplanation, out: Path) -> list[Path]:
    """Write numbered pictures, `explanation.json` and `explanation.html`.

    Parameters
    ----------
    explanation : FrameExplanation
    out : Path
        Folder; made where it is not there.

    Returns
    -------
    list of Path
        What was written: the pictures in order, the numbers, the page.

    Raises
    ------
    ConfigurationError
        When the folder cannot be written to.
    """
    pictures = draw_pictures(explanation)
    files = {f"{each.name}.png": each.png for each in pictures if each.png is not None}
    numbers = json.dumps(explanation_json(explanation), indent=2, allow_nan=False)
    files["explanation.json"] = numbers.encode()
    files["explanation.html"] = explanation_page(explanation, pictures).encode()
    open_folder(out)
    try:
        for name, content in files.items():
            (out / name).write_bytes(content)
    except OSError as error:
        raise ConfigurationError(f"{out}: cannot be written: {error.strerror}") from error
    return [out / name for name in files]


def open_folder(out: Path) -> None:
    """Make the folder, before much is computed for what it cannot hold.

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
    """Draw the steps that were reached, in order; of the others, say why not."""
    pictures = [draw_keypoints(explanation)]
    if explanation.stereo is not None:
        pictures.append(draw_stereo(explanation, explanation.stereo))
        if explanation.subpixel is None:
            pictures.append(words_only("03_subpixel", "Sub-pixel disparity", "No match was kept."))
        else:
            pictures.append(draw_subpixel(explanation, explanation.subpixel))
    if explanation.depth is not None:
        pictures.append(draw_depth(explanation, explanation.depth))
        pictures.append(draw_depth_keypoints(explanation, explanation.depth))
    pictures.append(draw_histograms(explanation))
    pictures += _draw_motion(explanation)
    return [*pictures, draw_pose(explanation), draw_links(explanation)]


def _draw_motion(explanation: FrameExplanation) -> list[Picture]:
    missing = explanation.result.reason or "this is the first frame, there is none to compare with"
    caption = f"Not reached: {missing}."
    temporal, consensus = explanation.temporal, explanation.consensus
    refinement = explanation.refinement
    return [
        words_only("05_matches", "Matches", caption)
        if temporal is None
        else draw_matches(explanation, temporal),
        words_only("06_consensus", "Consensus", caption)
        if consensus is None
        else draw_consensus(explanation, consensus),
        words_only("07_residuals", "Residuals before and after the refinement", caption)
        if refinement is None
        else draw_residuals(explanation, refinement),
    ]
