"""Matches drawn over the image, with OpenCV."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

import cv2
import numpy as np

from gvo.frontend.klt import image_of
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import (
    BoolArray,
    DepthArray,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    IntArray,
    RelativePose,
    RgbdFrame,
    Status,
    StereoFrame,
)
from gvo.viz.palette import ESTIMATES, INLIERS, OUTLIERS, STATUSES, rgb
from gvo.viz.scene import loop_text, placed_matches

Colour: TypeAlias = tuple[int, int, int]
"""BGR."""

WHITE: Final[Colour] = (255, 255, 255)
BLACK: Final[Colour] = (0, 0, 0)
FOOTER_PX: Final = 28
"""Of the colour bar with its numbers."""
LABEL: Final = "depth [m]"

_BITS: Final = 4  # fractional bits of OpenCV's fixed-point pixels
_DOT_PX: Final = 2.0
_ARM_PX: Final = 3.0
_MAX_PX: Final = 20_000  # keeps OpenCV's integers from overflowing
_LINE_PX: Final = 16
_TEXT_MARGIN_PX: Final = 5
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.45
_DARKEST = 64  # of viridis: darker colours vanish in a dark image
_FAR_DISPARITY_PX = 2.0
_NEAR_SHARE = 8.0  # image width over the disparity of the near end
_RGBD_M = (0.4, 8.0)
_UNKNOWN = (16, 16, 16)
_N_STEPS: Final = 4000  # of 2 mm up to 8 m
_BAR_PX = 9


def bgr(colour: str) -> Colour:
    """Return the BGR value of a colour such as "#E69F00"."""
    red, green, blue = rgb(colour)
    return blue, green, red


def draw_segments(canvas: ImageArray, segments: FloatArray, colour: Colour) -> None:
    """Draw straight lines between pairs of pixels, shape (n, 2, 2)."""
    scaled = np.rint(np.clip(segments, -_MAX_PX, _MAX_PX) * 2**_BITS)
    cv2.polylines(canvas, list(scaled.astype(np.int32)), False, colour, 1, cv2.LINE_AA, _BITS)


def draw_dots(
    canvas: ImageArray, pixels: FloatArray, colours: ImageArray | Colour, radius: float = _DOT_PX
) -> None:
    """Draw discs at pixels, shape (n, 2), in one colour or in colours of shape (n, 3)."""
    # hundreds of calls of OpenCV would be the slowest part, and hold up the other threads
    centres = np.rint(np.clip(pixels, -_MAX_PX, _MAX_PX)).astype(np.int64)
    offsets = _disc(radius)
    u, v = (centres[:, np.newaxis] + offsets).reshape(-1, 2).T
    height, width = canvas.shape[:2]
    is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values = np.asarray(colours, dtype=np.uint8)
    if values.ndim == 2:
        values = np.repeat(values, len(offsets), axis=0)[is_inside]
    canvas[v[is_inside], u[is_inside]] = values


def draw_crosses(canvas: ImageArray, pixels: FloatArray, colour: Colour) -> None:
    """Draw diagonal crosses at pixels, shape (n, 2)."""
    for step in ((_ARM_PX, _ARM_PX), (_ARM_PX, -_ARM_PX)):
        draw_segments(canvas, np.stack([pixels - step, pixels + step], axis=1), colour)


def write_lines(canvas: ImageArray, lines: Sequence[str]) -> None:
    """Write lines of text on a darkened strip in the upper left corner."""
    texts = [plain(line) for line in lines]
    if not texts:
        return
    right = max(map(text_width, texts)) + 2 * _TEXT_MARGIN_PX
    strip = canvas[: _LINE_PX * len(texts) + _TEXT_MARGIN_PX, :right]
    strip //= 4
    for row, text in enumerate(texts, start=1):
        write(canvas, text, (_TEXT_MARGIN_PX, _LINE_PX * row - 2))


def write(
    canvas: ImageArray, text: str, corner: tuple[int, int], colour: Colour = WHITE
) -> tuple[int, int]:
    """Write text from its lower left corner; return its lower right corner."""
    text = plain(text)
    cv2.putText(canvas, text, corner, _FONT, _FONT_SCALE, colour, 1, cv2.LINE_AA)
    return corner[0] + text_width(text), corner[1]


def text_width(text: str) -> int:
    """Return the width of a line of text, pixels."""
    return int(cv2.getTextSize(plain(text), _FONT, _FONT_SCALE, 1)[0][0])


def shortened(text: str, n_pixels: int) -> str:
    """Return the text cut to a width in pixels, with an ellipsis if cut."""
    if text_width(text) <= n_pixels:
        return text
    n = next((n for n in range(len(text), 0, -1) if text_width(text[:n] + "...") <= n_pixels), 0)
    return text[:n].rstrip() + "..."


def plain(text: str) -> str:
    """Return the text with question marks for characters that are not ASCII."""
    return text.encode("ascii", "replace").decode()


def _disc(radius: float) -> IntArray:
    n = int(radius)
    v, u = np.mgrid[-n : n + 1, -n : n + 1]
    return np.asarray(np.argwhere(u**2 + v**2 <= radius**2)[:, ::-1] - n, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScale:
    """Viridis over the logarithm of depth: near is bright; beyond the ends, their colours."""

    near_m: float
    far_m: float

    @classmethod
    def of(cls, camera: PinholeCamera) -> DepthScale:
        """Return the scale for a stereo camera, by its disparities, or for an RGB-D camera."""
        if not isinstance(camera, StereoCamera):
            return cls(near_m=_RGBD_M[0], far_m=_RGBD_M[1])
        disparities = np.array([camera.width / _NEAR_SHARE, _FAR_DISPARITY_PX])
        near_m, far_m = camera.disparity_to_depth(disparities)
        return cls(near_m=float(near_m), far_m=float(far_m))

    def levels(self, depths: FloatArray | DepthArray) -> ImageArray:
        """Return the indices into `table` of depths in metres; NaN counts as far."""
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.log(depths / self.far_m) * (255.0 / np.log(self.near_m / self.far_m))
        known = np.nan_to_num(shares, nan=0.0, posinf=255.0, neginf=0.0)
        return np.asarray(np.rint(np.clip(known, 0.0, 255.0)), dtype=np.uint8)

    def ticks(self) -> list[float]:
        """Return round depths within the scale, metres."""
        candidates = [digit * 10.0**n for n in range(-3, 5) for digit in (1, 2, 5)]
        return [depth for depth in candidates if self.near_m <= depth <= self.far_m]


@lru_cache
def table() -> ImageArray:
    """Return the colours, shape (256, 3), BGR, from far to near."""
    levels = np.linspace(_DARKEST, 255, 256).round().astype(np.uint8)
    coloured = cv2.applyColorMap(levels[:, np.newaxis], cv2.COLORMAP_VIRIDIS)
    colours = np.asarray(coloured, dtype=np.uint8).reshape(256, 3)
    colours.setflags(write=False)
    return colours


def paint_depth(depth: DepthArray, scale: DepthScale, size: tuple[int, int]) -> ImageArray:
    """Return a depth image (h, w), metres, in colours of the size (width, height), unknown dark."""
    # no interpolation: there is nothing between a near and a far pixel
    resized = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    # a table over even steps of depth replaces slow logarithms of all pixels
    steps = np.array(resized, dtype=np.float32)
    cv2.patchNaNs(steps, 0.0)
    steps *= _N_STEPS / scale.far_m
    np.minimum(steps, _N_STEPS, out=steps)
    return np.asarray(_colours_of_steps(scale)[steps.astype(np.uint16)])


@lru_cache(maxsize=8)
def _colours_of_steps(scale: DepthScale) -> ImageArray:
    """Return the colours of even steps of depth up to the far end, shape (n, 3); 0: unknown."""
    depths = np.arange(1, _N_STEPS + 1) * (scale.far_m / _N_STEPS)
    colours = np.concatenate([np.full((1, 3), _UNKNOWN), table()[scale.levels(depths)]])
    return colours.astype(np.uint8)


@lru_cache(maxsize=8)
def colour_bar(scale: DepthScale, width: int) -> ImageArray:
    """Return the colour bar with its numbers, shape (FOOTER_PX, width, 3), near at the left."""
    bar = np.zeros((FOOTER_PX, width, 3), dtype=np.uint8)
    left = write(bar, LABEL, (_MARGIN_PX, FOOTER_PX - 10))[0] + 2 * _MARGIN_PX
    right = width - 3 * _MARGIN_PX
    columns = np.linspace(255, 0, right - left).round().astype(np.int64)
    bar[2 : 2 + _BAR_PX, left:right] = table()[columns]
    is_free_from = 0
    for depth in scale.ticks():
        text = f"{depth:g}"
        share = np.log(depth / scale.near_m) / np.log(scale.far_m / scale.near_m)
        u = left + round(share * (right - left - 1))
        start = u - text_width(text) // 2
        if start < is_free_from or start + text_width(text) > width:
            continue
        bar[2 : 5 + _BAR_PX, u] = WHITE
        is_free_from = write(bar, text, (start, FOOTER_PX - 4))[0] + _MARGIN_PX
    bar.setflags(write=False)
    return bar


def in_groups(levels: ImageArray, n_groups: int = 32) -> Iterator[tuple[IntArray, Colour]]:
    """Group points of similar level: indices and colour of each group."""
    groups = levels.astype(np.int64) * n_groups // 256
    for group in np.unique(groups):
        blue, green, red = table()[int((group + 0.5) * 256 / n_groups)].tolist()
        yield np.flatnonzero(groups == group), (blue, green, red)


INLIER_COLOUR: Final = bgr(INLIERS)
OUTLIER_COLOUR: Final = bgr(OUTLIERS)
LOOP_COLOUR: Final = bgr(ESTIMATES["global"])
HEADER_PX: Final = 44
MIN_WIDTH_PX: Final = 640
"""Of a picture, for its text."""
MAX_WIDTH_PX: Final = 1280
"""Of a picture, by default."""

_WIDE = 2.0  # least aspect ratio of images whose panels are stacked
_MARGIN_PX = 8
_GAP_PX = 18
_ROWS_PX = (17, 37)
_DARK_TEXT = frozenset({Status.OK, Status.COASTING})
_CHARACTER_PX = 10  # above the mean width
_DIMMED = 0.4  # brightness of the image below coloured lines


def compose_overlay(
    frame: Frame,
    result: FrameResult,
    camera: PinholeCamera,
    *,
    index: int | None = None,
    max_width: int = MAX_WIDTH_PX,
) -> ImageArray:
    """Draw the result of one frame: status, flow and depth.

    The first panel shows the flow since the reference of the raw chain (`draw_matches`), the
    second, below for wide images and at the right for others, the depth of the same points: lines
    from the left to the right pixel in the colour of the depth for a stereo camera; for an RGB-D
    camera the depth image in colours, dark where unknown, with the points.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    result : FrameResult
        Of this frame.
    camera : StereoCamera or PinholeCamera
        Of the recording.
    index : int, optional
        Number of the frame for the header.
    max_width : int
        Maximum width, pixels; at least 640.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        BGR, of one even size for all frames of a camera.

    Raises
    ------
    ValueError
        When the image size is not the camera's, or a stereo frame's camera has no baseline.
    """
    shape = image_of(frame).shape
    if shape != (camera.height, camera.width):
        raise ValueError(f"expected images of {camera.width}x{camera.height}, got {shape}")
    layout = Layout.of(camera, max_width)
    canvas = layout.empty()
    _draw_panels(canvas, layout, frame, placed_matches(result), camera)
    _write_header(canvas, layout, result, index)
    _write_footer(canvas, layout, camera, result.reason)
    return canvas


def compose_faulty(
    frame: FaultyFrame,
    camera: PinholeCamera,
    *,
    index: int | None = None,
    max_width: int = MAX_WIDTH_PX,
) -> ImageArray:
    """Draw an unusable frame: dark, with the reason; otherwise as `compose_overlay`."""
    layout = Layout.of(camera, max_width)
    canvas = layout.empty()
    _write_header(canvas, layout, frame, index)
    _write_footer(canvas, layout, camera, "")
    texts = textwrap.wrap(frame.reason, layout.panel[0] // _CHARACTER_PX)
    write_lines(layout.panels(canvas)[0], [f"{Status.SKIPPED}: no pose", *texts])
    return canvas


def draw_matches(
    image: ImageArray,
    pixels_reference: FloatArray,
    pixels_current: FloatArray,
    inliers: BoolArray,
    *,
    lines: Sequence[str] = (),
) -> ImageArray:
    """Draw the flow of matches over the current image.

    Each line leads from the reference to the current pixel. Inliers end in a blue dot, outliers,
    drawn on top, in an orange cross.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The current image, grey.
    pixels_reference, pixels_current : ndarray of float64, shape (n, 2)
        (u, v) of the matches in the reference and in the current image; pixel (0, 0) is the
        centre of the first. Matches that are not finite are skipped.
    inliers : ndarray of bool, shape (n,)
    lines : sequence of str
        Text in the upper left corner; other than ASCII characters become question marks.

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Two panels of equal size, stacked or side by side, between a header and a footer."""

    panel: tuple[int, int]  # width and height, even, as video encoders require
    scale: float  # panel pixels per image pixel
    is_stacked: bool

    @classmethod
    def of(cls, camera: PinholeCamera, max_width: int) -> Layout:
        """Return the layout for the images of a camera."""
        if max_width < MIN_WIDTH_PX:
            raise ValueError(f"max_width must be at least {MIN_WIDTH_PX}, got {max_width}")
        is_stacked = camera.width >= _WIDE * camera.height
        n_columns = 1 if is_stacked else 2
        widest, narrowest = max_width // n_columns, MIN_WIDTH_PX // n_columns
        width = max(narrowest, min(widest, camera.width)) & ~1
        scale = width / camera.width
        height = max(2, round(camera.height * scale) & ~1)
        return cls(panel=(width, height), scale=scale, is_stacked=is_stacked)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, pixels."""
        width, height = self.panel
        across, down = (1, 2) if self.is_stacked else (2, 1)
        return across * width, HEADER_PX + down * height + FOOTER_PX

    def empty(self) -> ImageArray:
        """Return a black picture, shape (height, width, 3)."""
        width, height = self.size
        return np.zeros((height, width, 3), dtype=np.uint8)

    def panels(self, canvas: ImageArray) -> tuple[ImageArray, ImageArray]:
        """Return the panels of a picture, as writable views."""
        width, height = self.panel
        body = canvas[HEADER_PX : canvas.shape[0] - FOOTER_PX]
        if self.is_stacked:
            return body[:height], body[height:]
        return body[:, :width], body[:, width:]

    def scaled(self, pixels: FloatArray) -> FloatArray:
        """Map pixels of the image, shape (n, 2), to a panel."""
        return np.asarray((pixels + 0.5) * self.scale - 0.5)


