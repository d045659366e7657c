"""How the disparity of one keypoint was found to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config, StereoConfig
from gvo.diagnostics.explain.extraction import find_event
from gvo.diagnostics.explain.values import StereoStep, SubpixelStep
from gvo.diagnostics.explain.watch import WatchedFrame
from gvo.frontend.stereo.corners import N_SEARCH_STEPS
from gvo.frontend.stereo.disparity import follow_disparities
from gvo.types import FloatArray, ImageArray, RgbdFrame

# Of the curve of squared differences around the end, pixels.
_REACH_PX = 4
_STEP_PX = 0.125


def explain_subpixel(
    watch: WatchedFrame, stereo: StereoStep | None, config: Config
) -> SubpixelStep | None:
    """Follow one keypoint, neither the best nor the worst; None where no match was kept."""
    frame = watch.frame
    if stereo is None or isinstance(frame, RgbdFrame) or not stereo.sorting.are_kept.any():
        return None
    images, kept = (frame.left, frame.right), np.flatnonzero(stereo.sorting.are_kept)
    energies = [_gradient(frame.left, stereo.pixels[i], config.stereo) for i in kept]
    chosen = kept[np.argsort(energies, kind="stable")[len(kept) // 2]]
    pixel, disparity = stereo.pixels[chosen], float(stereo.disparities[chosen])
    searched = find_event(watch.events, "corners.searched")
    is_fitted = config.stereo.subpixel == "parabola"
    if searched is not None:
        method, row = "gauss-newton", pixel[1] + watch.row_offset_px
        rough = searched.values["rough"][chosen : chosen + 1]
        iterates = _follow(images, pixel, rough, config.stereo, watch.row_offset_px)
        columns = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX) + round(disparity)
    else:
        # Patches are those of whole pixels, and so are the columns.
        pixel, row = np.rint(pixel), float(np.rint(pixel[1]))
        start = float(pixel[0] - np.rint(stereo_start(watch, stereo, int(chosen))))
        method, iterates = "parabola", np.array([start, disparity])
        reach = config.stereo.search_radius_px
        columns = start + np.arange(-reach, reach + 1, dtype=np.float64)
    radius = config.stereo.patch_radius_px
    left = _patch(images[0], pixel[0], pixel[1], radius)
    return SubpixelStep(
        pixel=pixel,
        left=left,
        right=_patch(images[1], pixel[0] - disparity, row, radius),
        columns=columns,
        ssd=np.array(
            [_ssd(left, _patch(images[1], pixel[0] - d, row, radius)) for d in columns.tolist()]
        ),
        iterates=iterates,
        disparity=disparity,
        method=method if is_fitted else "none",
    )


def stereo_start(watch: WatchedFrame, stereo: StereoStep, chosen: int) -> float:
    """Return the column of the right keypoint that a keypoint was matched with."""
    event = find_event(watch.events, "descriptor.stereo")
    if event is None:
        return float(stereo.partners[chosen, 0])
    pairs, right = event.values["pairs"], event.values["features"][1]
    return float(right.keypoints[pairs[pairs[:, 0] == chosen, 1][0], 0])


def _follow(
    images: tuple[ImageArray, ImageArray],
    pixel: FloatArray,
    rough: FloatArray,
    config: StereoConfig,
    row_offset_px: float,
) -> FloatArray:
    """Return the disparities at the start and after each of the front-end's steps."""
    iterates = [rough[0]]
    for n_steps in range(1, N_SEARCH_STEPS + 1):
        found, _ = follow_disparities(
            images,
            pixel[np.newaxis],
            rough,
            config,
            n_steps=n_steps,
            row_offset_px=row_offset_px,
        )
        iterates.append(found[0])
    return np.array(iterates)


def _gradient(image: ImageArray, pixel: FloatArray, config: StereoConfig) -> float:
    """Return how much a patch tells of its place along the row."""
    patch = _patch(image, float(pixel[0]), float(pixel[1]), config.patch_radius_px)
    return float(np.sum(np.diff(patch, axis=1) ** 2))


def _patch(image: ImageArray, u: float, v: float, radius: int) -> NDArray[np.float32]:
    size = 2 * radius + 1
    return np.asarray(
        cv2.getRectSubPix(image, (size, size), (u, v), patchType=cv2.CV_32F), dtype=np.float32
    )


def _ssd(left: NDArray[np.float32], right: NDArray[np.float32]) -> float:
    difference = (right - left).astype(np.float64)
    return float(np.sum((difference - difference.mean()) ** 2))
