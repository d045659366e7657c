"""Paths and ellipses as SVG, without anything from elsewhere.

Only the path and the ellipses have colours of their own: text and lines take that of the page, so
that they are seen on light and dark ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

_FloatArray = NDArray[np.float64]

MAX_POINTS = 400
_WIDTH, _HEIGHT, _MARGIN = 260.0, 180.0, 14.0
_SCALE_ROOM = 22.0  # below the drawing, for the bar
_MIN_M, _MAX_M = 1e-9, 1e100  # of what is drawn
_PATH_COLOUR, _ELLIPSE_COLOUR = "#0072B2", "#56B4E9"  # Okabe and Ito's


def path_drawing(points: _FloatArray, *, axes: tuple[str, str]) -> str:
    """Draw a path with its start and a bar for the scale.

    Parameters
    ----------
    points : ndarray of float64, shape (n, 2)
        To the right and upwards, metres. What is not finite is left out.
    axes : (str, str)
        Names of both directions.

    Returns
    -------
    str
        An SVG element; empty where there is no point.
    """
    points = points[np.all(np.isfinite(points), axis=1)]
    if len(points) == 0:
        return ""
    if len(points) > MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, MAX_POINTS).round().astype(np.int64)]
    view = _View(points)
    shown = view.place(points)
    start = shown[0]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in shown)
    parts = [
        f'<polyline points="{line}" fill="none" stroke="{_PATH_COLOUR}" stroke-width="1.5" '
        'stroke-linejoin="round"/>',
        f'<circle cx="{start[0]:.1f}" cy="{start[1]:.1f}" r="4" fill="none" '
        'stroke="currentColor" stroke-width="1.5"/>',
        view.bar(),
        _axes_text(axes),
    ]
    return _svg("path from above; the circle is its start", parts)


def ellipse_drawing(covariance: _FloatArray, *, axes: tuple[str, str]) -> str:
    """Draw the ellipses of one and three standard deviations.

    Parameters
    ----------
    covariance : ndarray of float64, shape (2, 2)
        To the right and upwards, metres squared.
    axes : (str, str)
        Names of both directions.

    Returns
    -------
    str
        An SVG element; empty where the matrix is no covariance, or zero.
    """
    half_axes = _half_axes(covariance)
    if half_axes is None:
        return ""
    turns = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    ellipses = [sigmas * circle @ half_axes.T for sigmas in (1.0, 3.0)]
    view = _View(ellipses[1])
    centre = view.place(np.zeros((1, 2)))[0]
    parts = [_polygon(view.place(ellipse)) for ellipse in reversed(ellipses)]
    parts += [
        f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="2" fill="currentColor"/>',
        view.bar(),
        _axes_text(axes),
    ]
    return _svg("1 and 3 standard deviations of the position, from above", parts)


class _View:
    """Places points in the drawing, with one scale for both axes."""

    def __init__(self, points: _FloatArray) -> None:
        points = np.clip(points, -_MAX_M, _MAX_M)
        low, high = points.min(axis=0), points.max(axis=0)
        self._middle = 0.5 * (low + high)
        extents = high - low
        # what stands still is drawn on a scale of a metre
        extents = extents if extents.max() > _MIN_M else np.ones(2)
        room = np.array([_WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _MARGIN - _SCALE_ROOM])
        self._pixels_per_m = float(np.min(room / np.maximum(extents, _MIN_M)))

    def place(self, points: _FloatArray) -> _FloatArray:
        """Return pixels, shape (n, 2), v downwards."""
        centre = np.array([_WIDTH / 2.0, (_HEIGHT - _SCALE_ROOM) / 2.0])
        offsets = self._pixels_per_m * (np.clip(points, -_MAX_M, _MAX_M) - self._middle)
        return np.asarray(centre + offsets * np.array([1.0, -1.0]))

    def bar(self) -> str:
        """Return a bar of a round length with its label."""
        length_m = _round_down(0.4 * (_WIDTH - 2 * _MARGIN) / self._pixels_per_m)
        end = _MARGIN + length_m * self._pixels_per_m
        v = _HEIGHT - 8.0
        return (
            f'<path d="M{_MARGIN:.1f},{v - 4:.1f} V{v:.1f} H{end:.1f} V{v - 4:.1f}" fill="none" '
            f'stroke="currentColor" stroke-width="1"/>'
            f'<text x="{end + 6:.1f}" y="{v:.1f}">{escape(_plain_metres(length_m))}</text>'
        )


def _half_axes(covariance: _FloatArray) -> _FloatArray | None:
    """Return the half axes of the ellipse as columns, shape (2, 2), metres."""
    if not np.all(np.isfinite(covariance)):
        return None
    covariance = np.clip(covariance, -_MAX_M, _MAX_M)
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if variances[1] <= 0.0 or variances[0] < -1e-9 * variances[1]:
        return None
    return np.asarray(directions * np.sqrt(np.maximum(variances, 0.0)))


def _polygon(points: _FloatArray) -> str:
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return (
        f'<polygon points="{line}" fill="{_ELLIPSE_COLOUR}" fill-opacity="0.25" '
        f'stroke="{_ELLIPSE_COLOUR}" stroke-width="1.5"/>'
    )


def _axes_text(axes: tuple[str, str]) -> str:
    horizontal, vertical = (escape(axis) for axis in axes)
    return (
        f'<text x="{_WIDTH - 4:.0f}" y="{_HEIGHT - 8:.0f}" text-anchor="end">'
        f"{horizontal} →, {vertical} ↑</text>"
    )


def _svg(title: str, parts: Sequence[str]) -> str:
    return (
        f'<svg width="{_WIDTH:.0f}" height="{_HEIGHT:.0f}" '
        f'viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" '
        'style="font-size:11px" fill="currentColor">'
        f"<title>{escape(title)}</title>{''.join(parts)}</svg>"
    )


def _round_down(value: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten at or below a positive number."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (5.0, 2.0, 1.0, 0.5) if step * power <= value)


def _plain_metres(value: float) -> str:
    if 0.001 <= value < 1.0:
        return f"{1000.0 * value:g} mm" if value < 0.01 else f"{100.0 * value:g} cm"
    if 1000.0 <= value < 1e7:
        return f"{value / 1000.0:g} km"
    return f"{value:g} m"
