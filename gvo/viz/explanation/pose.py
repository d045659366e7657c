"""Pictures of the pose and of its edges in the window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.diagnostics.explain.values import FrameExplanation, Step
from gvo.types import FloatArray, RelativePose
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    KEPT,
    REFUSED,
    Picture,
    Sheet,
    finish_axes,
    show_image,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_N_COLUMNS = 4


def position_covariance(T: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance of the position, shape (3, 3), in the frame that T maps to."""
    R = T[:3, :3]
    return np.asarray(R @ covariance[3:, 3:] @ R.T)


def draw_pose(explanation: FrameExplanation) -> Picture:
    """Draw the covariance of the pose, with all its numbers."""
    result, relative = explanation.result, explanation.result.registration
    names = "raw, in the world", f"causal, in the world ({result.status})"
    poses = [
        (name, each.T_world_frame, each.covariance)
        for name, each in zip(names, (result.raw, result.causal), strict=True)
    ]
    name, (_, T, covariance) = "causal", poses[1]
    if relative is not None:
        name, T, covariance = "relative", relative.T_reference_current, relative.covariance
        poses.insert(0, (f"relative to frame {explanation.reference_index}", T, covariance))
    spread = 1e6 * position_covariance(T, covariance)
    sheet = Sheet("08_pose", _pose_caption(explanation), 5.6)
    above, side, numbers = sheet.panels.subplots(1, 3, width_ratios=[1.0, 1.0, 1.15])
    _draw_ellipses(above, spread[np.ix_([0, 2], [0, 2])], ("x", "z"), f"{name}, from above")
    _draw_ellipses(side, spread[np.ix_([2, 1], [2, 1])], ("z", "y"), f"{name}, from the side")
    side.invert_yaxis()
    numbers.set_axis_off()
    text = "\n\n".join(_numbers(*pose) for pose in poses)
    numbers.text(0.0, 1.0, text, family="monospace", fontsize=10, va="top", linespacing=1.4)
    return sheet.picture()


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
    # Room for the legend above; y points down.
    axes.set_ylim(*((-reach, 1.3 * reach) if names[1] == "z" else (-1.3 * reach, reach)))
    place: dict[str, Any] = {"loc": "upper center", "ncols": 3, "columnspacing": 0.8}
    x_label, y_label = (f"{name} - estimate [mm]" for name in names)
    finish_axes(axes, x_label, y_label, title, **place)


def _pose_caption(explanation: FrameExplanation) -> str:
    result = explanation.result
    if result.registration is not None:
        text = (
            f"Relative to frame {explanation.reference_index}: the position of this camera in that "
            "camera, with its ellipses of 1, 2 and 3 sigma (39, 86 and 99 % of a plane). x points "
            "right, y down, z forward. "
        )
    elif explanation.index == 0:
        text = "The first frame: it is the origin of the world, held by a prior of small sigma. "
    else:
        text = (
            f"Not registered: {result.reason or 'there is no earlier frame'}. The pose is "
            "predicted, and its covariance grows accordingly; the ellipses are of the causal pose. "
        )
    return text + (
        "Rotations are vectors whose length is the angle; sigmas are square roots of the "
        "covariance's diagonal, in the axes of this camera. Raw is the chain of frame-to-frame "
        "motions, causal the estimate of the window with this frame."
    )


def _numbers(name: str, T: FloatArray, covariance: FloatArray) -> str:
    rotation = np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = [
        ("position [m]   ", T[:3, 3], "9.4f"),
        ("  sigma [mm]   ", 1e3 * sigmas[3:], "9.3f"),
        ("rotation [deg] ", rotation, "9.4f"),
        ("  sigma [mdeg] ", 1e3 * np.degrees(sigmas[:3]), "9.3f"),
    ]
    length, angle = np.linalg.norm(T[:3, 3]), np.linalg.norm(rotation)
    return "\n".join(
        [
            name,
            " " * 15 + "".join(f"{axis:>9}" for axis in "xyz"),
            *(label + "".join(f"{each:{form}}" for each in row) for label, row, form in rows),
            f"length {length:.4f} m, angle {angle:.4f} deg",
        ]
    )


def draw_links(explanation: FrameExplanation) -> Picture:
    """Draw the earlier frames with what each contributed."""
    if not explanation.links:
        return Picture(name="09_links", caption="None: there is no earlier frame to link to.")
    shown = [link for link in explanation.links if link.kind not in ("standstill", "depth")]
    n_columns = min(_N_COLUMNS, max(len(shown), 3))
    n_rows = -(-len(shown) // n_columns)
    rows, columns = explanation.image.shape
    height = n_rows * (12.6 / n_columns * rows / columns + 0.65)
    sheet = Sheet("09_links", _links_caption(explanation), height)
    panels = sheet.panels.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, link in zip(panels, shown, strict=False):
        _draw_link(axes, link)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    return sheet.picture()


def _draw_link(axes: Axes, link: Step) -> None:
    what = {"step": "predecessor", "keyframe": "keyframe", "not linked": "keyframe, not linked"}
    overlap = "" if link.overlap is None else f", overlap {link.overlap:.2f}"
    answer = "failed" if link.kind == "keyframe" else link.reason
    registration = link.drawn.registration
    show_image(axes, link.drawn.image)
    if isinstance(registration, RelativePose):
        pixels, inliers = registration.pixels_reference, registration.inliers
        axes.plot(*pixels[~inliers].T, "x", color=REFUSED, markersize=3)
        axes.plot(*pixels[inliers].T, ".", color=KEPT, markersize=3)
        chi2 = "" if link.chi2 is None else f", chi2 {link.chi2:.2f}"
        counts = f"{link.n_inliers} of {link.n_matches} inliers"
        answer = f"{counts}{chi2}, {'accepted' if link.is_accepted else 'refused'}"
    for spine in axes.spines.values():
        spine.set_edgecolor(
            KEPT if link.is_accepted else BEFORE if link.kind == "not linked" else REFUSED
        )
        spine.set_linewidth(3)
    text = f"frame {link.frame}, {what[link.kind]}{overlap}\n{answer}"
    axes.set_title(text, fontsize=8, loc="left")


def _links_caption(explanation: FrameExplanation) -> str:
    window, links = explanation.config.window, explanation.links
    text = (
        f"{sum(link.is_accepted for link in links)} edges connect the frame to earlier ones (blue "
        f"frames); at most {window.n_links} keyframes are registered (window.n_links). Overlap is "
        f"the share of a keyframe's points in view. Below {window.min_overlap:g} the keyframe is "
        "not linked (window.min_overlap); it is where overlap times the number of steps since its "
        f"last link reaches {window.link_gain:g} (window.link_gain), or where the step is in "
        f"doubt. If every overlap is below {window.keyframe_overlap:g}, the frame becomes a "
        "keyframe itself (window.keyframe_overlap), as this one "
        f"{'did' if explanation.became_keyframe else 'did not'}. "
        "Chi2 is the squared Mahalanobis distance of the edge from the window's poses, 6 degrees "
        "of freedom: about 6 or less where the stated covariances are right or cautious."
    )
    for link in links:
        if link.kind == "standstill":
            text += f"\nStandstill: an edge without motion to frame {link.frame} was added."
        elif link.kind == "depth" and link.is_accepted:
            text += f"\nDepth alone gave another edge to frame {link.frame} (depth.icp)."
        elif link.reason and link.kind != "not linked":
            text += f"\nFrame {link.frame}: {link.reason}."
    return text
