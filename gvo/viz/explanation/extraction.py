"""Pictures of what was found in the frame itself."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from gvo.config import Config
from gvo.diagnostics.explain.values import FrameExplanation, Sorting, Step
from gvo.frontend.tracking import CELL_SIZE_PX, SPACING_PX
from gvo.types import FloatArray, IntArray, RgbdFrame, StereoFrame
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    KEPT,
    LIMIT,
    MARKERS,
    REASONS,
    Picture,
    Sheet,
    count_text,
    draw_segments,
    finish_axes,
    image_height,
    is_wide,
    join_images,
    legend_below,
    paired_height,
    show_image,
)

# Cells are given their numbers where they are at least so wide in the picture, pixels.
_MIN_CELL_PX = 34.0
# Width of an image over the whole picture, pixels.
_IMAGE_PX = 1260.0


def budget_of(config: Config) -> tuple[int, int]:
    """Return the number of keypoints kept at most, and the size of the cells that share it."""
    if config.frontend.kind == "klt":
        return config.klt.n_corners, CELL_SIZE_PX
    return config.features.n_features, config.features.cell_size_px


def draw_keypoints(explanation: FrameExplanation) -> Picture:
    """Draw the keypoints and the cells that share the budget."""
    keypoints, image = explanation.keypoints, explanation.image
    budget, size = budget_of(explanation.config)
    detected = _per_cell(keypoints.pixels, size, image.shape)
    kept = _per_cell(keypoints.pixels[keypoints.are_kept], size, image.shape)
    is_klt = explanation.config.frontend.kind == "klt"
    spacing = f"; the strongest of each {SPACING_PX} px"
    caption = (
        f"{len(keypoints)} keypoints detected (grey{spacing if is_klt else ''}), {kept.sum()} kept "
        f"(blue), of a budget of {budget}. They are kept in rounds, the strongest of each cell of "
        f"{size} px first, so that they spread over the image: {np.count_nonzero(kept)} of "
        f"{kept.size} cells hold one, {np.count_nonzero(detected)} had one to offer; the fullest "
        f"keeps {kept.max()}."
    )
    stacked = is_wide(image.shape)
    height = 2 * image_height(image.shape) if stacked else image_height(image.shape, share=0.5)
    sheet = Sheet("01_keypoints", caption, height)
    first, second = sheet.panels.subplots(*((2, 1) if stacked else (1, 2)))
    show_image(first, image, "detected (grey) and kept (blue)")
    first.plot(*keypoints.pixels.T, ".", color="#CCCCCC", markersize=3.0)
    shown = keypoints.pixels[keypoints.are_kept]
    first.plot(*shown.T, "o", color=KEPT, markersize=5.0, markerfacecolor="none")
    _draw_cells(second, kept, detected, size, image.shape)
    return sheet.picture()


def _per_cell(pixels: FloatArray, size: int, shape: tuple[int, ...]) -> IntArray:
    """Count pixels by cell, shape (rows, columns), of an image of (height, width)."""
    counts = np.zeros([-(-side // size) for side in shape], dtype=np.int64)
    np.add.at(counts, tuple((pixels[:, ::-1] // size).astype(np.int64).T), 1)
    return counts


def _draw_cells(
    axes: Axes, kept: IntArray, detected: IntArray, size: int, shape: tuple[int, ...]
) -> None:
    (rows, columns), (height, width) = kept.shape, shape
    has_numbers = _IMAGE_PX / (1 if is_wide(shape) else 2) * size / width >= _MIN_CELL_PX
    edges = (-0.5, columns * size - 0.5, rows * size - 0.5, -0.5)
    title = "kept / detected in each cell" if has_numbers else "kept in each cell (darker: more)"
    vmax = max(2 * int(kept.max()), 1)
    show_image(axes, kept, title, cmap="Blues", vmax=vmax, extent=edges)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_xticks(np.arange(size, columns * size, size) - 0.5, labels=[])
    axes.set_yticks(np.arange(size, rows * size, size) - 0.5, labels=[])
    axes.tick_params(length=0)
    axes.grid(color="#BBBBBB", linewidth=0.5)
    if not has_numbers:
        return
    for (row, column), number in np.ndenumerate(detected):
        left, top = column * size, row * size
        right, bottom = min(left + size, width), min(top + size, height)
        if number and right - left > 0.9 * size and bottom - top > 0.4 * size:
            u, v = 0.5 * (left + right - 1), 0.5 * (top + bottom - 1)
            text = f"{kept[row, column]}/{number}"
            axes.text(u, v, text, fontsize=8, ha="center", va="center")


def draw_stereo(explanation: FrameExplanation) -> Picture:
    """Draw the stereo matches, and what became of the other keypoints."""
    frame, stereo = explanation.frame, explanation.measured
    if not isinstance(frame, StereoFrame):
        raise ValueError("stereo matches need a stereo frame")
    shape, kept = frame.left.shape, stereo.are_kept
    heights = [
        0.95 * paired_height(shape),
        image_height(shape, share=0.93 * (1.0 if is_wide(shape) else 0.6)) + 0.5,
    ]
    sheet = Sheet("02_stereo", _stereo_caption(explanation, stereo), sum(heights) + 0.4)
    upper, lower = sheet.panels.subplots(2, 1, height_ratios=heights)
    canvas, shift = join_images(frame.left, frame.right)
    show_image(upper, canvas, f"left and right: {kept.sum()} matches, by disparity")
    pixels, disparities = stereo.pixels[kept], stereo.values[kept]
    # A single wrong match must not take all the colours.
    low, high = np.percentile(disparities, [1, 97]) if kept.any() else (0.0, 1.0)
    colours = {"cmap": "viridis", "clim": (low, high), "linewidths": 0.9}
    ends = stereo.partners[kept] + shift
    lines = draw_segments(upper, pixels, ends, array=disparities, **colours)
    upper.scatter(*pixels.T, s=9, c=disparities, cmap="viridis", vmin=low, vmax=high)
    if kept.any():
        sheet.colorbar(lines, upper, fraction=0.02, extend="max", label="disparity [px]")
    show_image(lower, frame.left, "keypoints without a match, by the first test that they failed")
    draw_reasons(lower, stereo)
    return sheet.picture()


def _stereo_caption(explanation: FrameExplanation, stereo: Sorting) -> str:
    config, camera, rows = explanation.config.stereo, explanation.camera, ""
    low, high = (camera.depth_to_disparity(z) for z in (config.max_depth_m, config.min_depth_m))
    tests = (
        f"Tests in order: a keypoint on its rows ({config.row_tolerance_px:g} px), within the "
        f"range of disparities, of about its octave; descriptor distance {config.max_distance:g}; "
        + (
            "the ratio test is off (stereo.max_ratio 1)"
            if config.max_ratio == 1.0
            else f"ratio to the second best {config.max_ratio:g}"
        )
        + "; each the best of the other (reciprocity); a minimum for the sub-pixel fit."
    )
    if explanation.config.frontend.kind == "klt":
        rows = f"; rows of the right image are {explanation.row_offset_px:+z.3f} px off"
        tests = (
            "Each corner is searched along its row in small images (correlation), then by "
            "Gauss-Newton steps in the full ones; left and right must look alike there, and the "
            "depth lie within the limits. They serve the frames that come next: tracks into this "
            "frame are measured by themselves."
        )
    return (
        f"Of {len(stereo)} keypoints: {count_text(stereo.counts())}. {tests} Matches lie on equal "
        f"rows and to the left in the right image, by a disparity between {low:.1f} and "
        f"{high:.1f} px, the depth limits {config.max_depth_m:g} and {config.min_depth_m:g} m."
        f"\nLearnt of the rig before this frame: {explanation.offset_px:+z.3f} px are subtracted "
        f"from all disparities{rows}."
    )


def draw_reasons(
    axes: Axes, sorting: Sorting, pixels: FloatArray | None = None, n_columns: int = 4
) -> None:
    """Mark the pixels dropped, or others in their place, by reason, with a legend that counts."""
    places, counts = sorting.pixels if pixels is None else pixels, sorting.counts()
    for number, name in enumerate(sorting.names[:-1]):
        if counts[name]:
            axes.plot(
                *places[sorting.are(name)].T,
                color=REASONS[number % len(REASONS)],
                marker=MARKERS[number % len(MARKERS)],
                linestyle="none",
                markersize=6.0,
                label=f"{name}: {counts[name]}",
            )
    legend_below(axes, n_columns)


def draw_depth(explanation: FrameExplanation) -> Picture:
    """Draw the depth image and which of it is valid."""
    config, frame = explanation.config.depth, explanation.frame
    pixels = explanation.depth_pixels
    if not isinstance(frame, RgbdFrame) or pixels is None:
        raise ValueError("a depth image needs an RGB-D frame")
    counts = pixels.counts()
    shares = [f"{100 * count / len(pixels):.1f} % {name}" for name, count in counts.items()]
    caption = (
        f"Of all pixels: {', '.join(shares).replace('kept', 'valid')}. Valid depth is known, lies "
        f"between {config.min_depth_m:g} and {config.max_depth_m:g} m (depth.min_depth_m, "
        f"depth.max_depth_m) and varies by at most {100 * config.max_edge_step:g} % within "
        f"{config.edge_radius_px} px (depth.max_edge_step): at an edge, a shift of a pixel between "
        "colour and depth moves a point by far."
    )
    height = image_height(frame.depth.shape, share=0.5) + 0.6
    sheet = Sheet("02_depth", caption, height)
    first, second = sheet.panels.subplots(1, 2)
    finite = frame.depth[np.isfinite(frame.depth)]
    top = float(np.percentile(finite, 99)) if len(finite) else 1.0
    depth = np.ma.masked_invalid(frame.depth)
    show_image(first, depth, "depth (white: unknown)", cmap="viridis_r", vmin=0.0, vmax=top)
    sheet.colorbar(first.images[0], first, fraction=0.04, label="depth [m]")
    _draw_mask(second, pixels, frame.depth.shape)
    return sheet.picture()


def _draw_mask(axes: Axes, pixels: Sorting, shape: tuple[int, ...]) -> None:
    colours = ["#000000", "#D55E00", "#E69F00", KEPT]
    palette = (255 * np.array([to_rgb(colour) for colour in colours])).astype(np.uint8)
    show_image(axes, palette[pixels.codes.reshape(shape)], "which of it is valid")
    names = [*pixels.names[:-1], "valid"]
    handles = [Patch(color=c, label=name) for c, name in zip(colours, names, strict=True)]
    legend_below(axes, 4, handles=handles)


def draw_depth_keypoints(explanation: FrameExplanation) -> Picture:
    """Draw which keypoints have a valid depth."""
    depth = explanation.measured
    caption = (
        f"Of {len(depth)} keypoints: {count_text(depth.counts())}. Those kept are coloured by "
        "depth; the others are marked by the first test that they failed."
    )
    height = image_height(explanation.image.shape, share=0.75) + 0.5
    sheet = Sheet("03_depth_keypoints", caption, height)
    axes, kept = sheet.panels.subplots(1, 1), depth.are_kept
    u, v = depth.pixels[kept].T
    show_image(axes, explanation.image)
    dots = axes.scatter(u, v, s=22, c=depth.values[kept], cmap="viridis_r")
    if kept.any():
        sheet.colorbar(dots, axes, fraction=0.03, label="depth [m]")
    draw_reasons(axes, depth)
    return sheet.picture()


def draw_histograms(explanation: FrameExplanation) -> Picture:
    """Draw the distribution of disparities and depths, with the limits."""
    camera, config, measured = explanation.camera, explanation.config, explanation.measured
    values, is_stereo = measured.values[measured.are_kept], explanation.depth_pixels is None
    if is_stereo:
        what, disparities = "Disparities", values
        depths = camera.disparity_to_depth(disparities - explanation.offset_px)
    else:
        what, depths = f"Virtual disparities (baseline {camera.baseline:g} m)", values
        disparities = camera.depth_to_disparity(depths)
    limits = config.stereo if is_stereo else config.depth
    near, far = limits.min_depth_m, limits.max_depth_m
    high, low = (float(camera.depth_to_disparity(z)) for z in (near, far))
    caption = (
        f"{what} and depths of the {len(depths)} keypoints kept, {_spread(disparities, 'px')} and "
        f"{_spread(depths, 'm')} (median, 5 to 95 %). The limits of {near:g} and {far:g} m are "
        f"disparities of {high:.1f} and {low:.2f} px; they are drawn where they lie in the "
        "picture. The standard deviation of a depth is z squared times that of the disparity, over "
        f"{camera.fx * camera.baseline:.1f} px m: far points determine the rotation, near ones the "
        "translation."
    )
    sheet = Sheet("04_disparity_and_depth", caption, 3.6)
    first, second = sheet.panels.subplots(1, 2)
    _histogram(first, disparities, "disparity [px]", (low, high))
    _histogram(second, depths, "depth [m]", (near, far))
    return sheet.picture()


def _spread(values: FloatArray, unit: str) -> str:
    if len(values) == 0:
        return "none"
    low, middle, high = np.percentile(values, [5, 50, 95])
    return f"{middle:.2f} {unit} ({low:.2f} to {high:.2f})"


def _histogram(axes: Axes, values: FloatArray, label: str, limits: tuple[float, float]) -> None:
    if len(values):
        axes.hist(values, bins=40, color=KEPT)
    low, high = axes.get_xlim()
    for limit in limits:
        if low - 0.3 * (high - low) <= limit <= high + 0.3 * (high - low):
            axes.axvline(limit, color=LIMIT, linestyle="--", label=f"limit {limit:.3g}")
    finish_axes(axes, label, "keypoints", fontsize=10)


def draw_subpixel(explanation: FrameExplanation) -> Picture:
    """Draw the patches of one match and how its disparity was found."""
    step = explanation.subpixel
    if step is None:
        return Picture(name="03_subpixel", caption="No match was kept.")
    left, right = step.drawn.left, step.drawn.right
    sheet = Sheet("03_subpixel", _subpixel_caption(explanation, step), 4.0)
    axes = sheet.panels.subplots(1, 4, width_ratios=[1, 1, 1, 2.2])
    low, high = float(left.min()), float(left.max())
    show_image(axes[0], left, "left patch", vmin=low, vmax=high)
    show_image(axes[1], right, f"right, at {step.disparity_px:.2f} px", vmin=low, vmax=high)
    difference, limit = right - left, 0.5 * max(high - low, 1.0)
    difference = difference - difference.mean()
    show_image(axes[2], difference, "difference (grey: none)", vmin=-limit, vmax=limit)
    _draw_curve(axes[3], step)
    return sheet.picture()


def _subpixel_caption(explanation: FrameExplanation, step: Step) -> str:
    offset_px, (u, v), size = explanation.offset_px, step.pixel, len(step.drawn.left)
    disparity_px = step.disparity_px
    whole = max(round(disparity_px), 1)
    depth, whole_depth = (
        float(explanation.camera.disparity_to_depth(d - offset_px)) for d in (disparity_px, whole)
    )
    return (
        f"Of all matches kept, the one of the median horizontal gradient, at ({u:.0f}, {v:.0f}) in "
        f"the left image: patches of {size} x {size} px and their difference, and the sum of "
        f"squared differences, means removed, over the disparity. {_subpixel_method(step)} It ends "
        f"at {disparity_px:.3f} px, "
        + (f"less the learnt {offset_px:+z.3f} px " if offset_px else "")
        + f"a depth of {depth:.2f} m; the nearest whole pixel would be {whole} px, "
        f"{whole_depth:.2f} m."
    )


def _subpixel_method(step: Step) -> str:
    method, iterates_px = step.method, step.iterates_px
    if method == "none":
        return "The sub-pixel fit is off (stereo.subpixel none)."
    if method == "parabola":
        return (
            f"The search starts at the keypoints' whole pixels, {iterates_px[0]:.0f} px; the "
            "vertex of the parabola through the best column and its neighbours gives the fraction."
        )
    steps = np.diff(iterates_px)
    return (
        f"The coarse search gives {iterates_px[0]:.2f} px; {len(steps)} Gauss-Newton steps "
        f"follow ({', '.join(f'{each:+z.3f}' for each in steps)} px). They use the gradients of "
        "the left patch: where left and right differ a little, they end beside the minimum of the "
        "curve. Between whole pixels the right image is interpolated, which smooths its noise: "
        "hence the kinks."
    )


def _draw_curve(axes: Axes, step: Step) -> None:
    columns, ssd, iterates_px = step.columns_px, step.ssd, step.iterates_px
    is_sampled = step.method == "parabola"
    axes.plot(columns, ssd, "o-" if is_sampled else "-", color=BEFORE, label="SSD of the patches")
    if is_sampled:
        best = int(np.clip(ssd.argmin(), 1, len(ssd) - 2))
        near = slice(best - 1, best + 2)
        shown = np.linspace(columns[best] - 1.2, columns[best] + 1.2, 50)
        fitted = np.polyval(np.polyfit(columns[near], ssd[near], 2), shown)
        axes.plot(shown, fitted, color=AFTER, label="parabola")
    elif step.method == "gauss-newton":
        at_steps = np.interp(iterates_px, columns, ssd)
        label = "Gauss-Newton steps"
        axes.plot(iterates_px, at_steps, "o-", color=AFTER, markersize=5, label=label)
    end_px = step.disparity_px
    axes.axvline(end_px, color=LIMIT, linestyle="--", label=f"end: {end_px:.3f} px")
    axes.set_ylim(0.0, 1.4 * float(ssd.max()))
    labels = "disparity [px]", "squared difference [grey²]"
    finish_axes(axes, *labels, loc="upper center", ncols=2)


OF_STEREO = draw_stereo, draw_subpixel
OF_DEPTH = draw_depth, draw_depth_keypoints
"""What is drawn of the frame between its keypoints and the histograms, by sensor."""
