"""The six pictures of an explained frame."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gvo.diagnostics.explain.values import FrameExplanation, Link, Registration, Sorting
from gvo.frontend.klt import image_of
from gvo.geometry.refinement import GATE
from gvo.types import FloatArray, RelativePose, RgbdFrame, StereoFrame
from gvo.viz.figures import (
    Plot,
    draw_segments,
    image_height,
    is_wide,
    join_images,
    legend_below,
    new_figure,
    pair_height,
    show_image,
)
from gvo.viz.palette import INLIERS, OUTLIERS, STAGES

TITLES = {
    "1_measured": "Keypoints with depth",
    "2_flow": "Matches with the reference",
    "3_corner": "One corner",
    "3_candidates": "Why candidates failed",
    "4_consensus": "Which matches agree on a motion",
    "5_links": "Links to earlier frames",
    "6_times": "Where the time went",
}
"""Of the pictures, by the names of their files."""
_REASONS = ("#E69F00", "#D55E00", "#CC79A7", "#F0E442", "#0072B2", "#009E73", "#999999")
_MARKERS = "xsD^vP+"
_BEFORE, _AFTER, _LIMIT = "#999999", "#0072B2", "#D55E00"
_N_COLUMNS = 4


def draw_pictures(explanation: FrameExplanation) -> list[Plot]:
    """Draw the steps that were reached, in order; say of the others why not."""
    return [
        _draw_measured(explanation),
        _draw_flow(explanation),
        _draw_corner(explanation) if explanation.is_klt else _draw_candidates(explanation),
        _draw_consensus(explanation),
        _draw_links(explanation),
        _draw_times(explanation),
    ]


def _picture(slug: str, figure: Figure | None, text: str = "") -> Plot:
    """Return a picture, whose words are those of the page, or the reason why there is none."""
    return Plot(slug=slug, title=TITLES[slug], text=text, figure=figure, is_image=True)


def _not_reached(slug: str, explanation: FrameExplanation) -> Plot:
    why = explanation.result.reason or "this is the first frame, there is none to compare with"
    return _picture(slug, None, f"Not reached: {why}.")


def _draw_measured(explanation: FrameExplanation) -> Plot:
    frame = explanation.frame
    if isinstance(frame, StereoFrame):
        return _draw_disparities(explanation, frame)
    return _draw_depths(explanation, frame)


def _draw_disparities(explanation: FrameExplanation, frame: StereoFrame) -> Plot:
    measured, shape = explanation.measured, frame.left.shape
    heights = [pair_height(shape)]
    if explanation.is_klt:
        heights.append(image_height(shape, share=1.0 if is_wide(shape) else 0.6))
    figure = new_figure(sum(heights) + 0.4)
    rows = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)
    upper, *lower = rows[:, 0]
    kept = measured.are_kept
    canvas, shift = join_images(frame.left, frame.right)
    show_image(upper, canvas, f"left and right: {kept.sum()} matches, by disparity")
    pixels, disparities = measured.pixels[kept], measured.values[kept]
    # A single wrong match must not take all the colours.
    low, high = np.percentile(disparities, [1, 97]) if kept.any() else (0.0, 1.0)
    looks: dict[str, Any] = {"cmap": "viridis", "clim": (low, high), "linewidths": 0.9}
    ends = measured.partners[kept] + shift
    lines = draw_segments(upper, pixels, ends, array=disparities, **looks)
    upper.scatter(*pixels.T, s=9, c=disparities, cmap="viridis", vmin=low, vmax=high)
    if kept.any():
        label = "disparity [px]"
        figure.colorbar(lines, ax=upper, fraction=0.02, pad=0.01, extend="max", label=label)
    for axes in lower:  # those of descriptors have a picture of their own
        show_image(axes, frame.left, "corners without a match, by the first test that they failed")
        _draw_reasons(axes, measured)
        legend_below(figure, axes)
    return _picture("1_measured", figure)


def _draw_depths(explanation: FrameExplanation, frame: RgbdFrame) -> Plot:
    measured = explanation.measured
    figure = new_figure(image_height(frame.depth.shape, share=0.5) + 0.7)
    first, second = figure.subplots(1, 2)
    finite = frame.depth[np.isfinite(frame.depth)]
    top = float(np.percentile(finite, 99)) if len(finite) else 1.0
    depth = np.ma.masked_invalid(frame.depth)
    show_image(first, depth, "depth (white: unknown)", cmap="viridis_r", vmin=0.0, vmax=top)
    figure.colorbar(first.images[0], ax=first, fraction=0.04, pad=0.01, label="depth [m]")
    show_image(second, frame.image, "keypoints: with depth, and the first test the others failed")
    kept = measured.pixels[measured.are_kept]
    first.plot(*kept.T, "o", color="white", mec="black", markersize=3.0, mew=0.5)
    label = f"with depth: {len(kept)}"
    second.plot(*kept.T, "o", color=INLIERS, markersize=4.0, mfc="none", label=label)
    _draw_reasons(second, measured)
    legend_below(figure, second)
    return _picture("1_measured", figure)


def _draw_reasons(axes: Axes, sorting: Sorting, pixels: FloatArray | None = None) -> None:
    """Mark the pixels dropped, or others in their place, by the first test that they failed."""
    places, codes = sorting.pixels if pixels is None else pixels, sorting.codes
    for number, name in enumerate(sorting.tests):
        failed = codes == number
        if failed.any():
            axes.plot(
                *places[failed].T,
                color=_REASONS[number % len(_REASONS)],
                marker=_MARKERS[number % len(_MARKERS)],
                linestyle="none",
                markersize=5.0,
                label=f"{name}: {failed.sum()}",
            )


def _draw_flow(explanation: FrameExplanation) -> Plot:
    registration, reference = explanation.registration, explanation.reference
    if registration is None or reference is None:
        return _not_reached("2_flow", explanation)
    matches, image = registration.matches, explanation.image
    starts, ends = matches.pixels[matches.are_kept], matches.partners[matches.are_kept]
    if explanation.is_klt:
        share = 1.0 if is_wide(image.shape) else 0.75
        figure = new_figure(image_height(image.shape, share=share) + 0.5)
        axes = figure.subplots()
        show_image(axes, image, "from where a point was in the reference to where it is now")
        draw_segments(axes, starts, ends, colors=INLIERS)
        axes.plot(*ends.T, ".", color=INLIERS, markersize=5, label=f"kept: {len(ends)}")
        _draw_reasons(axes, matches, matches.predicted)
    else:
        figure = new_figure(pair_height(image.shape) + 0.5)
        axes = figure.subplots()
        canvas, shift = join_images(image_of(reference), image)
        show_image(axes, canvas, "reference and current image")
        draw_segments(axes, starts, ends + shift, colors=INLIERS, linewidths=0.7)
        axes.plot(*starts.T, ".", color=INLIERS, markersize=4, label=f"matched: {len(ends)}")
    legend_below(figure, axes)
    return _picture("2_flow", figure)


def _draw_corner(explanation: FrameExplanation) -> Plot:
    corner = explanation.corner
    if corner is None:
        return _picture("3_corner", None, "Not reached: no corner was kept.")
    is_stereo = isinstance(explanation.frame, StereoFrame)
    names = ("left", "right") if is_stereo else ("reference", "current image")
    figure = new_figure(2.9)
    first, second, third, curve = figure.subplots(1, 4, width_ratios=[1, 1, 1, 2.6])
    low, high = float(corner.patches[0].min()), float(corner.patches[0].max())
    for axes, patch, name in zip((first, second), corner.patches, names, strict=True):
        show_image(axes, patch, name, vmin=low, vmax=high)
    difference, limit = corner.patches[1] - corner.patches[0], 0.5 * max(high - low, 1.0)
    looks: dict[str, Any] = {"vmin": -limit, "vmax": limit}
    show_image(third, difference - difference.mean(), "difference (grey: none)", **looks)
    curve.plot(corner.columns, corner.correlations, color=_AFTER)
    curve.axvline(corner.end, color=_LIMIT, linestyle="--")
    what = "disparity [px]" if is_stereo else "pixels from the end of the track"
    curve.set(xlabel=what, ylabel="correlation along the row", ylim=(-1.05, 1.05))
    if is_stereo:
        curve.invert_xaxis()
    return _picture("3_corner", figure)


def _draw_candidates(explanation: FrameExplanation) -> Plot:
    """Mark the keypoints without a match, by the first test that all their candidates failed."""
    image, registration = explanation.image, explanation.registration
    shown = []
    if isinstance(explanation.frame, StereoFrame):
        shown.append(("in the right image", image, explanation.measured))
    if registration is not None and explanation.reference is not None:
        matches, reference = registration.matches, image_of(explanation.reference)
        shown.append(("of the reference in this frame", reference, matches))
    if not shown:
        return _not_reached("3_candidates", explanation)
    n_rows = len(shown) if is_wide(image.shape) else 1
    n_columns = len(shown) // n_rows
    share = 1.0 if is_wide(image.shape) else 0.5
    figure = new_figure(n_rows * (image_height(image.shape, share=share) + 0.6))
    parts = np.asarray(figure.subfigures(n_rows, n_columns, squeeze=False)).ravel()
    n_legend = 3 if n_columns == 1 else 2
    for part, (where, background, sorting) in zip(parts, shown, strict=True):
        axes = part.subplots()
        show_image(axes, background, f"without a match {where}")
        _draw_reasons(axes, sorting)
        if axes.get_legend_handles_labels()[1]:
            part.legend(loc="outside lower center", ncols=n_legend, frameon=False)
    return _picture("3_candidates", figure)


def _draw_consensus(explanation: FrameExplanation) -> Plot:
    registration, image = explanation.registration, explanation.image
    if registration is None:
        return _not_reached("4_consensus", explanation)
    kept, inliers = registration.matches.are_kept, registration.inliers
    starts, ends = registration.matches.pixels[kept], registration.matches.partners[kept]
    height = image_height(image.shape, share=1.0 if is_wide(image.shape) else 0.6)
    has_residuals = registration.residuals_px is not None
    figure = new_figure(height + (3.0 if has_residuals else 0.3))
    heights = [height, 2.7] if has_residuals else [height]
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
    upper, *lower = parts[:, 0]
    axes = upper.subplots()
    show_image(axes, image)
    for chosen, colour, marker, name in (
        (~inliers, OUTLIERS, "x", "disagree"),
        (inliers, INLIERS, "o", "agree"),
    ):
        draw_segments(axes, starts[chosen], ends[chosen], colors=colour)
        label = f"{name}: {chosen.sum()}"
        axes.plot(*ends[chosen].T, marker, color=colour, markersize=4, label=label)
    axes.legend(loc="upper right", frameon=True, framealpha=0.8)
    for part in lower:
        _draw_residuals(part.subplots(1, 4), registration)
    return _picture("4_consensus", figure)


def _draw_residuals(panels: Any, registration: Registration) -> None:  # noqa: ANN401
    residuals_px, whitened = registration.residuals_px, registration.whitened
    if residuals_px is None or whitened is None:
        return
    for column, name in enumerate(("u", "v", "disparity")):
        values = residuals_px[:, :, column]
        finite = values[np.isfinite(values)]
        reach = 1.1 * (float(np.percentile(np.abs(finite), 95)) if len(finite) else 1.0) + 1e-9
        _compare(panels[column], values, np.linspace(-reach, reach, 31))
        panels[column].set(xlabel=f"residual of {name} [px]")
    panels[0].set_ylabel("matches")
    panels[0].legend(loc="upper left")
    lengths = np.nan_to_num(np.linalg.norm(whitened, axis=2), nan=np.inf)
    _compare(panels[3], lengths, np.linspace(0.0, 3.0 * GATE, 31))
    panels[3].axvline(GATE, color=_LIMIT, linestyle="--", label=f"gate {GATE:g}")
    panels[3].set(xlabel="norm [sigma]")
    panels[3].legend(loc="upper right")


def _compare(axes: Axes, values: FloatArray, bins: FloatArray) -> None:
    """Draw histograms of values before and after; the outer bins take what is beyond."""
    for row, colour, name in ((0, _BEFORE, "before"), (1, _AFTER, "after")):
        shown = np.clip(values[row][~np.isnan(values[row])], bins[0], bins[-1])
        axes.hist(shown, bins.tolist(), histtype="stepfilled", alpha=0.6, color=colour, label=name)


def _draw_links(explanation: FrameExplanation) -> Plot:
    links = explanation.links
    if not links:
        return _picture("5_links", None, "None: there is no earlier frame to link to.")
    n_columns = min(_N_COLUMNS, max(len(links), 3))
    n_rows = -(-len(links) // n_columns)
    height = n_rows * (image_height(explanation.image.shape, share=1.0 / n_columns) + 0.4)
    figure = new_figure(height)
    panels = np.asarray(figure.subplots(n_rows, n_columns, squeeze=False)).ravel()
    for axes, link in zip(panels, links, strict=False):
        _draw_link(axes, link)
    for axes in panels[len(links) :]:
        axes.set_axis_off()
    return _picture("5_links", figure)


def _draw_link(axes: Axes, link: Link) -> None:
    what = {"step": "predecessor", "not linked": "keyframe, not linked"}.get(link.kind, link.kind)
    answer, registration = link.reason, link.registration
    show_image(axes, link.image)
    if isinstance(registration, RelativePose):
        pixels, inliers = registration.pixels_reference, registration.inliers
        axes.plot(*pixels[~inliers].T, "x", color=OUTLIERS, markersize=3)
        axes.plot(*pixels[inliers].T, ".", color=INLIERS, markersize=3)
        chi2 = "" if link.chi2 is None else f", chi2 {link.chi2:.2f}"
        counts = f"{registration.n_inliers} of {registration.n_matches} inliers"
        answer = f"{counts}{chi2}, {'accepted' if link.is_accepted else 'refused'}"
    colour = INLIERS if link.is_accepted else _BEFORE if link.kind == "not linked" else OUTLIERS
    axes.spines[:].set(edgecolor=colour, linewidth=3)
    head = f"frame {link.frame}, {what}, overlap {link.overlap:.2f}"
    axes.set_title("\n".join([head, *textwrap.wrap(answer, 48)]), fontsize=8, loc="left")


def _draw_times(explanation: FrameExplanation) -> Plot:
    stages = explanation.result.stage_ms
    figure = new_figure(0.9 + 0.28 * len(stages))
    axes = figure.subplots()
    colours = [STAGES.get(name, _BEFORE) for name in stages]
    bars = axes.barh([*stages], [*stages.values()], color=colours, edgecolor="black", lw=0.5)
    axes.bar_label(bars, fmt="%.1f ms", padding=3)
    axes.invert_yaxis()
    axes.set_xlabel("wall time [ms]")
    axes.margins(x=0.1)
    return _picture("6_times", figure)
