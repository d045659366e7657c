"""Pictures of the pose and of what it is tied to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.diagnostics.explain.values import FrameExplanation, KeyframeLink
from gvo.types import FloatArray, RelativePose
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    KEPT,
    REFUSED,
    Picture,
    close_sheet,
    open_sheet,
    show_image,
    words_only,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_N_COLUMNS = 4


def position_covariance(T: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance of the position, shape (3, 3), in the frame that T maps to."""
    R = T[:3, :3]
    return np.asarray(R @ covariance[3:, 3:] @ R.T)


def draw_pose(explanation: FrameExplanation) -> Picture:
    """Draw how sure the pose is, with all its numbers."""
    title, result = "The pose and its covariance", explanation.result
    relative = result.registration
    caption = _pose_caption(explanation)
    sheet = open_sheet(5.6, title, caption)
    panels = sheet.panels.subplots(1, 3, width_ratios=[1.0, 1.0, 1.15])
    ellipses = [("causal", result.causal.T_world_cam, result.causal.covariance)]
    if relative is not None:
        ellipses.insert(0, ("relative", relative.T_reference_current, relative.covariance))
    name, T, covariance = ellipses[0]
    spread = 1e6 * position_covariance(T, covariance)
    _draw_ellipses(panels[0], spread[np.ix_([0, 2], [0, 2])], ("x", "z"), f"{name}, from above")
    _draw_ellipses(panels[1], spread[np.ix_([2, 1], [2, 1])], ("z", "y"), f"{name}, from the side")
    panels[1].invert_yaxis()
    panels[2].set_axis_off()
    panels[2].text(
        0.0, 1.0, _numbers(explanation), family="monospace", fontsize=10, va="top", linespacing=1.4
    )
    return close_sheet(sheet, "08_pose", title, caption)


def _draw_ellipses(axes: Axes, covariance: FloatArray, names: tuple[str, str], title: str) -> None:
    values, vectors = np.linalg.eigh(covariance)
    angles = np.linspace(0.0, 2.0 * np.pi, 120)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    rim = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, np.newaxis] * circle)
    for sigma, style in ((1, "-"), (2, "--"), (3, ":")):
        axes.plot(*(sigma * rim), style, color=AFTER, label=f"{sigma} sigma")
    axes.plot(0.0, 0.0, "+", color="black", markersize=10)
    reach = 1.15 * max(3.0 * float(np.sqrt(np.maximum(np.diag(covariance), 0.0)).max()), 1e-3)
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, 1.3 * reach) if names[1] == "z" else axes.set_ylim(-1.3 * reach, reach)
    axes.set_xlabel(f"{names[0]} - estimate [mm]")
    axes.set_ylabel(f"{names[1]} - estimate [mm]")
    axes.set_title(title, fontsize=11, loc="left")
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(loc="upper center", ncols=3, fontsize=9, columnspacing=0.8)


def _pose_caption(explanation: FrameExplanation) -> str:
    result = explanation.result
    if result.registration is not None:
        text = (
            f"Relative to frame {explanation.reference_index}: the position of this camera in that "
            "camera, with its ellipses of 1, 2 and 3 sigma (39, 86 and 99 % of a plane). x points "
            "right, y down, z forward. "
        )
    elif result.raw.stamp_ns == result.causal.stamp_ns and explanation.index == 0:
        text = "The first frame: it is the origin of the world, held by a prior of small sigma. "
    else:
        text = (
            f"Not registered: {result.reason or 'there is no earlier frame'}. The pose goes on as "
            "before, and its covariance grows accordingly; the ellipses are of the causal pose. "
        )
    return text + (
        "Numbers: rotation as a vector, its length the angle; sigmas are roots of the covariance's "
        "diagonal, in the axes of this camera. Raw is the chain of frame-to-frame motions, causal "
        "the window's answer with this frame."
    )


def _numbers(explanation: FrameExplanation) -> str:
    result = explanation.result
    blocks = []
    if result.registration is not None:
        relative = result.registration
        blocks.append(
            _block(
                f"relative to frame {explanation.reference_index}",
                relative.T_reference_current,
                relative.covariance,
            )
        )
    blocks.append(_block("raw, in the world", result.raw.T_world_cam, result.raw.covariance))
    blocks.append(
        _block(
            f"causal, in the world ({result.status})",
            result.causal.T_world_cam,
            result.causal.covariance,
        )
    )
    return "\n\n".join(blocks)


