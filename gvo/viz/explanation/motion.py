"""Pictures of the way from matches to a motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.diagnostics.explain.values import (
    ConsensusStep,
    FrameExplanation,
    RefinementStep,
    SampleSearch,
    TemporalStep,
)
from gvo.frontend.klt import image_of
from gvo.types import BoolArray, FloatArray
from gvo.viz.explanation.extraction import draw_reasons
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    KEPT,
    LIMIT,
    REFUSED,
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
    show_image,
    split,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_N_CROPS = 6


def draw_matches(explanation: FrameExplanation, step: TemporalStep) -> Picture:
    """Draw the matches as flow, side by side, and some of them near."""
    if explanation.reference is None:
        raise ValueError("matches need a reference frame")
    image, reference = explanation.image, image_of(explanation.reference)
    title = f"Matches with frame {explanation.reference_index}"
    caption = _matches_caption(explanation, step)
    heights = [
        image_height(image.shape, share=1.0 if is_wide(image.shape) else 0.6) + 0.4,
        paired_height(image.shape),
        2.4,
    ]
    sheet = open_sheet(sum(heights) + 0.4, title, caption)
    upper, middle, lower = split(sheet.panels, heights)
    kept = step.sorting.are_kept
    flow = upper.subplots(1, 1)
    show_image(flow, image, "flow over the current image: from where a point was to where it is")
    draw_segments(flow, step.reference_pixels[kept], step.found[kept], colors=KEPT)
    flow.plot(*step.found[kept].T, ".", color=KEPT, markersize=5, label=f"kept: {kept.sum()}")
    _draw_dropped(flow, step)
    legend_below(flow, 5)
    pair = middle.subplots(1, 1)
    canvas, shift = join_images(reference, image)
    show_image(pair, canvas, "reference and current image")
    draw_segments(
        pair, step.reference_pixels[kept], step.found[kept] + shift, colors=KEPT, linewidths=0.7
    )
    _draw_crops(lower.subplots(1, _N_CROPS), explanation, step)
    return close_sheet(sheet, "05_matches", title, caption)


def _draw_dropped(axes: Axes, step: TemporalStep) -> None:
    """Mark what was dropped where it was expected, as far as that is in the image."""
    pixels = np.where(np.isfinite(step.predicted), step.predicted, np.nan)
    draw_reasons(axes, pixels, step.sorting)


def _matches_caption(explanation: FrameExplanation, step: TemporalStep) -> str:
    radius = step.radius_px
    if step.method == "tracks":
        start = (
            "the pixels that the predicted motion gives" if step.has_prior else "their own pixels"
        )
        wide = ", with the wide pyramid and followed back" if step.is_wide else ""
        how = (
            f"Windows of {2 * radius + 1:g} x {2 * radius + 1:g} px are tracked by Lucas-Kanade "
            f"from {start}{wide}, then "
            "measured in 3-D where they end."
        )
    else:
        how = (
            f"Descriptors are compared within {radius:g} px of the "
            f"{'predicted' if step.has_prior else 'previous'} pixels."
        )
    kept = step.sorting.are_kept
    flow = np.linalg.norm(step.found[kept] - step.reference_pixels[kept], axis=1)
    error = np.linalg.norm(step.found[kept] - step.predicted[kept], axis=1)
    numbers = (
        f" Points move by {np.median(flow):.1f} px (median, at most {flow.max():.1f}); they are "
        f"{np.median(error):.1f} px (median, at most {error.max():.1f}) from where they were "
        "expected."
        if len(flow)
        else ""
    )
    return (
        f"Of {len(step.sorting)} points of the reference: {count_text(step.sorting.counts())}. "
        f"{how}{numbers} Dropped points are marked where they were expected; those expected "
        "outside of the image are not shown.\n"
        + (f"Below: six matches near, {_crop_words(step)}\n" if len(flow) else "")
        + "Attempts: "
        + "; ".join(explanation.attempts)
        + "."
    )


def _crop_words(step: TemporalStep) -> str:
    if step.method == "tracks":
        return (
            "the predicted pixel (orange-red cross), the window there (dashed) and where it ended "
            "(blue)."
        )
    return (
        "the predicted pixel (orange-red cross), the search radius (dashed) and the match (blue)."
    )


def _draw_crops(
    panels: np.ndarray[tuple[int, ...], np.dtype[np.object_]],
    explanation: FrameExplanation,
    step: TemporalStep,
) -> None:
    """Show matches near: those that spread evenly over the errors of the prediction."""
    kept = np.flatnonzero(step.sorting.are_kept)
    errors = np.linalg.norm(step.found[kept] - step.predicted[kept], axis=1)
    order = kept[np.argsort(errors, kind="stable")]
    chosen = order[np.linspace(0, len(order) - 1, _N_CROPS).astype(int)] if len(order) else order
    for axes, index in zip(panels, chosen, strict=False):
        reach = max(2.2 * step.radius_px, 18.0)
        show_image(axes, explanation.image)
        _draw_search(axes, step, int(index))
        middle = step.predicted[index]
        reach = max(reach, 1.2 * float(np.abs(step.found[index] - middle).max()) + 6.0)
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] + reach, middle[1] - reach)
        error = np.linalg.norm(step.found[index] - middle)
        axes.set_title(f"{error:.1f} px off", fontsize=10)
    for axes in panels[len(chosen) :]:
        axes.set_axis_off()


def _draw_search(axes: Axes, step: TemporalStep, index: int) -> None:
    from matplotlib.patches import Circle, Rectangle

    (u, v), radius = step.predicted[index], step.radius_px
    options: dict[str, Any] = {
        "fill": False,
        "edgecolor": LIMIT,
        "linestyle": "--",
        "linewidth": 1.2,
    }
    if step.method == "tracks":
        side = 2 * radius + 1
        axes.add_patch(Rectangle((u - side / 2, v - side / 2), side, side, **options))
        corner = step.found[index] - side / 2
        axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=KEPT, linewidth=1.5))
    else:
        axes.add_patch(Circle((u, v), radius, **options))
    axes.plot(u, v, "+", color=LIMIT, markersize=11, markeredgewidth=1.6)
    axes.plot(*step.found[index], "o", color=KEPT, markersize=6, markerfacecolor="none", mew=1.6)


def draw_consensus(explanation: FrameExplanation, step: ConsensusStep) -> Picture:
    """Draw which matches agree on a motion, and what the samples found."""
    title, image = "Consensus: which matches agree on a motion", explanation.image
    n = len(step.pixels_reference)
    inliers = np.zeros(n, np.bool_) if step.inliers is None else step.inliers
    caption = _consensus_caption(explanation, step, int(inliers.sum()))
    stacked = is_wide(image.shape)
    height = image_height(image.shape, share=1.0 if stacked else 0.5) + 0.4
    sheet = open_sheet(height + (3.0 if stacked else 0.4), title, caption)
    if stacked:
        upper, lower = sheet.panels.subplots(2, 1, height_ratios=[height, 3.0])
    else:
        upper, lower = sheet.panels.subplots(1, 2)
    show_image(upper, image, "")
    for chosen, colour, marker, name in (
        (~inliers, REFUSED, "x", "disagree"),
        (inliers, KEPT, "o", "agree"),
    ):
        if chosen.any():
            start, end = step.pixels_reference[chosen], step.pixels_current[chosen]
            draw_segments(upper, start, end, colors=colour)
            upper.plot(*end.T, marker, color=colour, markersize=4, label=f"{name}: {chosen.sum()}")
    if n:
        legend_below(upper, 2)
    _draw_samples(lower, step, n)
    return close_sheet(sheet, "06_consensus", title, caption)


def _consensus_caption(explanation: FrameExplanation, step: ConsensusStep, n_inliers: int) -> str:
    n, ransac = len(step.pixels_reference), explanation.config.ransac
    metric = (
        f"{ransac.inlier_threshold_px:g} px in (u, v, disparity)"
        if ransac.inlier_metric == "reprojection"
        else f"{ransac.inlier_threshold_m:g} m"
    )
    text = f"A match agrees with a motion where it is less than {metric} off. "
    if step.n_agreeing is not None:
        text += (
            f"{step.n_agreeing} of {n} matches agree with the predicted motion; from "
            f"{int(np.ceil(step.n_needed))} on no samples are drawn. "
        )
    if step.is_known:
        text += (
            "So none were drawn: these matches and the predicted motion are where the refinement "
            "starts. The curve shows what the samples would have found: "
        )
    text += _search_text(step.search)
    if step.inliers is not None and not step.is_known:
        text += f" Refitted to its inliers, {n_inliers} of {n} agree."
    return text


def _search_text(search: SampleSearch) -> str:
    if not len(search.counts):
        return search.reason + "." if search.reason else "no samples."
    best = int(search.counts.max())
    text = (
        f"{len(search.counts)} of at most {search.n_planned} samples of three of the "
        f"{search.n_near} points with disparity enough; the best one finds {best}"
    )
    if search.is_stopped_early:
        text += (
            f"; stopped early, as {100 * search.share:.0f} % of those points agree with it and not "
            "having drawn a sample without outliers is less likely than one in a thousand"
        )
    text += "."
    if search.inliers is None:
        text += f" It fails: {search.reason}."
    return text


def _draw_samples(axes: Axes, step: ConsensusStep, n_matches: int) -> None:
    counts = step.search.counts
    number = np.arange(1, len(counts) + 1)
    is_fitted = counts >= 0
    axes.plot(number[is_fitted], counts[is_fitted], ".", color=BEFORE, label="one sample")
    if len(counts):
        best = np.maximum.accumulate(counts)
        axes.step(number, np.maximum(best, 0), where="post", color=AFTER, label="best so far")
    if step.search.is_stopped_early and len(counts):
        axes.axvline(len(counts), color=LIMIT, linestyle="--", label=f"stopped after {len(counts)}")
    axes.axhline(n_matches, color="black", linestyle=":", label=f"all {n_matches} matches")
    axes.set_xlim(0, max(step.search.n_planned, 1) * 1.02)
    axes.set_ylim(0, 1.25 * max(n_matches, 1))
    axes.set_xlabel("sample")
    axes.set_ylabel("inliers")
    axes.set_title(
        "what the samples would have found" if step.is_known else "what the samples found",
        fontsize=11,
        loc="left",
    )
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(loc="upper right", ncols=4, fontsize=9)


def draw_residuals(explanation: FrameExplanation, step: RefinementStep) -> Picture:
    """Draw the residuals before and after the refinement."""
    title = "Residuals before and after the refinement"
    norms = np.linalg.norm(step.whitened, axis=2)
    caption = _residuals_caption(explanation, step, norms)
    sheet = open_sheet(6.8, title, caption)
    axes = sheet.panels.subplots(2, 3)
    for column, name in enumerate(("u", "v", "disparity")):
        _compare(axes[0, column], step.residuals_px[:, :, column], f"residual of {name} [px]")
    _draw_norms(axes[1, 0], norms, step.gate)
    inliers = step.inliers[1]
    _draw_cloud(axes[1, 1], step.whitened[1], inliers, step.gate)
    _draw_by_depth(axes[1, 2], step, inliers)
    return close_sheet(sheet, "07_residuals", title, caption)


def _residuals_caption(
    explanation: FrameExplanation, step: RefinementStep, norms: FloatArray
) -> str:
    def median(values: FloatArray) -> str:
        return ", ".join(f"{each:.2f}" for each in np.nanmedian(np.abs(values), axis=0))

    start = "the predicted pose" if _starts_at_prediction(explanation) else "the pose of RANSAC"
    moved = step.T_target_source[2] @ np.linalg.inv(step.T_target_source[0])
    angle = np.degrees(np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0)))
    return (
        f"Measured less predicted, of {norms.shape[1]} matches. Before, at {start}: medians of the "
        f"absolute residuals of (u, v, disparity) {median(step.residuals_px[0])} px; after "
        f"{step.n_steps} Gauss-Newton steps, which moved the pose by "
        f"{1e3 * np.linalg.norm(moved[:3, 3]):.1f} mm and {angle:.3f} deg: "
        f"{median(step.residuals_px[1])} px. Whitened, that is in sigmas of both frames' noise "
        f"carried through the motion; the root mean square of what the pose rests on is "
        f"{step.scale:.2f}, one where the stated sigmas are right. {_gate_text(step)}"
    )


def _gate_text(step: RefinementStep) -> str:
    before, after = int(step.inliers[0].sum()), int(step.inliers[1].sum())
    if step.n_within is None:
        return f"Pose and matches stay as they are, {after} (registration.refine none)."
    gate = f"The gate of {step.gate:g} sigma (registration.gate)"
    if step.n_within == after:
        return (
            f"{gate} chooses the matches again after the first steps: {before} before, "
            f"{after} after."
        )
    return (
        f"{gate} would leave {step.n_within} matches after the first steps, less than half: the "
        f"{before} from before stay, those far off with less weight. The residuals are larger than "
        "the stated sigmas here."
    )


def _starts_at_prediction(explanation: FrameExplanation) -> bool:
    return explanation.consensus is not None and explanation.consensus.is_known


def _compare(axes: Axes, values: FloatArray, label: str) -> None:
    finite = values[np.isfinite(values)]
    reach = float(np.percentile(np.abs(finite), 95)) if len(finite) else 1.0
    bins = np.linspace(-1.1 * reach - 1e-9, 1.1 * reach + 1e-9, 41).tolist()
    for row, colour, name in ((0, BEFORE, "before"), (1, AFTER, "after")):
        clipped = np.clip(values[row][np.isfinite(values[row])], bins[0], bins[-1])
        axes.hist(clipped, bins=bins, histtype="stepfilled", alpha=0.6, color=colour, label=name)
    axes.locator_params(axis="x", nbins=7)
    axes.set_xlabel(f"{label}, outer bins: beyond")
    axes.set_ylabel("matches")
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(fontsize=9)


def _draw_norms(axes: Axes, norms: FloatArray, gate: float) -> None:
    top = 3.0 * gate
    bins = np.linspace(0.0, top, 46).tolist()
    for row, colour, name in ((0, BEFORE, "before"), (1, AFTER, "after")):
        clipped = np.minimum(np.nan_to_num(norms[row], nan=top), top)
        axes.hist(clipped, bins=bins, histtype="stepfilled", alpha=0.6, color=colour, label=name)
    axes.axvline(gate, color=LIMIT, linestyle="--", label=f"gate {gate:g}")
    axes.set_xlabel("whitened norm [sigma], last bin: beyond")
    axes.set_ylabel("matches")
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(fontsize=9)


def _draw_cloud(axes: Axes, whitened: FloatArray, inliers: BoolArray, gate: float) -> None:
    reach = 2.0 * gate
    shown = np.clip(whitened, -reach, reach)
    axes.plot(*shown[~inliers, :2].T, "x", color=REFUSED, markersize=5, label="outliers")
    axes.plot(*shown[inliers, :2].T, ".", color=KEPT, markersize=6, label="inliers")
    circle = gate * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 100))
    axes.plot(circle.real, circle.imag, "--", color=LIMIT, linewidth=1.0, label="gate")
    axes.set_aspect("equal")
    axes.set_xlim(-1.05 * reach, 1.05 * reach)
    axes.set_ylim(-1.05 * reach, 1.45 * reach)
    axes.set_xlabel("after, whitened u [sigma], at the border: beyond")
    axes.set_ylabel("whitened v [sigma]")
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(fontsize=9, ncols=3, loc="upper center", columnspacing=0.8, handletextpad=0.2)


def _draw_by_depth(axes: Axes, step: RefinementStep, inliers: BoolArray) -> None:
    depths = step.correspondences.target_points[:, 2]
    reach = 2.0 * step.gate
    shown = np.clip(step.whitened[1, :, 2], -reach, reach)
    axes.plot(depths[~inliers], shown[~inliers], "x", color=REFUSED, markersize=5, label="outliers")
    axes.plot(depths[inliers], shown[inliers], ".", color=KEPT, markersize=6, label="inliers")
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_ylim(-1.05 * reach, 1.45 * reach)
    axes.set_xlabel("depth [m]")
    axes.set_ylabel("after, whitened disparity [sigma],\nat the border: beyond")
    axes.grid(color=BEFORE, alpha=0.3)
    axes.legend(fontsize=9, ncols=2, loc="upper center")