def _draw_panels(
    canvas: ImageArray, layout: Layout, frame: Frame, found: RelativePose, camera: PinholeCamera
) -> None:
    first, second = layout.panels(canvas)
    current, reference = map(layout.scaled, (found.pixels_current, found.pixels_reference))
    small = _resized(image_of(frame), layout.panel)
    first[:] = draw_matches(small, reference, current, found.inliers, lines=["flow"])
    if isinstance(frame, StereoFrame):
        depths = found.points_current[:, 2]
        second[:] = _disparity_picture(small, current, depths, camera, layout.scale)
    else:
        second[:] = _depth_picture(frame, current, camera, layout.panel)


def _resized(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    is_smaller = size[0] < image.shape[1]
    mode = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=mode), dtype=np.uint8)


def _disparity_picture(
    image: ImageArray, pixels: FloatArray, depths: FloatArray, camera: PinholeCamera, scale: float
) -> ImageArray:
    if not isinstance(camera, StereoCamera):
        raise ValueError("a stereo frame needs a camera with a baseline")
    dimmed = cv2.convertScaleAbs(image, alpha=_DIMMED)
    canvas = np.asarray(cv2.cvtColor(dimmed, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    is_known = np.isfinite(pixels).all(axis=1) & (depths > 0.0)
    left, depths = pixels[is_known], depths[is_known]
    right = left.copy()
    right[:, 0] -= scale * camera.depth_to_disparity(depths)
    segments = np.stack([left, right], axis=1)
    levels = DepthScale.of(camera).levels(depths)
    for indices, colour in in_groups(levels):
        draw_segments(canvas, segments[indices], colour)
    draw_dots(canvas, left, table()[levels])
    write_lines(canvas, ["disparity: from left to right"])
    return canvas


def _depth_picture(
    frame: RgbdFrame, pixels: FloatArray, camera: PinholeCamera, size: tuple[int, int]
) -> ImageArray:
    canvas = paint_depth(frame.depth, DepthScale.of(camera), size)
    known = pixels[np.isfinite(pixels).all(axis=1)]
    draw_dots(canvas, known, BLACK, radius=2.3)
    draw_dots(canvas, known, WHITE, radius=1.0)
    write_lines(canvas, ["depth, and the matched points"])
    return canvas


def _write_header(
    canvas: ImageArray, layout: Layout, result: FrameResult | FaultyFrame, index: int | None
) -> None:
    """Write status, number, stamp, counts and rate into the header."""
    status = result.status if isinstance(result, FrameResult) else Status.SKIPPED
    upper, lower = _ROWS_PX
    seconds, nanoseconds = divmod(result.stamp_ns, 10**9)
    texts = [] if index is None else [f"frame {index}"]
    texts.append(f"stamp {seconds}.{nanoseconds // 1000:06d} s")
    start = _write_badge(canvas, status) + _GAP_PX
    end = _write_row(canvas, [(text, WHITE) for text in texts], (start, upper))
    if isinstance(result, FrameResult):
        _write_row(canvas, _counts(result), (_MARGIN_PX, lower))
        loop = shortened(loop_text(result), layout.size[0] - _MARGIN_PX - end)
        write(canvas, loop, (layout.size[0] - text_width(loop) - _MARGIN_PX, upper), LOOP_COLOUR)
        elapsed_ms = sum(result.stage_ms.values())
        rate = f"{elapsed_ms:.1f} ms   {1e3 / elapsed_ms:.1f} Hz" if elapsed_ms > 0.0 else ""
        write(canvas, rate, (layout.size[0] - text_width(rate) - _MARGIN_PX, lower))


def _write_row(
    canvas: ImageArray, texts: Sequence[tuple[str, Colour]], corner: tuple[int, int]
) -> int:
    """Write texts beside one another; return where the next one would begin."""
    u, v = corner
    for text, colour in texts:
        u = write(canvas, text, (u, v), colour)[0] + _GAP_PX
    return u


def _counts(result: FrameResult) -> list[tuple[str, Colour]]:
    n_outliers = max(0, result.n_matches - result.n_inliers)
    return [
        (f"{result.n_matches} matches", WHITE),
        (f"{result.n_inliers} inliers", INLIER_COLOUR),
        (f"{n_outliers} outliers", OUTLIER_COLOUR),
        (f"{result.n_links} links", WHITE),
    ]


def _write_footer(canvas: ImageArray, layout: Layout, camera: PinholeCamera, reason: str) -> None:
    """Write a reason and the depth scale into the footer."""
    width, height = layout.size
    middle = width // 2
    canvas[height - FOOTER_PX :, middle:] = colour_bar(DepthScale.of(camera), width - middle)
    write(canvas, shortened(reason, middle - 2 * _MARGIN_PX), (_MARGIN_PX, height - 10))


def _write_badge(canvas: ImageArray, status: Status) -> int:
    """Write the status on its colour; return the right end."""
    text = status.value
    right = _MARGIN_PX + text_width(text) + 2 * _MARGIN_PX
    field = canvas[2 : _ROWS_PX[0] + 6, _MARGIN_PX:right]
    field[:] = bgr(STATUSES[status.value])
    if status is Status.SKIPPED:  # black on black
        field[[0, -1]] = WHITE
        field[:, [0, -1]] = WHITE
    write(canvas, text, (2 * _MARGIN_PX, _ROWS_PX[0]), BLACK if status in _DARK_TEXT else WHITE)
    return right
