"""Pictures of the way from matches to a motion, of the pose and of its edges."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
from scipy.spatial.transform import Rotation

from gvo._text import number_text
from gvo.diagnostics.explain.steps import has_prior
from gvo.diagnostics.explain.values import FrameExplanation, Sorting, Step
from gvo.frontend.klt import image_of
from gvo.types import FloatArray, RelativePose
from gvo.viz.explanation.extraction import draw_reasons
from gvo.viz.explanation.sheet import (
    AFTER,
    BEFORE,
    KEPT,
    LIMIT,
    REFUSED,
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
    split,
)

_N_CROPS = 6
_N_COLUMNS = 4


def draw_matches(explanation: FrameExplanation) -> Picture:
    """Draw the matches as flow, side by side, and some of them enlarged."""
    image, matches, reference = explanation.image, explanation.matches, explanation.reference
    if matches is None or reference is None:
        return _not_reached("05_matches", explanation)
    heights = [
        image_height(image.shape, share=1.0 if is_wide(image.shape) else 0.6) + 0.4,
        paired_height(image.shape),
        2.4,
    ]
    sheet = Sheet("05_matches", _matches_caption(explanation, matches), sum(heights) + 0.4)
    upper, middle, lower = split(sheet.panels, heights)
    starts, ends = matches.pixels[matches.are_kept], matches.partners[matches.are_kept]
    flow, pair = upper.subplots(1, 1), middle.subplots(1, 1)
    show_image(flow, image, "flow over the current image: from where a point was to where it is")
    draw_segments(flow, starts, ends, colors=KEPT)
    flow.plot(*ends.T, ".", color=KEPT, markersize=5, label=f"kept: {len(ends)}")
    draw_reasons(flow, matches, matches.predicted, n_columns=5)
    canvas, shift = join_images(image_of(reference), image)
    show_image(pair, canvas, "reference and current image")
    draw_segments(pair, starts, ends + shift, colors=KEPT, linewidths=0.7)
    _draw_crops(lower.subplots(1, _N_CROPS), explanation, matches)
    return sheet.picture()


def _not_reached(name: str, explanation: FrameExplanation) -> Picture:
    why = explanation.result.reason or "this is the first frame, there is none to compare with"
    return Picture(name=name, caption=f"Not reached: {why}.")


def _matches_caption(explanation: FrameExplanation, matches: Sorting) -> str:
    values, numbers, crops = explanation.attempt.find("attempt"), "", ""
    radius, is_predicted = values["radius_px"], has_prior(explanation.attempt)
    if values["method"] == "tracks":
        start = "the pixels that the predicted motion gives" if is_predicted else "their own pixels"
        wide = ", with the wide pyramid and checked backwards" if values["is_wide"] else ""
        side = 2 * radius + 1
        how = (
            f"Windows of {side:g} x {side:g} px are tracked by Lucas-Kanade from {start}{wide}, "
            "aligned as they look after that motion, then measured in 3-D where they end."
        )
        marks = "the window there (dashed) and where it ended (blue)"
    else:
        place = "predicted" if is_predicted else "previous"
        how = f"Descriptors are compared within {radius:g} px of the {place} pixels."
        marks = "the search radius (dashed) and the match (blue)"
    kept = matches.are_kept
    if kept.any():
        flow, error = (
            np.linalg.norm(matches.partners[kept] - each[kept], axis=1)
            for each in (matches.pixels, matches.predicted)
        )
        numbers = (
            f" Points move by {np.median(flow):.1f} px (median, at most {flow.max():.1f}); they "
            f"are {np.median(error):.1f} px (median, at most {error.max():.1f}) from where they "
            "were expected."
        )
        if explanation.row_motion_px is not None:
            numbers += (
                f" For a readout of {explanation.readout_ms:.1f} ms they are moved by at most "
                f"{explanation.row_motion_px:.2f} px to the middle of the exposure."
            )
        crops = f"Below: six matches enlarged, the predicted pixel (orange-red cross), {marks}.\n"
    return (
        f"Of {len(matches)} points of frame {explanation.reference_index}, the reference: "
        f"{count_text(matches.counts())}. {how}"
        f"{numbers} Dropped points are marked where they were expected; those expected outside of "
        f"the image are not shown.\n{crops}Attempts: {'; '.join(explanation.attempts)}."
    )


def _draw_crops(panels: Sequence[Axes], explanation: FrameExplanation, matches: Sorting) -> None:
    """Enlarge matches that spread evenly over the errors of the prediction."""
    begin, kept = explanation.attempt.find("attempt"), np.flatnonzero(matches.are_kept)
    errors = np.linalg.norm(matches.partners - matches.predicted, axis=1)
    order = kept[np.argsort(errors[kept], kind="stable")]
    chosen = order[np.linspace(0, len(order) - 1, _N_CROPS).astype(int)] if len(order) else order
    for axes, index in zip(panels, chosen, strict=False):
        (u, v), found = matches.predicted[index], matches.partners[index]
        show_image(axes, explanation.image)
        _draw_search(axes, (u, v), found, begin)
        away = 1.2 * float(np.abs(found - (u, v)).max()) + 6.0
        reach = max(2.2 * begin["radius_px"], 18.0, away)
        axes.set(xlim=(u - reach, u + reach), ylim=(v + reach, v - reach))
        axes.set_title(f"{errors[index]:.1f} px off", fontsize=10)
    for axes in panels[len(chosen) :]:
        axes.set_axis_off()


def _draw_search(
    axes: Axes, predicted: tuple[float, float], found: FloatArray, begin: Mapping[str, Any]
) -> None:
    radius = begin["radius_px"]
    dashed: dict[str, Any] = {"fill": False, "ec": LIMIT, "linestyle": "--", "linewidth": 1.2}
    if begin["method"] == "tracks":
        side, (u, v), (left, top) = 2 * radius + 1, predicted, found - radius - 0.5
        axes.add_patch(Rectangle((u - side / 2, v - side / 2), side, side, **dashed))
        axes.add_patch(Rectangle((left, top), side, side, fill=False, ec=KEPT, linewidth=1.5))
    else:
        axes.add_patch(Circle(predicted, radius, **dashed))
    axes.plot(*predicted, "+", color=LIMIT, markersize=11, markeredgewidth=1.6)
    axes.plot(*found, "o", color=KEPT, markersize=6, markerfacecolor="none", mew=1.6)


def draw_consensus(explanation: FrameExplanation) -> Picture:
    """Draw which matches agree on a motion, and what the samples found."""
    image, step = explanation.image, explanation.consensus
    if step is None:
        return _not_reached("06_consensus", explanation)
    inliers, (starts, ends) = step.drawn.inliers, step.drawn.pixels
    stacked = is_wide(image.shape)
    height = image_height(image.shape, share=1.0 if stacked else 0.5) + 0.4
    heights = [height, 3.0 if stacked else 0.4]
    sheet = Sheet("06_consensus", _consensus_caption(explanation, step), sum(heights))
    if stacked:
        upper, lower = sheet.panels.subplots(2, 1, height_ratios=heights)
    else:
        upper, lower = sheet.panels.subplots(1, 2)
    show_image(upper, image)
    for chosen, colour, marker, name in (
        (~inliers, REFUSED, "x", "disagree"),
        (inliers, KEPT, "o", "agree"),
    ):
        if chosen.any():
            draw_segments(upper, starts[chosen], ends[chosen], colors=colour)
            label = f"{name}: {chosen.sum()}"
            upper.plot(*ends[chosen].T, marker, color=colour, markersize=4, label=label)
    legend_below(upper, 2)
    _draw_samples(lower, step)
    return sheet.picture()


def _consensus_caption(explanation: FrameExplanation, step: Step) -> str:
    n, ransac = step.n_matches, explanation.config.ransac
    limit = f"{ransac.inlier_threshold_px:g} px in (u, v, disparity)"
    if ransac.inlier_metric == "distance":
        limit = f"{ransac.inlier_threshold_m:g} m"
    text = f"A match agrees with a motion if its error is less than {limit}. "
    if step.n_agreeing_with_prediction is not None:
        text += (
            f"{step.n_agreeing_with_prediction} of {n} matches agree with the predicted motion; "
            f"from {int(np.ceil(step.drawn.n_needed))} on no samples are drawn. "
        )
    if step.is_known:
        text += (
            "So none were drawn: the refinement starts from these matches and the predicted "
            "motion. The curve shows what the samples would have found: "
        )
    text += _samples_text(step.samples)
    if step.n_inliers is not None and not step.is_known:
        text += f" Refitted to its inliers, {step.n_inliers} of {n} agree."
    return text


def _samples_text(samples: Step) -> str:
    n_drawn, n_planned, reason = samples.n_drawn, samples.n_planned, samples.reason
    if not n_drawn:
        return f"{reason or 'no samples'}."
    text = (
        f"{n_drawn} of at most {n_planned} samples of three of the {samples.n_near} "
        f"points with enough disparity; the best one finds {samples.inliers.max()}"
    )
    if n_drawn < n_planned:
        text += (
            f"; stopped early, as {100 * samples.share_of_near:.0f} % of those points agree with "
            "it: the probability that all samples held an outlier is less than one in a thousand"
        )
    return f"{text}. It fails: {reason}." if reason else f"{text}."


def _draw_samples(axes: Axes, step: Step) -> None:
    counts, n_planned, n_matches = step.samples.inliers, step.samples.n_planned, step.n_matches
    number, is_fitted = np.arange(1, len(counts) + 1), counts >= 0
    axes.plot(number[is_fitted], counts[is_fitted], ".", color=BEFORE, label="one sample")
    if len(counts):
        best = np.maximum(np.maximum.accumulate(counts), 0)
        axes.step(number, best, where="post", color=AFTER, label="best so far")
        if len(counts) < n_planned:
            label = f"stopped after {len(counts)}"
            axes.axvline(len(counts), color=LIMIT, linestyle="--", label=label)
    axes.axhline(n_matches, color="black", linestyle=":", label=f"all {n_matches} matches")
    axes.set(xlim=(0, max(n_planned, 1) * 1.02), ylim=(0, 1.25 * max(n_matches, 1)))
    title = f"what the samples {'would have ' if step.is_known else ''}found"
    finish_axes(axes, "sample", "inliers", title, loc="upper right", ncols=4)


def draw_residuals(explanation: FrameExplanation) -> Picture:
    """Draw the residuals before and after the refinement."""
    step = explanation.refinement
    if step is None:
        return _not_reached("07_residuals", explanation)
    sheet = Sheet("07_residuals", _residuals_caption(explanation, step), 6.8)
    axes, gate, whitened = sheet.panels.subplots(2, 3), step.gate_sigma, step.drawn.whitened
    for column, name in enumerate(("u", "v", "disparity")):
        values = step.drawn.residuals_px[:, :, column]
        finite = values[np.isfinite(values)]
        reach = 1.1 * (float(np.percentile(np.abs(finite), 95)) if len(finite) else 1.0) + 1e-9
        _compare(axes[0, column], values, np.linspace(-reach, reach, 41))
        axes[0, column].locator_params(axis="x", nbins=7)
        finish_axes(axes[0, column], f"residual of {name} [px], outer bins: beyond", "matches")
    norms, cloud, by_depth = axes[1]
    lengths = np.nan_to_num(np.linalg.norm(whitened, axis=2), nan=np.inf)
    _compare(norms, lengths, np.linspace(0.0, 3.0 * gate, 46))
    norms.axvline(gate, color=LIMIT, linestyle="--", label=f"gate {gate:g}")
    finish_axes(norms, "whitened norm [sigma], last bin: beyond", "matches")
    u, v, disparity = np.clip(whitened[1].T, -2.0 * gate, 2.0 * gate)
    _draw_after(cloud, u, v, step)
    circle = gate * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 100))
    cloud.plot(circle.real, circle.imag, "--", color=LIMIT, linewidth=1.0, label="gate")
    cloud.set(aspect="equal", xlim=(-2.1 * gate, 2.1 * gate))
    place: dict[str, Any] = {"loc": "upper center", "columnspacing": 0.8, "handletextpad": 0.2}
    labels = "after, whitened u [sigma], at the border: beyond", "whitened v [sigma]"
    finish_axes(cloud, *labels, ncols=3, **place)
    _draw_after(by_depth, step.drawn.depths, disparity, step)
    by_depth.axhline(0.0, color="black", linewidth=0.8)
    label = "after, whitened disparity [sigma],\nat the border: beyond"
    finish_axes(by_depth, "depth [m]", label, ncols=2, loc="upper center")
    return sheet.picture()


def _compare(axes: Axes, values: FloatArray, bins: FloatArray) -> None:
    """Draw histograms of values before and after; the outer bins take what is beyond."""
    for row, colour, name in ((0, BEFORE, "before"), (1, AFTER, "after")):
        shown = np.clip(values[row][~np.isnan(values[row])], bins[0], bins[-1])
        axes.hist(shown, bins.tolist(), histtype="stepfilled", alpha=0.6, color=colour, label=name)


def _draw_after(axes: Axes, x: FloatArray, y: FloatArray, step: Step) -> None:
    """Draw what is left after the refinement, within twice the gate."""
    inliers, gate = step.drawn.inliers, step.gate_sigma
    axes.plot(x[~inliers], y[~inliers], "x", color=REFUSED, markersize=5, label="outliers")
    axes.plot(x[inliers], y[inliers], ".", color=KEPT, markersize=6, label="inliers")
    axes.set_ylim(-2.1 * gate, 2.9 * gate)


def _residuals_caption(explanation: FrameExplanation, step: Step) -> str:
    before, after = (
        ", ".join(number_text(each, ".2f") for each in medians.values())
        for medians in step.median_abs_residual_px
    )
    is_known = explanation.consensus is not None and explanation.consensus.is_known
    T_before, T_after = step.drawn.T_target_source
    moved = T_after @ np.linalg.inv(T_before)
    angle = np.degrees(np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0)))
    return (
        f"Measured less predicted, of {len(step.drawn.depths)} matches. Before, at the "
        f"{'predicted pose' if is_known else 'pose of RANSAC'}: medians of the absolute residuals "
        f"of (u, v, disparity) {before} px; after {step.n_steps} Gauss-Newton steps, which moved "
        f"the pose by {1e3 * np.linalg.norm(moved[:3, 3]):.1f} mm and {angle:.3f} deg: {after} px. "
        "Whitened residuals are in sigmas, from the noise of both frames propagated through the "
        f"motion; the root mean square of the inliers is {step.scale:.2f}, 1 if the stated sigmas "
        f"are right. {_gate_text(step)}"
    )


def _gate_text(step: Step) -> str:
    (before, after), n_within_gate = step.n_inliers, step.n_within_gate
    if n_within_gate is None:
        return f"Pose and matches stay as they are, {after} (registration.refine none)."
    gate = f"The gate of {step.gate_sigma:g} sigma (registration.gate)"
    if n_within_gate == after:
        return (
            f"{gate} chooses the matches again after the first steps: {before} before, "
            f"{after} after."
        )
    return (
        f"{gate} would leave {n_within_gate} matches after the first steps, less than half: "
        f"the {before} from before stay, those far off with less weight. The residuals are larger "
        "than the stated sigmas here."
    )


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
    # Room for the legend above; y points down.
    y_limits = (-reach, 1.3 * reach) if names[1] == "z" else (-1.3 * reach, reach)
    axes.set(aspect="equal", xlim=(-reach, reach), ylim=y_limits)
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
    shown = [link for link in explanation.links if link.kind != "depth"]
    n_columns = min(_N_COLUMNS, max(len(shown), 3))
    n_rows = -(-len(shown) // n_columns)
    rows, columns = explanation.image.shape
    height = n_rows * (12.6 / n_columns * rows / columns + 0.8)
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
    colour = KEPT if link.is_accepted else BEFORE if link.kind == "not linked" else REFUSED
    axes.spines[:].set(edgecolor=colour, linewidth=3)
    lines = [f"frame {link.frame}, {what[link.kind]}{overlap}", *textwrap.wrap(answer, 48)]
    axes.set_title("\n".join(lines), fontsize=8, loc="left")


def _links_caption(explanation: FrameExplanation) -> str:
    window, links = explanation.config.window, explanation.links
    text = (
        f"Edges to earlier frames (blue): {sum(link.is_accepted for link in links)}; keyframes "
        f"registered: at most {window.n_links} (window.n_links). Overlap is "
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
        if link.kind == "depth" and link.is_accepted:
            text += f"\nDepth alone gave another edge to frame {link.frame}."
        elif link.reason and link.kind != "not linked":
            text += f"\nFrame {link.frame}: {link.reason}."
    return text


DRAWERS = draw_matches, draw_consensus, draw_residuals, draw_pose, draw_links
"""In the order of the steps."""
