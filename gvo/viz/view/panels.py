"""What the panels of the page say, as HTML: numbers, state, legend."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from gvo._text import html_text
from gvo.trajectory.trajectory import format_stamp
from gvo.viz.palette import DRAWN
from gvo.viz.scene import Scene, position_sigmas
from gvo.viz.view.newest import FrameView

_CELL = "padding:0 0.75em 0 0;text-align:left;vertical-align:top;font-weight:400"
_NUMBER = "font-variant-numeric:tabular-nums;overflow-wrap:anywhere;width:100%"
_LINE = "margin:0 0.75em 0.5em;font-size:0.85em"
_MEANINGS = {
    "raw": "chain of frame-to-frame registrations",
    "causal": "pose when the frame arrived; the camera",
    "smoothed": "pose when the frame left the window",
    "truth": "ground truth (dashed)",
    "keyframes": "keyframes of the window",
    "step": "link to the frame before",
    "keyframe link": "link to a keyframe",
    "depth": "link by depth alone",
    "refused": "link that the window refused",
    "loops": "a place seen again",
    "ellipsoids": "position covariances",
}


def numbers_html(rows: Mapping[str, str]) -> str:
    """Return a table of values by label; the cell of "name [unit]" is `[data-gvo="name"]`."""
    lines = "".join(
        f'<tr><th style="{_CELL};white-space:nowrap;opacity:0.65">{html_text(label)}</th>'
        f'<td style="{_CELL};{_NUMBER}" data-gvo="{html_text(label.partition(" [")[0])}">'
        f"{html_text(value)}</td></tr>"
        for label, value in rows.items()
    )
    return (
        '<table style="margin:0.3em 0.75em;font-size:0.85em;line-height:1.45;'
        f'border-collapse:collapse">{lines}</table>'
    )


def state_html(state: str, problem: str) -> str:
    """Return what the player is doing, and a line that stands out where there is a problem."""
    edge = f"padding:0.3em 0.6em;border-left:3px solid {DRAWN['refused']}"
    style = f"{_LINE};{edge}" if problem else "display:none"
    return (
        f'<div role="status" data-gvo="message" style="{style}">{html_text(problem)}</div>'
        f'<div data-gvo="player" style="{_LINE};opacity:0.65">{html_text(state)}</div>'
    )


def legend_html(without: Collection[str]) -> str:
    """Return the colours and their meanings."""
    entries = "".join(
        '<div style="display:flex;align-items:center;gap:0.6em">'
        f'<span style="flex:none;width:1.4em;border-top:3px {_line(name)} {DRAWN[name]}"></span>'
        f"<span><b>{name}</b> {html_text(meaning)}</span></div>"
        for name, meaning in _MEANINGS.items()
        if name not in without
    )
    return (
        '<div data-gvo="legend" style="margin:0.3em 0.75em 0.6em;font-size:0.8em;'
        f'line-height:1.5">{entries}</div>'
    )


def _line(name: str) -> str:
    return "dashed" if name == "truth" else "solid"


def frame_rows(frame: FrameView, n_frames: int) -> dict[str, str]:
    """Return the numbers of a frame, value by label."""
    rows = {
        "frame": f"{frame.index} of {n_frames}",
        "stamp [s]": format_stamp(frame.stamp_ns),
        "status": "skipped" if frame.result is None else str(frame.result.status),
    }
    if frame.reason:
        rows["reason"] = frame.reason
    return rows if frame.scene is None else rows | _scene_rows(frame.scene)


def _scene_rows(scene: Scene) -> dict[str, str]:
    counts, estimate = scene.counts, scene.poses["causal"]
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in scene.stage_ms.items())
    turn_deg = np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))
    refused = f" ({counts['refused']} refused)" if counts["refused"] else ""
    return {
        **{name: f"{counts[name]}" for name in ("keypoints", "matches", "inliers")},
        "links": f"{counts['links']}{refused}",
        "keyframes": f"{counts['keyframes']}",
        "ms": f"{sum(scene.stage_ms.values()):.1f} ({stages})",
        "position [m]": ", ".join(f"{value:.3f}" for value in estimate.T_world_frame[:3, 3]),
        "sigma [m]": ", ".join(f"{value:.4f}" for value in position_sigmas(estimate)),
        "turn sigma [deg]": f"{turn_deg:.3f}",
    }
