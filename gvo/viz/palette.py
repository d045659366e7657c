"""The colours of all pictures: one meaning each, safe for colour-blind readers."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass

# Okabe and Ito's colours, and a violet that every kind of colour blindness tells from them; black
# is the reference's
ESTIMATES = {"raw": "#E69F00", "causal": "#56B4E9", "smoothed": "#009E73", "global": "#7F2CCB"}
"""Of the four trajectories of a run."""
OTHERS = ("#0072B2", "#D55E00", "#CC79A7", "#999999")
"""Of other estimates, in turn."""
REFERENCE = "#000000"
INLIERS, OUTLIERS = "#56B4E9", "#E69F00"
STATUSES = {
    "ok": "#BBBBBB",
    "coasting": "#F0E442",
    "lost": "#D55E00",
    "resumed": "#0072B2",
    "skipped": "#000000",
}
"""Of the statuses of frames, which have hatches and rows of their own too."""
HATCHES = {"ok": "", "coasting": "////", "lost": "xxxx", "resumed": "....", "skipped": ""}
LINKS = {"step": "#0072B2", "keyframe": "#CC79A7", "depth": "#009E73", "imu": "#8C564B"}
"""Of the kinds of edges."""
REFUSED = "#D55E00"
STAGES = {
    "read": "#00224E",
    "extract": "#35456C",
    "register": "#7C7B78",
    "links": "#A69D75",
    "window": "#D2C060",
    "loops": "#FDEA45",
}
"""Of the stages of a frame, from dark to light: distinct in grey print too."""
COUNTS = {"keypoints": "#999999", "points": "#0072B2", "matches": "#CC79A7", "inliers": INLIERS}

_LINE_STYLES = ("-", "-.", ":")


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the channels of "#RRGGBB"."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """Properties of the lines of one trajectory, named as in matplotlib."""

    color: str
    linestyle: str = "-"
    linewidth: float = 1.2
    zorder: float = 2.0
    marker: str = ""
    markersize: float = 3.0


REFERENCE_STYLE = Style(color="black", linestyle="--", zorder=3.0)
LOOP_STYLES = {
    # Both ends may lie on one point of the picture.
    "loops": Style(color=ESTIMATES["global"], linewidth=0.7, zorder=2.5, marker="o"),
    "refused loops": Style(color=REFUSED, linestyle="--", linewidth=0.7, zorder=1.4),
}
"""Of the lines between both ends of loops."""

DRAWN = {
    **ESTIMATES,
    "truth": REFERENCE,
    "keyframes": LINKS["keyframe"],
    "step": LINKS["step"],
    "keyframe link": LINKS["keyframe"],
    "depth": LINKS["depth"],
    "imu": LINKS["imu"],
    "refused": REFUSED,
    "loops": ESTIMATES["global"],
    "ellipsoids": OTHERS[3],
}
"""Of what is drawn in 3-D, by the names in a `gvo.viz.scene.Scene`."""


def styles_of(names: Iterable[str]) -> list[Style]:
    """Return styles by name: the fixed colour of a word in it, once, or the next free one."""
    left = dict(ESTIMATES)
    free = itertools.cycle(itertools.product(_LINE_STYLES, OTHERS))
    styles = []
    for name in names:
        word = next((w for w in re.findall("[a-z]+", name.lower()) if w in left), None)
        linestyle, color = ("-", left.pop(word)) if word else next(free)
        styles.append(Style(color=color, linestyle=linestyle))
    return styles
