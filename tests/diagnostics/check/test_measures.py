"""The measures of images and of registration against what was put in."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import Config
from gvo.diagnostics.check.depth import Misregistration, depth_steps, estimate_misregistration
from gvo.diagnostics.check.images import blur_sigma_px, n_torn_rows
from gvo.diagnostics.check.stereo import FreeMatcher, FreeMatches, row_error
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


@pytest.mark.parametrize(("du", "dv"), [(0, 0), (3, 0), (0, -7), (-9, 4), (11, 11)])
def test_the_offset_of_depth_is_measured(du: int, dv: int) -> None:
    found = estimate_misregistration(frames(du, dv))
    assert isinstance(found, Misregistration)
    assert found.shift_px == pytest.approx((-du, -dv), abs=0.6)
    assert found.zoom == 1.0
    assert found.rms_px == pytest.approx(math.hypot(du, dv), abs=0.6)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_depth_of_another_focal_length_is_measured(factor: float) -> None:
    zoomed = []
    for frame in frames(0, 0):
        height, width = frame.depth.shape
        M = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
        depth = cv2.warpAffine(
            frame.depth, M, (width, height), flags=cv2.INTER_NEAREST, borderValue=5.0
        )
        zoomed.append(RgbdFrame(stamp_ns=0, image=frame.image, depth=np.asarray(depth, np.float32)))
    found = estimate_misregistration(zoomed)
    assert isinstance(found, Misregistration)
    assert found.zoom == pytest.approx(1.0 / factor, abs=0.021)
    assert found.shift_px == pytest.approx((0.0, 0.0), abs=1.0)


def test_depth_that_lost_its_edges_is_not_taken_for_shifted() -> None:
    whole = frames(0, 0)
    eroded = []
    for frame in whole:
        is_step = cv2.dilate(
            (np.abs(cv2.Laplacian(frame.depth, cv2.CV_32F)) > 0.1).astype(np.uint8),
            np.ones((5, 5), np.uint8),
        )
        depth = np.where(is_step > 0, np.float32(np.nan), frame.depth).astype(np.float32)
        eroded.append(RgbdFrame(stamp_ns=frame.stamp_ns, image=frame.image, depth=depth))
    found = estimate_misregistration(eroded)
    assert isinstance(found, Misregistration)
    assert found.shift_px == pytest.approx((0.0, 0.0), abs=0.6)


def test_images_that_have_nothing_to_do_with_the_depth_give_no_answer() -> None:
    rng = np.random.default_rng(0)
    noise = [
        RgbdFrame(
            stamp_ns=frame.stamp_ns,
            image=rng.integers(0, 256, frame.image.shape, dtype=np.uint8),
            depth=frame.depth,
        )
        for frame in frames(0, 0)
    ]
    assert isinstance(estimate_misregistration(noise), Failure)


def test_things_at_the_border_alone_give_no_answer_and_no_warning() -> None:
    found = []
    for seed in range(8):
        image = np.random.default_rng(seed).integers(0, 255, (240, 320)).astype(np.uint8)
        depth = np.full((240, 320), 3.0, np.float32)
        depth[:, 2:6] = 1.0  # a mast, nearer to the border than the search reaches
        found.append(RgbdFrame(stamp_ns=seed, image=image, depth=depth))
    assert isinstance(estimate_misregistration(found), Failure)


def test_a_wall_has_no_steps() -> None:
    depth = np.full((40, 60), 2.0, dtype=np.float32)
    assert not np.any(depth_steps(depth))
    frame = RgbdFrame(stamp_ns=0, image=np.zeros((40, 60), np.uint8), depth=depth)
    assert isinstance(estimate_misregistration([frame]), Failure)


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


def test_an_image_without_edges_has_no_blur() -> None:
    assert math.isnan(blur_sigma_px(np.full((60, 80), 120, dtype=np.uint8)))


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
    error = row_error(FreeMatches(pixels_left=left, pixels_right=np.c_[np.zeros(1000), rows]))
    assert error.median_px == pytest.approx(offset, abs=0.15 * sigma + 0.01)
    clean = np.percentile(np.abs(rng.normal(offset, sigma, 100_000)), 95)
    assert error.percentile_95_px == pytest.approx(clean, rel=0.2, abs=0.1)


@pytest.mark.parametrize(("du", "dv"), [(12.25, 0.0), (-20.5, 3.75), (5.0, -9.5)])
def test_free_matches_find_any_offset(du: float, dv: float) -> None:
    left = render("handheld", "rgbd").stream(0)[0].load()
    M = np.array([[1.0, 0.0, -du], [0.0, 1.0, dv]])
    size = left.shape[::-1]
    right = np.asarray(cv2.warpAffine(left, M, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
    matches = FreeMatcher(Config()).match(left, right)
    assert len(matches) > 100
    assert np.median(matches.disparities) == pytest.approx(du, abs=0.05)
    assert np.median(matches.row_differences) == pytest.approx(dv, abs=0.05)


def test_images_without_features_have_no_matches() -> None:
    flat = np.full((120, 160), 90, dtype=np.uint8)
    assert len(FreeMatcher(Config()).match(flat, flat)) == 0