def _block(name: str, T: FloatArray, covariance: FloatArray) -> str:
    rotation = np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = [
        ("position [m]   ", T[:3, 3], "9.4f"),
        ("  sigma [mm]   ", 1e3 * sigmas[3:], "9.3f"),
        ("rotation [deg] ", rotation, "9.4f"),
        ("  sigma [mdeg] ", 1e3 * np.degrees(sigmas[:3]), "9.3f"),
    ]
    lines = [name + "\n" + " " * 15 + "".join(f"{axis:>9}" for axis in "xyz")]
    lines += [
        label + "".join(f"{value:{form}}" for value in values) for label, values, form in rows
    ]
    length, angle = float(np.linalg.norm(T[:3, 3])), float(np.linalg.norm(rotation))
    lines.append(f"length {length:.4f} m, angle {angle:.4f} deg")
    return "\n".join(lines)


def draw_links(explanation: FrameExplanation) -> Picture:
    """Draw the earlier frames with what each contributed."""
    title, name, links = "Links to earlier frames", "09_links", explanation.links
    if not links:
        return words_only(name, title, "None: there is no earlier frame to be linked to.")
    caption = _links_caption(explanation)
    shown = [link for link in links if link.kind != "standstill"]
    n_columns = min(_N_COLUMNS, max(len(shown), 3))
    n_rows = -(-len(shown) // n_columns)
    shape = explanation.image.shape
    height = n_rows * (12.6 / n_columns * shape[0] / shape[1] + 0.65)
    sheet = open_sheet(height, title, caption)
    panels = sheet.panels.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, link in zip(panels, shown, strict=False):
        _draw_link(axes, link)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    return close_sheet(sheet, name, title, caption)


def _draw_link(axes: Axes, link: KeyframeLink) -> None:
    colour = KEPT if link.is_accepted else BEFORE if link.kind == "not linked" else REFUSED
    show_image(axes, link.image)
    if isinstance(link.registration, RelativePose):
        pixels, inliers = link.registration.pixels_reference, link.registration.inliers
        axes.plot(*pixels[~inliers].T, "x", color=REFUSED, markersize=3)
        axes.plot(*pixels[inliers].T, ".", color=KEPT, markersize=3)
    for spine in axes.spines.values():
        spine.set_edgecolor(colour)
        spine.set_linewidth(3)
    axes.set_title(_link_text(link), fontsize=9, loc="left")


def _link_text(link: KeyframeLink) -> str:
    what = {"step": "predecessor", "keyframe": "keyframe", "not linked": "keyframe, not linked"}
    score = "" if link.score is None else f", overlap {link.score:.2f}"
    lines = [f"frame {link.index}, {what[link.kind]}{score}"]
    if isinstance(link.registration, RelativePose):
        counts = f"{link.registration.n_inliers} of {link.registration.n_matches} inliers"
        chi2 = "" if link.chi2 is None else f", chi2 {link.chi2:.2f}"
        lines.append(f"{counts}{chi2}, {'accepted' if link.is_accepted else 'refused'}")
    else:
        lines.append("failed" if link.kind == "keyframe" else link.reason)
    return "\n".join(lines)


def _links_caption(explanation: FrameExplanation) -> str:
    window, links = explanation.config.window, explanation.links
    n_accepted = sum(link.is_accepted for link in links)
    text = (
        f"{n_accepted} edges tie the frame to earlier ones (blue frames); {window.n_links} "
        "registrations at most are tried (window.n_links). Overlap is the share of a keyframe's "
        f"points in view: below {window.min_overlap:g} it is let go (window.min_overlap), "
        f"times the steps since it must be {window.link_gain:g} to be linked (window.link_gain) "
        "unless the step is in doubt, "
        f"and where all are below {window.keyframe_overlap:g} the frame becomes a keyframe itself "
        "(window.keyframe_overlap), as this one "
        f"{'did' if explanation.became_keyframe else 'did not'}. "
        "Chi2 is the squared distance of the edge from the window's poses in sigmas; of 6 degrees "
        "of freedom, about 6 or less where the stated covariances are right or cautious."
    )
    for link in links:
        if link.kind == "standstill":
            text += f"\nStandstill: an edge without motion to frame {link.index} was added."
        elif link.reason and link.kind != "not linked":
            text += f"\nFrame {link.index}: {link.reason}."
    return text
