"""Pictures of what a front-end matched, drawn over the image, and of the frame as a whole."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.outputs.depth_colours import DepthScale, in_groups, paint_depth, table
from gvo.outputs.overlay_layout import Layout, write_footer, write_header
from gvo.outputs.palette import INLIERS, OUTLIERS
from gvo.outputs.strokes import (
    BLACK,
    WHITE,
    bgr,
    draw_crosses,
    draw_dots,
    draw_segments,
    write_lines,
)
from gvo.types import (
    BoolArray,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    RelativePose,
    RgbdFrame,
    Status,
    StereoFrame,
)

INLIER_COLOUR: Final = bgr(INLIERS)
OUTLIER_COLOUR: Final = bgr(OUTLIERS)
MAX_WIDTH_PX: Final = 1280
"""Of a composed picture, where nothing else is asked for."""

_CHARACTER_PX = 10  # wider than the mean
_DIMMED = 0.4  # of the grey image below coloured lines
_NOTHING: Final = RelativePose(T_reference_current=np.eye(4), covariance=np.zeros((6, 6)))


def draw_matches(
    image: ImageArray,
    pixels_reference: FloatArray,
    pixels_current: FloatArray,
    inliers: BoolArray,
    *,
    lines: Sequence[str] = (),
) -> ImageArray:
    """Draw the matches between two images over the later one.

    A line runs from where a point was to where it is now. Inliers end in a blue dot, outliers
    in an orange cross, drawn above them.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The current image, grey.
    pixels_reference, pixels_current : ndarray of float64, shape (n, 2)
        (u, v) of the matches in the earlier and in the current image; pixel (0, 0) is the centre
        of the first. Matches that are not finite are left out.
    inliers : ndarray of bool, shape (n,)
    lines : sequence of str
        Text for the upper left corner; characters that are not ASCII become question marks.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        BGR.

    Raises
    ------
    ValueError
        When the shapes do not fit.
    """
    n = len(inliers)
    if image.ndim != 2 or pixels_reference.shape != (n, 2) or pixels_current.shape != (n, 2):
        raise ValueError(
            f"expected a grey image and {n} matches, got images of {image.shape}, pixels of "
            f"{pixels_reference.shape} and {pixels_current.shape}"
        )
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    flow = np.stack([pixels_reference, pixels_current], axis=1)
    is_finite = np.isfinite(flow).all(axis=(1, 2))
    kept, refused = flow[is_finite & inliers], flow[is_finite & ~inliers]
    draw_segments(canvas, kept, INLIER_COLOUR)
    draw_dots(canvas, kept[:, 1], INLIER_COLOUR)
    draw_segments(canvas, refused, OUTLIER_COLOUR)
    draw_crosses(canvas, refused[:, 1], OUTLIER_COLOUR)
    write_lines(canvas, lines)
    return canvas


def compose_overlay(
    frame: Frame,
    result: FrameResult,
    camera: PinholeCamera,
    *,
    index: int | None = None,
    rate_hz: float | None = None,
    max_width: int = MAX_WIDTH_PX,
) -> ImageArray:
    """Draw what one frame gave: status, flow and depth.

    The flow since the frame that the raw chain goes on from is drawn by `draw_matches`. The
    second part, below for wide images and at the right for others, shows the depth of the same
    points: for a stereo camera a line from where a point is in the left image to where it is in
    the right one, in the colour of its depth; for an RGB-D camera the depth image in colours,
    unknown depth dark, and the points.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    result : FrameResult
        What it gave.
    camera : StereoCamera or PinholeCamera
        Of the recording.
    index : int, optional
        Number of the frame, to be told.
    rate_hz : float, optional
        Frames per second, to be told; from the milliseconds of the frame where omitted.
    max_width : int
        Most pixels in a row; at least 640.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        BGR, of one even size for all frames of a camera.

    Raises
    ------
    ValueError
        When a stereo frame comes with a camera without a baseline, or images of another size.
    """
    image = frame.left if isinstance(frame, StereoFrame) else frame.image
    if image.shape != (camera.height, camera.width):
        raise ValueError(f"expected images of {camera.width}x{camera.height}, got {image.shape}")
    layout = Layout.of(camera, max_width)
    found = result.registration or _NOTHING
    n_told = min(len(found.pixels_current), len(found.points_current))
    pixels = layout.scaled(found.pixels_current[:n_told])
    canvas = layout.empty()
    small = _resized(image, layout.panel)
    first, second = layout.panels(canvas)
    first[:] = draw_matches(
        small,
        layout.scaled(found.pixels_reference[:n_told]),
        pixels,
        found.inliers[:n_told],
        lines=["flow"],
    )
    depths = found.points_current[:n_told, 2]
    if isinstance(frame, StereoFrame):
        second[:] = _disparity_picture(small, pixels, depths, camera, layout)
    else:
        second[:] = _depth_picture(frame, pixels, camera, layout)
    write_header(canvas, layout, result, index=index, rate_hz=rate_hz)
    write_footer(canvas, layout, camera, result.reason)
    return canvas


def compose_faulty(
    frame: FaultyFrame,
    camera: PinholeCamera,
    *,
    index: int | None = None,
    max_width: int = MAX_WIDTH_PX,
) -> ImageArray:
    """Draw a frame that cannot be used: dark, with the reason.

    Parameters
    ----------
    frame : FaultyFrame
    camera : StereoCamera or PinholeCamera
        Of the recording.
    index : int, optional
        Number of the frame, to be told.
    max_width : int
        Most pixels in a row; at least 640.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        BGR, of the size of the other frames of the camera.
    """
    layout = Layout.of(camera, max_width)
    canvas = layout.empty()
    write_header(canvas, layout, frame, index=index)
    write_footer(canvas, layout, camera, "")
    texts = textwrap.wrap(frame.reason, layout.panel[0] // _CHARACTER_PX)
    write_lines(layout.panels(canvas)[0], [f"{Status.SKIPPED}: no pose", *texts])
    return canvas


def _resized(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    is_smaller = size[0] < image.shape[1]
    mode = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=mode), dtype=np.uint8)


def _disparity_picture(
    image: ImageArray,
    pixels: FloatArray,
    depths: FloatArray,
    camera: PinholeCamera,
    layout: Layout,
) -> ImageArray:
    if not isinstance(camera, StereoCamera):
        raise ValueError("a stereo frame needs a camera with a baseline")
    dimmed = cv2.convertScaleAbs(image, alpha=_DIMMED)
    canvas = np.asarray(cv2.cvtColor(dimmed, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    is_known = np.isfinite(pixels).all(axis=1) & (depths > 0.0)
    left, depths = pixels[is_known], depths[is_known]
    right = left.copy()
    right[:, 0] -= layout.scale * camera.depth_to_disparity(depths)
    segments = np.stack([left, right], axis=1)
    levels = DepthScale.of(camera).levels(depths)
    for indices, colour in in_groups(levels):
        draw_segments(canvas, segments[indices], colour)
    draw_dots(canvas, left, table()[levels])
    write_lines(canvas, ["disparity: from left to right"])
    return canvas


def _depth_picture(
    frame: RgbdFrame, pixels: FloatArray, camera: PinholeCamera, layout: Layout
) -> ImageArray:
    canvas = paint_depth(frame.depth, DepthScale.of(camera), layout.panel)
    known = pixels[np.isfinite(pixels).all(axis=1)]
    draw_dots(canvas, known, BLACK, radius=2.3)
    draw_dots(canvas, known, WHITE, radius=1.0)
    write_lines(canvas, ["depth, and the matched points"])
    return canvas
