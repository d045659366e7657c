"""Text of the page: the numbers of a frame, the legend, messages."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping

import numpy as np

from gvo.trajectory.trajectory import format_stamp
from gvo.types import FloatArray, FrameResult
from gvo.view.ellipsoids import position_sigmas
from gvo.view.layers import COLOURS

_CELL = "padding:0 0.75em 0 0;text-align:left;vertical-align:top;font-weight:400"
_NUMBER = "font-variant-numeric:tabular-nums;overflow-wrap:anywhere;width:100%"
_MEANINGS = {
    "raw": "chain of frame-to-frame registrations",
    "causal": "pose when the frame arrived; the camera",
    "smoothed": "pose when the frame left the window",
    "truth": "ground truth (dashed)",
    "keyframes": "keyframes of the window",
    "step": "link to the frame before",
    "keyframe link": "link to a keyframe",
    "standstill": "link without motion",
    "refused": "link that the window refused",
    "ellipsoids": "position covariances",
}


def numbers_html(rows: Mapping[str, str]) -> str:
    """Return a table; the cell of a name is found as `[data-gvo="name"]`.

    Parameters
    ----------
    rows : mapping of str to str
        Value by label; a unit in brackets is not part of the name.
    """
    lines = "".join(
        f'<tr><th style="{_CELL};white-space:nowrap;opacity:0.65">{html.escape(label)}</th>'
        f'<td style="{_CELL};{_NUMBER}" data-gvo="{html.escape(label.partition(" [")[0])}">'
        f"{html.escape(value)}</td></tr>"
        for label, value in rows.items()
    )
    return (
        '<table style="margin:0.3em 0.75em;font-size:0.85em;line-height:1.45;'
        f'border-collapse:collapse">{lines}</table>'
    )


def message_html(text: str) -> str:
    """Return one line that stands out; nothing to see where there is no text."""
    colour = COLOURS["refused"]
    style = (
        f"margin:0 0.75em 0.5em;padding:0.3em 0.6em;font-size:0.85em;border-left:3px solid {colour}"
    )
    shown = style if text else "display:none"
    return f'<div role="status" data-gvo="message" style="{shown}">{html.escape(text)}</div>'


def state_html(text: str) -> str:
    """Return what the player is doing."""
    return (
        '<div style="margin:0 0.75em 0.5em;font-size:0.85em;opacity:0.65" '
        f'data-gvo="player">{html.escape(text)}</div>'
    )


def legend_html(names: Iterable[str]) -> str:
    """Return the colours with what they stand for."""
    entries = "".join(
        '<div style="display:flex;align-items:center;gap:0.6em">'
        f'<span style="flex:none;width:1.4em;border-top:3px {_line(name)} {COLOURS[name]}"></span>'
        f"<span><b>{name}</b> {html.escape(_MEANINGS[name])}</span></div>"
        for name in names
    )
    return (
        '<div data-gvo="legend" style="margin:0.3em 0.75em 0.6em;font-size:0.8em;'
        f'line-height:1.5">{entries}</div>'
    )


def _line(name: str) -> str:
    return "dashed" if name == "truth" else "solid"


def result_rows(result: FrameResult) -> dict[str, str]:
    """Return the numbers of a frame, value by label."""
    total = sum(result.stage_ms.values())
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in result.stage_ms.items())
    estimate = result.causal
    refused = sum(not link.is_accepted for link in result.links)
    return {
        "keypoints": f"{result.n_keypoints}",
        "matches": f"{result.n_matches}",
        "inliers": f"{result.n_inliers}",
        "links": f"{result.n_links}" + (f" ({refused} refused)" if refused else ""),
        "keyframes": f"{len(result.keyframes_ns)}",
        "ms": f"{total:.1f} ({stages})",
        **pose_rows(estimate.T_world_cam, estimate.covariance),
    }


def pose_rows(T_world_cam: FloatArray, covariance: FloatArray | None) -> dict[str, str]:
    """Return position and standard deviations, value by label."""
    rows = {"position [m]": ", ".join(f"{value:.3f}" for value in T_world_cam[:3, 3])}
    if covariance is not None:
        sigmas = position_sigmas(T_world_cam, covariance)
        turn = np.degrees(np.sqrt(np.trace(covariance[:3, :3])))
        rows["sigma [m]"] = ", ".join(f"{value:.4f}" for value in sigmas)
        rows["turn sigma [deg]"] = f"{turn:.3f}"
    return rows


def frame_rows(index: int, n_frames: int, stamp_ns: int, status: str) -> dict[str, str]:
    """Return which frame it is, value by label."""
    return {
        "frame": f"{index} of {n_frames}",
        "stamp [s]": format_stamp(stamp_ns),
        "status": status,
    }
