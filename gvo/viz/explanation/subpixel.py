"""The picture of a disparity's fraction of a pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gvo.diagnostics.explain.values import FrameExplanation, SubpixelStep
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    LIMIT,
    Picture,
    close_sheet,
    open_sheet,
    show_image,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_subpixel(explanation: FrameExplanation, step: SubpixelStep) -> Picture:
    """Draw the patches of one match and how its disparity was found."""
    title = "Sub-pixel disparity of one match"
    size = len(step.left)
    depth = explanation.camera.disparity_to_depth(step.disparity - explanation.offset_px)
    caption = (
        "Of all matches kept, the one of the median horizontal gradient, at "
        f"({step.pixel[0]:.0f}, {step.pixel[1]:.0f}) in the left image: "
        f"patches of {size} x {size} px and their difference, and the sum of squared "
        f"differences (less that of the means) over the disparity. {_method(step)} It ends at "
        f"{step.disparity:.3f} px, {_offset(explanation)}a depth of {float(depth):.2f} m; the "
        f"nearest whole pixel would be {_whole(step, explanation)}."
    )
    sheet = open_sheet(4.0, title, caption)
    axes = sheet.panels.subplots(1, 4, width_ratios=[1, 1, 1, 2.2])
    low, high = float(step.left.min()), float(step.left.max())
    show_image(axes[0], step.left, "left patch", vmin=low, vmax=high)
    show_image(axes[1], step.right, f"right, at {step.disparity:.2f} px", vmin=low, vmax=high)
    difference = step.right - step.left
    difference = difference - difference.mean()
    limit = max(high - low, 1.0)
    show_image(axes[2], difference, "difference (grey: none)", vmin=-0.5 * limit, vmax=0.5 * limit)
    _draw_curve(axes[3], step)
    return close_sheet(sheet, "03_subpixel", title, caption)


def _offset(explanation: FrameExplanation) -> str:
    offset_px = explanation.offset_px
    return f"less the learnt {offset_px:+.3f} px " if offset_px else ""


def _whole(step: SubpixelStep, explanation: FrameExplanation) -> str:
    whole = max(round(step.disparity), 1)
    depth = explanation.camera.disparity_to_depth(whole - explanation.offset_px)
    return f"{whole} px, {float(depth):.2f} m"


def _method(step: SubpixelStep) -> str:
    if step.method == "none":
        return "The sub-pixel fit is off (stereo.subpixel none)."
    if step.method == "parabola":
        return (
            f"The search starts at the keypoints' whole pixels, {step.iterates[0]:.0f} px; the "
            "vertex of the parabola through the best column and its neighbours gives the fraction."
        )
    steps = np.diff(step.iterates)
    return (
        f"The coarse search gives {step.iterates[0]:.2f} px; {len(steps)} Gauss-Newton steps "
        f"follow ({', '.join(f'{each:+.3f}' for each in steps)} px). They use the gradients of the "
        "left patch, so that where left and right differ a little they end beside the lowest point "
        "of the curve. Between whole pixels the right image is interpolated, which smooths its "
        "noise: hence the kinks."
    )


def _draw_curve(axes: Axes, step: SubpixelStep) -> None:
    is_sampled = step.method == "parabola"
    axes.plot(
        step.columns,
        step.ssd,
        "o-" if is_sampled else "-",
        color=BEFORE,
        label="SSD of the patches",
    )
    if is_sampled:
        _draw_parabola(axes, step)
    elif step.method == "gauss-newton":
        axes.plot(
            step.iterates,
            np.interp(step.iterates, step.columns, step.ssd),
            "o-",
            color=AFTER,
            markersize=5,
            label="Gauss-Newton steps",
        )
    axes.axvline(step.disparity, color=LIMIT, linestyle="--", label=f"end: {step.disparity:.3f} px")
    axes.set_xlabel("disparity [px]")
    axes.set_ylabel("squared difference [grey²]")
    axes.set_ylim(0.0, 1.4 * float(step.ssd.max()))
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(loc="upper center", ncols=2, fontsize=9)


def _draw_parabola(axes: Axes, step: SubpixelStep) -> None:
    best = int(np.clip(step.ssd.argmin(), 1, len(step.ssd) - 2))
    near = slice(best - 1, best + 2)
    coefficients = np.polyfit(step.columns[near], step.ssd[near], 2)
    shown = np.linspace(step.columns[best] - 1.2, step.columns[best] + 1.2, 50)
    axes.plot(shown, np.polyval(coefficients, shown), color=AFTER, label="parabola")
