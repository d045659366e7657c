"""The measures of images and of registration against what was put in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import Config
from gvo.diagnostics.check.depth import Misregistration, depth_steps, estimate_misregistration
from gvo.diagnostics.check.images import blur_sigma_px, n_torn_rows
from gvo.diagnostics.check.stereo import FreeMatcher, row_error
from gvo.types import Failure, RgbdFrame
from tests.diagnostics.check.planted import render


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


def unrelated(frame: RgbdFrame) -> dict[str, Any]:
    rng = np.random.default_rng(frame.stamp_ns)
    return {"image": rng.integers(0, 256, frame.image.shape, dtype=np.uint8)}


def at_the_border(frame: RgbdFrame) -> dict[str, Any]:
    depth = np.full(frame.depth.shape, 3.0, np.float32)
    depth[:, 2:6] = 1.0  # a mast, nearer to the border than the search reaches
    return unrelated(frame) | {"depth": depth}


def of_a_wall(frame: RgbdFrame) -> dict[str, Any]:
    return {"depth": np.full(frame.depth.shape, 2.0, np.float32)}


@pytest.mark.parametrize("change", [at_the_border, of_a_wall])
def test_depth_that_the_image_does_not_show_gives_no_answer(
    change: Callable[[RgbdFrame], dict[str, Any]],
) -> None:
    assert isinstance(estimate_misregistration(changed(change)), Failure)


def test_steps_are_the_last_pixels_of_what_is_near_also_across_a_shadow() -> None:
    depth = np.full((20, 40), 4.0, dtype=np.float32)
    depth[:, 10:20] = 1.0
    depth[:, 6:10] = np.nan
    before, after = depth_steps(depth)
    assert set(np.nonzero(before)[1]) == {19}
    assert set(np.nonzero(after)[1]) == {10}


@settings(max_examples=20)
@given(st.floats(1.0, 3.0), st.floats(0.4, 1.0), st.integers(0, 1000))
def test_blur_is_measured_whatever_the_contrast(sigma: float, contrast: float, seed: int) -> None:
    grey, _ = squares(seed)
    blurred = cv2.GaussianBlur(100.0 + contrast * (grey - 100.0), (0, 0), sigma)
    noise = np.random.default_rng(seed).normal(0, 1, grey.shape)
    image = np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)
    assert blur_sigma_px(image) == pytest.approx(sigma, rel=0.25, abs=0.2)


@given(st.integers(0, 30), st.integers(0, 255))
def test_torn_rows_are_counted(n_torn: int, value: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8)
    image[30 - n_torn :] = value
    assert n_torn_rows(image) == n_torn


@given(st.floats(-5, 5), st.floats(0, 0.8), st.integers(0, 2**32 - 1))
def test_wrong_matches_do_not_reach_the_row_error(offset: float, sigma: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(offset, sigma, 1000)
    rows[:30] = rng.uniform(-30, 30, 30)
    left = np.zeros((1000, 2))
    median_px, spread_px = row_error(np.c_[left, np.zeros(1000), rows])
    assert median_px == pytest.approx(offset, abs=0.15 * sigma + 0.01)
    clean = np.percentile(np.abs(rng.normal(offset, sigma, 100_000)), 95)
    assert spread_px == pytest.approx(clean, rel=0.2, abs=0.1)


@pytest.mark.parametrize(("du", "dv"), [(-20.5, 3.75)])
def test_free_matches_find_any_offset(du: float, dv: float) -> None:
    left = render("handheld", "rgbd").stream(0)[0].load()
    M = np.array([[1.0, 0.0, -du], [0.0, 1.0, dv]])
    size = left.shape[::-1]
    right = np.asarray(cv2.warpAffine(left, M, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
    matches = FreeMatcher(Config()).match(left, right)
    assert len(matches) > 100
    assert np.median(matches[:, 0] - matches[:, 2]) == pytest.approx(du, abs=0.05)
    assert np.median(matches[:, 3] - matches[:, 1]) == pytest.approx(dv, abs=0.05)
