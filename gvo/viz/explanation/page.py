"""The page that shows the pictures of an explanation in order."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

from gvo.diagnostics.explain.values import FrameExplanation
from gvo.viz.explanation.sheet import Picture

_STYLE = """
body { font-family: sans-serif; max-width: 1300px; margin: 1em auto; padding: 0 1em;
  color: black; background: white; line-height: 1.4; }
img { width: 100%; height: auto; border: 1px solid #ccc; }
section { margin: 2em 0; break-inside: avoid; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-bottom: 0.3em; }
p { white-space: pre-line; }
@media print { body { max-width: none; margin: 0; } section { margin: 1em 0; } }
"""


def explanation_page(explanation: FrameExplanation, pictures: Sequence[Picture]) -> str:
    """Return a page that holds all it shows."""
    heading = html.escape(f"{explanation.recording}: frame {explanation.index}")
    sections = "\n".join(_section(picture) for picture in pictures)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{heading}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{heading}</h1>\n<p>{html.escape(summary(explanation))}</p>\n{sections}\n"
        "</body>\n</html>\n"
    )


def summary(explanation: FrameExplanation) -> str:
    """Return what became of the frame, in words."""
    result = explanation.result
    text = (
        f"Stamp {result.stamp_ns} ns, front-end {explanation.config.frontend.kind}, status "
        f"{result.status.value}. {result.n_keypoints} keypoints, {result.n_points} of them "
        f"measured in 3-D; {result.n_matches} matches, {result.n_inliers} inliers; "
        f"{result.n_links} edges in the window."
    )
    return f"{text} Not registered: {result.reason}." if result.reason else text


def _section(picture: Picture) -> str:
    title, caption = html.escape(picture.title), html.escape(picture.caption)
    image = ""
    if picture.png is not None:
        data = base64.b64encode(picture.png).decode()
        image = f'<img src="data:image/png;base64,{data}" alt="{title}">\n'
    number = int(picture.name[:2])
    # The picture holds its caption as well; for readers of text it stands here.
    return f"<section>\n<h2>{number}. {title}</h2>\n{image}<p>{caption}</p>\n</section>"
