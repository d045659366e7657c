"""Pictures of what was found in the frame itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gvo.diagnostics.explain.values import (
    DepthStep,
    FrameExplanation,
    KeypointStep,
    Sorting,
    StereoStep,
)
from gvo.types import FloatArray, ImageArray, StereoFrame
from gvo.viz.explanation.sheet import (
    BEFORE,
    KEPT,
    LIMIT,
    Picture,
    close_sheet,
    count_text,
    draw_segments,
    image_height,
    is_wide,
    join_images,
    legend_below,
    open_sheet,
    paired_height,
    reason_style,
    show_image,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Cells are given their numbers where they are at least so wide in the picture, pixels.
_MIN_CELL_PX = 34.0


def draw_keypoints(explanation: FrameExplanation) -> Picture:
    """Draw the keypoints and the cells that share the budget."""
    step, image = explanation.keypoints, explanation.image
    detected, kept = (step.per_cell(each, image.shape) for each in (step.detected, step.kept))
    title = "Keypoints and buckets"
    caption = (
        f"{len(step.detected)} keypoints detected (grey{_detection(explanation)}), "
        f"{len(step.kept)} kept (blue), of a budget of {step.budget}. They are kept in rounds, "
        f"the strongest of each cell of {step.cell_size_px} px first, so that no part of the "
        "image takes it all: "
        f"{np.count_nonzero(kept)} of {kept.size} cells hold one, {np.count_nonzero(detected)} "
        f"had one to offer; the fullest keeps {kept.max()}."
    )
    stacked = is_wide(image.shape)
    height = 2 * image_height(image.shape) if stacked else image_height(image.shape, share=0.5)
    sheet = open_sheet(height, title, caption)
    shape = (2, 1) if stacked else (1, 2)
    first, second = sheet.panels.subplots(*shape)
    show_image(first, image, "detected (grey) and kept (blue)")
    first.plot(*step.detected.T, ".", color="#CCCCCC", markersize=3.0)
    first.plot(*step.kept.T, "o", color=KEPT, markersize=5.0, markerfacecolor="none")
    width_px = 1260.0 / (1 if stacked else 2)
    _draw_cells(
        second, (kept, detected), step, image, width_px * step.cell_size_px / image.shape[1]
    )
    return close_sheet(sheet, "01_keypoints", title, caption)


def _detection(explanation: FrameExplanation) -> str:
    if explanation.config.frontend.kind != "klt":
        return ""
    return f"; the strongest of each {explanation.config.klt.min_distance_px} px"


def _draw_cells(
    axes: Axes,
    counts: tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], ...],
    step: KeypointStep,
    image: ImageArray,
    cell_px: float,
) -> None:
    kept, detected = counts
    has_numbers = cell_px >= _MIN_CELL_PX
    title = "kept / detected in each cell" if has_numbers else "kept in each cell (darker: more)"
    rows, columns = kept.shape
    size = step.cell_size_px
    axes.imshow(
        kept,
        cmap="Blues",
        vmin=0,
        vmax=max(2 * int(kept.max()), 1),
        extent=(-0.5, columns * size - 0.5, rows * size - 0.5, -0.5),
    )
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_xticks(np.arange(size, columns * size, size) - 0.5, labels=[])
    axes.set_yticks(np.arange(size, rows * size, size) - 0.5, labels=[])
    axes.tick_params(length=0)
    axes.grid(color="#BBBBBB", linewidth=0.5)
    axes.set_title(title, fontsize=11, loc="left")
    if not has_numbers:
        return
    for (row, column), number in np.ndenumerate(detected):
        right = min((column + 1) * size, image.shape[1])
        bottom = min((row + 1) * size, image.shape[0])
        if number and right - column * size > 0.9 * size and bottom - row * size > 0.4 * size:
            middle = (0.5 * (column * size + right) - 0.5, 0.5 * (row * size + bottom) - 0.5)
            axes.text(
                *middle, f"{kept[row, column]}/{number}", fontsize=8, ha="center", va="center"
            )


def draw_stereo(explanation: FrameExplanation, step: StereoStep) -> Picture:
    """Draw the stereo matches, and what became of the other keypoints."""
    frame = explanation.frame
    if not isinstance(frame, StereoFrame):
        raise ValueError("stereo matches need a stereo frame")
    title, counts = "Stereo matches", step.sorting.counts()
    rows = ""
    if explanation.config.frontend.kind == "klt":
        rows = f"; rows of the right image are {explanation.row_offset_px:+.3f} px off"
    caption = (
        f"Of {len(step.sorting)} keypoints: {count_text(counts)}. {_stereo_tests(explanation)} "
        f"Matches lie on equal rows and to the left in the right image, by a disparity between "
        f"{step.min_disparity_px:.1f} and {step.max_disparity_px:.1f} px, the depth limits "
        f"{explanation.config.stereo.max_depth_m:g} and "
        f"{explanation.config.stereo.min_depth_m:g} m."
        f"\nLearnt of the rig before this frame: {explanation.offset_px:+.3f} px are taken off "
        f"all disparities{rows}."
    )
    ratios = [
        0.95 * paired_height(frame.left.shape),
        image_height(frame.left.shape, share=0.93 * _lower(frame)) + 0.5,
    ]
    sheet = open_sheet(sum(ratios), title, caption)
    upper, lower = sheet.panels.subplots(2, 1, height_ratios=ratios)
    canvas, shift = join_images(frame.left, frame.right)
    show_image(upper, canvas, f"left and right: {counts['kept']} matches, by disparity")
    kept = step.sorting.are_kept
    # A single wrong match must not take all the colours.
    clim = tuple(np.percentile(step.disparities[kept], [1, 97])) if kept.any() else (0.0, 1.0)
    lines = draw_segments(
        upper,
        step.pixels[kept],
        step.partners[kept] + shift,
        array=step.disparities[kept],
        cmap="viridis",
        clim=clim,
        linewidths=0.9,
    )
    u, v = step.pixels[kept].T
    upper.scatter(u, v, s=9, c=step.disparities[kept], cmap="viridis", vmin=clim[0], vmax=clim[1])
    if kept.any():
        bar = sheet.figure.colorbar(lines, ax=upper, fraction=0.02, pad=0.01, extend="max")
        bar.set_label("disparity [px]")
    show_image(lower, frame.left, "keypoints without a match, by the first test that they failed")
    draw_reasons(lower, step.pixels, step.sorting)
    legend_below(lower, 4)
    return close_sheet(sheet, "02_stereo", title, caption)


def _lower(frame: StereoFrame) -> float:
    return 1.0 if is_wide(frame.left.shape) else 0.6


def _stereo_tests(explanation: FrameExplanation) -> str:
    stereo = explanation.config.stereo
    if explanation.config.frontend.kind == "klt":
        return (
            "Each corner is looked for along its row in small images (correlation), then by "
            "Gauss-Newton steps in the full ones; left and right must look alike there, and the "
            "depth lie within the limits. They serve the frames that come next: the tracks into "
            "this frame are measured by themselves."
        )
    ratio = (
        "the ratio test is off (stereo.max_ratio 1)"
        if stereo.max_ratio == 1.0
        else f"ratio to the second best {stereo.max_ratio:g}"
    )
    return (
        f"Tests in order: a keypoint on its rows ({stereo.row_tolerance_px:g} px), within the "
        f"range of disparities, of about its octave; descriptor distance {stereo.max_distance:g}; "
        f"{ratio}; each the best of the other (reciprocity); a minimum for the sub-pixel fit."
    )


def draw_reasons(axes: Axes, pixels: FloatArray, sorting: Sorting) -> None:
    """Mark dropped pixels by their reasons, with a legend that counts."""
    number = 0
    for name, count in sorting.counts().items():
        if name == "kept":
            continue
        style = reason_style(number)
        number += 1
        if count:
            axes.plot(*pixels[sorting.are(name)].T, **style, label=f"{name}: {count}")


def draw_depth(explanation: FrameExplanation, step: DepthStep) -> Picture:
    """Draw the depth image and which of it counts as valid."""
    title, config = "Depth and what of it is valid", explanation.config.depth
    counts, n = step.pixel_sorting.counts(), step.depth.size
    shares = ", ".join(f"{100 * number / n:.1f} % {name}" for name, number in counts.items())
    caption = (
        f"Of all pixels: {shares.replace('kept', 'valid')}. Valid depth is known, lies between "
        f"{config.min_depth_m:g} and {config.max_depth_m:g} m (depth.min_depth_m, "
        f"depth.max_depth_m) and varies by at most {100 * config.max_edge_step:g} % within "
        f"{config.edge_radius_px} px (depth.max_edge_step): at an edge, a shift of a pixel between "
        "colour and depth moves a point by far."
    )
    sheet = open_sheet(image_height(step.depth.shape, share=0.5) + 0.6, title, caption)
    first, second = sheet.panels.subplots(1, 2)
    finite = step.depth[np.isfinite(step.depth)]
    shown = np.ma.masked_invalid(step.depth)
    top = float(np.percentile(finite, 99)) if len(finite) else 1.0
    show_image(first, shown, "depth (white: unknown)", cmap="viridis_r", vmin=0.0, vmax=top)
    mappable = first.images[0]
    sheet.panels.colorbar(mappable, ax=first, fraction=0.04, pad=0.01, label="depth [m]")
    _draw_mask(second, step.pixel_sorting, step.depth.shape)
    return close_sheet(sheet, "02_depth", title, caption)


def _draw_mask(axes: Axes, sorting: Sorting, shape: tuple[int, ...]) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    colours = ["#000000", "#D55E00", "#E69F00", KEPT]
    palette = (255 * np.array([to_rgb(colour) for colour in colours])).astype(np.uint8)
    show_image(axes, palette[sorting.codes.reshape(shape)], "what of it is valid")
    handles = [
        Patch(color=colour, label=name.replace("kept", "valid"))
        for colour, name in zip(colours, sorting.names, strict=True)
    ]
    axes.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.01),
        ncols=4,
        fontsize=10,
        frameon=False,
    )


def draw_depth_keypoints(explanation: FrameExplanation, step: DepthStep) -> Picture:
    """Draw which keypoints have a depth to rely on."""
    title = "Keypoints with depth"
    caption = (
        f"Of {len(step.sorting)} keypoints: {count_text(step.sorting.counts())}. Those kept are "
        "coloured by depth; the others are marked by the first test that they failed."
    )
    shape = explanation.image.shape
    sheet = open_sheet(image_height(shape, share=0.75) + 0.5, title, caption)
    axes = sheet.panels.subplots(1, 1)
    show_image(axes, explanation.image)
    kept = step.sorting.are_kept
    u, v = step.pixels[kept].T
    dots = axes.scatter(u, v, s=22, c=step.depths[kept], cmap="viridis_r")
    if kept.any():
        sheet.panels.colorbar(dots, ax=axes, fraction=0.03, pad=0.01, label="depth [m]")
    draw_reasons(axes, step.pixels, step.sorting)
    if not kept.all():
        legend_below(axes, 4)
    return close_sheet(sheet, "03_depth_keypoints", title, caption)


def draw_histograms(explanation: FrameExplanation) -> Picture:
    """Draw how disparities and depths are spread, with the limits."""
    stereo, depth, config = explanation.stereo, explanation.depth, explanation.config
    title = "Disparity and depth"
    camera = explanation.camera
    if stereo is not None:
        disparities = stereo.disparities[stereo.sorting.are_kept]
        depths = camera.disparity_to_depth(disparities - explanation.offset_px)
        limits = config.stereo.min_depth_m, config.stereo.max_depth_m
        what = "Disparities"
    elif depth is not None:
        depths = depth.depths[depth.sorting.are_kept]
        disparities = camera.depth_to_disparity(depths)
        limits = config.depth.min_depth_m, config.depth.max_depth_m
        what = f"Virtual disparities (baseline {camera.baseline:g} m)"
    else:
        disparities = depths = np.zeros(0)
        limits, what = (0.0, 0.0), "Disparities"
    bounds = camera.depth_to_disparity(limits[1]), camera.depth_to_disparity(limits[0])
    caption = (
        f"{what} and depths of the {len(depths)} keypoints kept, {_spread(disparities, 'px')} "
        "and "
        f"{_spread(depths, 'm')} (median, 5 to 95 %). The limits of {limits[0]:g} and "
        f"{limits[1]:g} m are disparities of {bounds[1]:.1f} and {bounds[0]:.2f} px; they are "
        "drawn where they lie in the picture. A depth is known to z squared times the noise of the "
        f"disparity over {camera.fx * camera.baseline:.1f} px m: far points hold the rotation, "
        "near ones the translation."
    )
    sheet = open_sheet(3.6, title, caption)
    first, second = sheet.panels.subplots(1, 2)
    _histogram(first, disparities, "disparity [px]", bounds)
    _histogram(second, depths, "depth [m]", limits)
    return close_sheet(sheet, "04_disparity_and_depth", title, caption)


def _spread(values: FloatArray, unit: str) -> str:
    if len(values) == 0:
        return "none"
    low, middle, high = np.percentile(values, [5, 50, 95])
    return f"{middle:.2f} {unit} ({low:.2f} to {high:.2f})"


def _histogram(
    axes: Axes,
    values: FloatArray,
    label: str,
    limits: tuple[FloatArray | float, FloatArray | float],
) -> None:
    if len(values):
        axes.hist(values, bins=40, color=KEPT)
    low, high = axes.get_xlim()
    for limit in (float(limits[0]), float(limits[1])):
        if low - 0.3 * (high - low) <= limit <= high + 0.3 * (high - low):
            axes.axvline(limit, color=LIMIT, linestyle="--", label=f"limit {limit:.3g}")
    axes.set_xlabel(label)
    axes.set_ylabel("keypoints")
    axes.grid(color=BEFORE, alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend()
