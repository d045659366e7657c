"""Pictures of what a front-end matched, drawn over the image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Okabe and Ito's sky blue and orange, as BGR: colour-blind readers tell them apart, also on grey.
INLIER_COLOUR: Final = (233, 180, 86)
OUTLIER_COLOUR: Final = (0, 159, 230)
_TEXT_COLOUR: Final = (255, 255, 255)
_BITS: Final = 4  # of a pixel's fraction, in OpenCV's drawing
_RADIUS_PX: Final = 1.5
_MAX_PX: Final = 20_000  # keeps OpenCV's integers from running over
_LINE_PX: Final = 16
_MARGIN_PX: Final = 5
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.45


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
    _draw_segments(canvas, kept, INLIER_COLOUR)
    _draw_dots(canvas, kept[:, 1], INLIER_COLOUR)
    _draw_segments(canvas, refused, OUTLIER_COLOUR)
    _draw_crosses(canvas, refused[:, 1], OUTLIER_COLOUR)
    _write_lines(canvas, lines)
    return canvas


def _fixed_point(pixels: FloatArray) -> IntArray:
    scaled = np.rint(np.clip(pixels, -_MAX_PX, _MAX_PX) * 2**_BITS)
    return np.asarray(scaled, dtype=np.int64)


def _draw_segments(canvas: ImageArray, segments: FloatArray, colour: Sequence[float]) -> None:
    """Draw straight lines between pairs of pixels, shape (n, 2, 2)."""
    points = list(_fixed_point(segments).astype(np.int32))
    cv2.polylines(canvas, points, False, colour, 1, cv2.LINE_AA, _BITS)


def _draw_dots(canvas: ImageArray, pixels: FloatArray, colour: Sequence[float]) -> None:
    radius = round(_RADIUS_PX * 2**_BITS)
    for u, v in _fixed_point(pixels).tolist():
        cv2.circle(canvas, (u, v), radius, colour, cv2.FILLED, cv2.LINE_8, _BITS)


def _draw_crosses(canvas: ImageArray, pixels: FloatArray, colour: Sequence[float]) -> None:
    arm = 2.0 * _RADIUS_PX
    for step in ((arm, arm), (arm, -arm)):
        ends = np.stack([pixels - step, pixels + step], axis=1)
        _draw_segments(canvas, ends, colour)


def _write_lines(canvas: ImageArray, lines: Sequence[str]) -> None:
    """Write text over a darkened strip of the picture."""
    texts = [line.encode("ascii", "replace").decode() for line in lines]
    if not texts:
        return
    widths = [cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)[0][0] for text in texts]
    strip = canvas[: _LINE_PX * len(texts) + _MARGIN_PX, : max(widths) + 2 * _MARGIN_PX]
    strip //= 4
    for row, text in enumerate(texts, start=1):
        corner = (_MARGIN_PX, _LINE_PX * row - 2)
        cv2.putText(canvas, text, corner, _FONT, _FONT_SCALE, _TEXT_COLOUR, 1, cv2.LINE_AA)
