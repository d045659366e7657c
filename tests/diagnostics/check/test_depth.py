"""Where depth lies in the image of colour, against what was put in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from gvo.diagnostics.check.depth import Misregistration, estimate_misregistration
from gvo.types import Failure, RgbdFrame


def squares(seed: int, *, size: int = 240) -> tuple[Any, Any]:
    """Return grey values and depth of squares before a wall."""
    rng = np.random.default_rng(seed)
    grey = np.full((size, size), 90.0)
    depth = np.full((size, size), 5.0)
    for row in range(30, size - 60, 60):
        for column in range(30, size - 60, 60):
            v, u = row + rng.integers(0, 20), column + rng.integers(0, 20)
            grey[v : v + 25, u : u + 25] = rng.choice([10.0, 40.0, 160.0, 220.0])
            depth[v : v + 25, u : u + 25] = rng.uniform(1.0, 3.0)
    return grey, depth.astype(np.float32)


def frames(du: int, dv: int, n: int = 8) -> list[RgbdFrame]:
    found = []
    for seed in range(n):
        grey, depth = squares(seed)
        noise = np.random.default_rng(seed).normal(0, 3, grey.shape)
        image = np.clip(cv2.GaussianBlur(grey, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)
        found.append(
            RgbdFrame(stamp_ns=seed, image=image, depth=np.roll(depth, (dv, du), axis=(0, 1)))
        )
    return found


def changed(change: Callable[[RgbdFrame], dict[str, Any]]) -> list[RgbdFrame]:
    """Return frames with another image or depth."""
    return [replace(frame, **change(frame)) for frame in frames(0, 0)]


def zoomed(factor: float) -> list[RgbdFrame]:
    def zoom(frame: RgbdFrame) -> dict[str, Any]:
        size = frame.depth.shape[::-1]
        M = cv2.getRotationMatrix2D(((size[0] - 1) / 2, (size[1] - 1) / 2), 0.0, factor)
        depth = cv2.warpAffine(frame.depth, M, size, flags=cv2.INTER_NEAREST, borderValue=5.0)
        return {"depth": np.asarray(depth, np.float32)}

    return changed(zoom)


def eroded(frame: RgbdFrame) -> dict[str, Any]:
    """Lose the depth along edges."""
    is_step = np.abs(cv2.Laplacian(frame.depth, cv2.CV_32F)) > 0.1
    is_lost = cv2.dilate(is_step.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return {"depth": np.where(is_lost, np.float32(np.nan), frame.depth).astype(np.float32)}


@pytest.mark.parametrize(
    ("seen", "shift_px", "zoom"),
    [
        *((frames(du, dv), (-du, -dv), 1.0) for du, dv in ((0, 0), (-9, 4), (11, 11))),
        *((zoomed(factor), (0.0, 0.0), 1.0 / factor) for factor in (0.9,)),
        (changed(eroded), (0.0, 0.0), 1.0),
    ],
    ids=["none", "left and down", "far", "smaller", "lost edges"],
)
def test_the_place_of_depth_in_the_image_is_measured(
    seen: list[RgbdFrame], shift_px: tuple[float, float], zoom: float
) -> None:
    found = estimate_misregistration(seen)
    assert isinstance(found, Misregistration)
    assert found.zoom == pytest.approx(zoom, abs=0.021)
    assert found.shift_px == pytest.approx(shift_px, abs=0.6 if zoom == 1.0 else 1.0)
    if zoom == 1.0:
        assert found.rms_px == pytest.approx(math.hypot(*shift_px), abs=0.6)


def at_the_border(frame: RgbdFrame) -> dict[str, Any]:
    depth = np.full(frame.depth.shape, 3.0, np.float32)
    depth[:, 2:6] = 1.0  # a mast, nearer to the border than the search reaches
    image = np.random.default_rng(frame.stamp_ns).integers(0, 256, depth.shape, dtype=np.uint8)
    return {"image": image, "depth": depth}


def of_a_wall(frame: RgbdFrame) -> dict[str, Any]:
    return {"depth": np.full(frame.depth.shape, 2.0, np.float32)}


@pytest.mark.parametrize("change", [at_the_border, of_a_wall])
def test_depth_that_the_image_does_not_show_gives_no_answer(
    change: Callable[[RgbdFrame], dict[str, Any]],
) -> None:
    assert isinstance(estimate_misregistration(changed(change)), Failure)
