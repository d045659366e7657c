"""HTML tables for notebooks, and estimates as such."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from gvo._text import format_stamp, html_text

_FloatArray = NDArray[np.float64]

_LARGE = 1e9  # written with an exponent from here
_CELL = "text-align:left;padding:0.1em 0.8em 0.1em 0"


def estimate_html(stamp_ns: int, pose: _FloatArray, covariance: _FloatArray, *, status: str) -> str:
    """Return what a notebook shows of an estimate.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.
    pose : ndarray of float64, shape (4, 4)
        T_world_frame, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the camera frame.
    status : str
        What ties the pose to others.

    Returns
    -------
    str
        HTML.
    """
    R, positions = pose[:3, :3], pose[:3, 3]
    with np.errstate(invalid="ignore", over="ignore"):
        position_sigmas = np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T))
        rotation_sigmas = np.degrees(np.sqrt(np.diag(covariance)[:3]))
    rows = [
        ("status", status),
        ("stamp", f"{format_stamp(stamp_ns)} s"),
        ("position x, y, z [m]", vector(positions, position_sigmas)),
        ("rotation vector [deg]", vector(_rotation_vector_deg(R), rotation_sigmas)),
    ]
    return card("Estimate", rows)


def card(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return a title above a table of names and values, as HTML that is well-formed XML.

    Parameters
    ----------
    title : str
    rows : iterable of (str, str)
        Names and values as text; escaped here.

    Examples
    --------
    >>> "a &lt; b" in card("a < b", [])
    True
    """
    lines = "".join(
        f'<tr><th style="{_CELL};font-weight:normal;opacity:0.7">{html_text(name)}</th>'
        f'<td style="{_CELL}">{html_text(value)}</td></tr>'
        for name, value in rows
    )
    table = f'<table style="color:inherit">{lines}</table>' if lines else ""
    return (
        '<div style="font-variant-numeric:tabular-nums">'
        f"<strong>{html_text(title)}</strong>{table}</div>"
    )


def metres(value: float) -> str:
    """Return a length with a unit that suits it.

    Examples
    --------
    >>> metres(0.00123), metres(12.3456), metres(float("nan"))
    ('1.23 mm', '12.35 m', 'unknown')
    """
    if not math.isfinite(value):
        return "unknown"
    if abs(value) >= 1000.0:
        return f"{value / 1000.0:,.3f} km" if abs(value) < 1e9 else f"{value:.3g} m"
    return f"{value:.2f} m" if abs(value) >= 1.0 else f"{1000.0 * value:.3g} mm"


def vector(values: Sequence[float] | _FloatArray, sigmas: Sequence[float] | _FloatArray) -> str:
    """Return numbers with their standard deviations.

    Examples
    --------
    >>> vector([1.0, -2.0], [0.1, float("nan")])
    '1.00 ± 0.10, -2'
    """
    return ", ".join(
        _with_sigma(float(value), float(sigma)) for value, sigma in zip(values, sigmas, strict=True)
    )


def _rotation_vector_deg(R: _FloatArray) -> _FloatArray:
    from scipy.spatial.transform import Rotation

    if not np.all(np.abs(R) < 2.0):  # far from a rotation, or not finite
        return np.full(3, np.nan)
    try:
        return np.degrees(np.asarray(Rotation.from_matrix(R).as_rotvec()))
    except (ValueError, np.linalg.LinAlgError):  # no rotation
        return np.full(3, np.nan)


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "unknown"


def _with_sigma(value: float, sigma: float) -> str:
    """Round to two digits of the standard deviation."""
    if not (math.isfinite(value) and 0.0 < sigma < math.inf):
        return _number(value)
    n_decimals = min(max(1 - math.floor(math.log10(sigma)), 0), 9)
    if max(abs(value), sigma) >= _LARGE or sigma < 1e-8:
        return f"{_number(value)} ± {sigma:.2g}"
    return f"{value:.{n_decimals}f} ± {sigma:.{n_decimals}f}"
