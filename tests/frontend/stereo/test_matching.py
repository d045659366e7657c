"""Stereo matching against a search over all pairs, and disparities of images shifted exactly."""

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.features import Features
from gvo.frontend.stereo.matching import (
    candidate_pairs,
    match_stereo,
    parabola_minimum,
    refine_disparities,
)
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray, ImageArray, IntArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)
CAMERA = StereoCamera(fx=100.0, fy=100.0, cx=32.0, cy=16.0, width=64, height=32, baseline=0.5)
SETTINGS = StereoConfig(
    min_depth_m=2.0,  # 25 px
    max_depth_m=20.0,  # 2.5 px
    row_tolerance_px=1.5,
    max_distance=0.3,
    subpixel="parabola",
)


def features(
    keypoints: FloatArray,
    descriptors: NDArray[np.uint8] | None = None,
    octaves: IntArray | None = None,
) -> Features:
    n = len(keypoints)
    return Features(
        keypoints=np.asarray(keypoints, dtype=np.float64).reshape(n, 2),
        octaves=np.zeros(n, dtype=np.int64) if octaves is None else octaves,
        descriptors=np.zeros((n, 32), np.uint8) if descriptors is None else descriptors,
    )


def keypoints_on_a_lattice(rng: np.random.Generator, n: int) -> FloatArray:
    """Return pixels of which many share rows, columns and fractions."""
    fraction = rng.choice([1.0, 0.5, 0.25, 0.3])
    return np.asarray(rng.integers(0, [int(63 / fraction), int(31 / fraction)], (n, 2)) * fraction)


@settings(max_examples=150)
@given(
    seed=seeds,
    n=st.integers(0, 25),
    m=st.integers(0, 25),
    tolerance=st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 3.3]),
    min_depth=st.sampled_from([0.4, 0.9, 2.03, 5.01]),
    max_depth=st.sampled_from([5.3, 20.7, 200.0, 1e6]),
)
def test_candidates_are_all_pairs_that_obey_rows_and_depth(
    seed: int, n: int, m: int, tolerance: float, min_depth: float, max_depth: float
) -> None:
    rng = np.random.default_rng(seed)
    left, right = keypoints_on_a_lattice(rng, n), keypoints_on_a_lattice(rng, m)
    config = SETTINGS.model_copy(
        update={"row_tolerance_px": tolerance, "min_depth_m": min_depth, "max_depth_m": max_depth}
    )
    pairs = candidate_pairs(features(left), features(right), CAMERA, config)
    expected = set()
    for i, (u_left, v_left) in enumerate(left):
        for j, (u_right, v_right) in enumerate(right):
            disparity = u_left - u_right
            is_in_range = 50.0 / max_depth <= disparity <= 50.0 / min_depth
            if abs(v_left - v_right) <= tolerance and is_in_range:
                expected.add((i, j))
    found = [(int(i), int(j)) for i, j in pairs]
    assert set(found) == expected
    assert len(found) == len(expected)


def test_rows_between_two_pixels_are_not_rounded_apart() -> None:
    left = features(np.array([[40.0, v + 0.5] for v in range(0, 12, 4)]))
    right = features(np.array([[30.0, v + 1.5] for v in range(0, 12, 4)]))
    config = SETTINGS.model_copy(update={"row_tolerance_px": 1.0})
    assert candidate_pairs(left, right, CAMERA, config).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_matches_are_reciprocal_and_close() -> None:
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (4, 32), dtype=np.uint8)
    left = features(np.array([[40.0, 10], [41.0, 10], [50.0, 20], [60.0, 25]]), codes)
    near = codes.copy()
    near[0, 0] ^= 1  # right 0 resembles left 0
    right = features(
        np.array([[30.0, 10], [40.0, 20], [35.0, 20], [50.0, 25]]),
        np.stack([near[0], codes[2], codes[2] ^ 3, rng.integers(0, 256, 32, dtype=np.uint8)]),
    )
    # Left 1 loses its only candidate to left 0; left 2 takes the closer; left 3 has none close.
    assert match_stereo(left, right, CAMERA, SETTINGS).tolist() == [[0, 0], [2, 1]]


def test_octaves_may_differ_by_one() -> None:
    left = features(np.array([[40.0, 5.0], [40.0, 12.0]]), octaves=np.array([0, 0]))
    right = features(np.array([[30.0, 5.0], [30.0, 12.0]]), octaves=np.array([1, 2]))
    assert match_stereo(left, right, CAMERA, SETTINGS).tolist() == [[0, 0]]


@settings(max_examples=50)
@given(seed=seeds, n=st.integers(0, 30), m=st.integers(0, 30))
def test_no_keypoint_is_matched_twice_all_matches_are_candidates(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 256, (5, 32), dtype=np.uint8)
    left = features(keypoints_on_a_lattice(rng, n), codes[rng.integers(0, 5, n)])
    right = features(keypoints_on_a_lattice(rng, m), codes[rng.integers(0, 5, m)])
    pairs = match_stereo(left, right, CAMERA, SETTINGS)
    assert len(set(pairs[:, 0].tolist())) == len(set(pairs[:, 1].tolist())) == len(pairs)
    candidates = set(map(tuple, candidate_pairs(left, right, CAMERA, SETTINGS).tolist()))
    assert set(map(tuple, pairs.tolist())) <= candidates
    assert (left.descriptors[pairs[:, 0]] == right.descriptors[pairs[:, 1]]).all()


def texture(seed: int, shift: float, *, gain: float = 1.0, offset: float = 0.0) -> ImageArray:
    """Render a sum of waves, longer than 5 px, moved to the left by `shift` pixels."""
    rng = np.random.default_rng(seed)
    angles, phases = rng.uniform(0, 2 * np.pi, (2, 60))
    waves = rng.uniform(2 * np.pi / 40, 2 * np.pi / 5, 60)
    v, u = np.indices((120, 160)).astype(float)
    image = np.zeros_like(u)
    for angle, phase, wave in zip(angles, phases, waves, strict=True):
        along = np.cos(angle) * (u + shift) + np.sin(angle) * v
        image += np.cos(wave * along + phase)
    return np.asarray(np.clip(np.rint(gain * (128 + 10 * image) + offset), 0, 255).astype(np.uint8))


def grid_pixels() -> FloatArray:
    v, u = np.mgrid[12:108:7, 40:148:7]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(float)


def disparity_errors(
    images: tuple[ImageArray, ImageArray], shift: float, config: StereoConfig = SETTINGS
) -> FloatArray:
    left = grid_pixels()
    # A match of keypoints is off by up to a pixel and a half.
    slip = np.random.default_rng(1).integers(-1, 2, len(left))
    right = left - np.column_stack([np.rint(shift) + slip, np.zeros(len(left))])
    disparities, is_valid = refine_disparities(images, left, right, config)
    assert is_valid.mean() > 0.9
    return np.asarray(disparities[is_valid] - shift)


@pytest.mark.parametrize("shift", [8.0, 8.1, 8.25, 8.4, 8.5, 8.6, 8.75, 8.9, 0.3])
def test_disparities_of_a_shifted_texture_are_found_to_a_fraction_of_a_pixel(shift: float) -> None:
    errors = disparity_errors((texture(0, 0.0), texture(0, shift)), shift)
    assert abs(errors.mean()) < 0.03
    assert errors.std() < 0.1
    assert np.abs(errors).max() < 0.3


def test_disparities_are_no_integers() -> None:
    errors = np.concatenate(
        [
            disparity_errors((texture(2, 0.0), texture(2, shift)), shift)
            for shift in np.arange(8.0, 9.0, 0.125)
        ]
    )
    # Whole pixels would err by 0.29 px.
    assert np.sqrt(np.mean(errors**2)) < 0.1


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 25.0), (1.0, -20.0), (0.85, 0.0)])
def test_unequal_exposure_does_not_move_disparities(gain: float, offset: float) -> None:
    left = texture(3, 0.0)
    plain = disparity_errors((left, texture(3, 8.3)), 8.3)
    exposed = disparity_errors((left, texture(3, 8.3, gain=gain, offset=offset)), 8.3)
    assert abs(exposed.mean() - plain.mean()) < 0.02
    assert exposed.std() < 0.1


def test_patches_that_leave_the_image_are_invalid() -> None:
    images = (texture(4, 0.0), texture(4, 0.0))
    # The patch has a radius of 5; the strip in the right image reaches 3 px farther.
    left = np.array([[80.0, v] for v in (4, 5, 114, 115)] + [[u, 60.0] for u in (4, 154, 155)])
    right = left.copy()
    right[4:, 0] = 80.0
    is_valid = refine_disparities(images, left, right, SETTINGS)[1]
    assert is_valid[[0, 3, 4, 6]].tolist() == [False] * 4
    assert refine_disparities(images, left[1:3], right[1:3], SETTINGS)[1].all()
    at_left_end = np.array([[80.0, 60.0]])
    for u_right in (7.0, 152.0, -3.0, 400.0):
        result = refine_disparities(images, at_left_end, np.array([[u_right, 60.0]]), SETTINGS)
        assert not result[1].any()
    for u in (8.0, 151.0):
        there = np.array([[u, 60.0]])
        assert refine_disparities(images, there, there, SETTINGS)[1].all()


def test_a_minimum_at_the_end_of_the_search_is_invalid() -> None:
    images = (texture(5, 0.0), texture(5, 20.0))
    left = grid_pixels()
    is_valid = refine_disparities(images, left, left - [16.0, 0.0], SETTINGS)[1]
    # The true column is beyond the reach of 3: only chance minima remain, mostly none.
    assert is_valid.mean() < 0.6
    assert refine_disparities(images, left, left - [18.0, 0.0], SETTINGS)[1].mean() > 0.9


def test_an_image_without_texture_has_no_disparity() -> None:
    grey = np.full((120, 160), 90, dtype=np.uint8)
    left = grid_pixels()
    assert not refine_disparities((grey, grey), left, left - [8.0, 0.0], SETTINGS)[1].any()


@pytest.mark.parametrize("subpixel", ["parabola", "none"])
def test_no_matches_give_no_disparities(subpixel: Literal["parabola", "none"]) -> None:
    config = SETTINGS.model_copy(update={"subpixel": subpixel})
    images = (texture(0, 0.0), texture(0, 1.0))
    disparities, is_valid = refine_disparities(images, np.zeros((0, 2)), np.zeros((0, 2)), config)
    assert disparities.shape == is_valid.shape == (0,)


def test_images_smaller_than_a_patch_have_no_disparity() -> None:
    tiny = np.zeros((8, 9), dtype=np.uint8)
    at = np.array([[4.0, 4.0]])
    assert not refine_disparities((tiny, tiny), at, at, SETTINGS)[1].any()


def test_without_subpixel_the_disparity_is_that_of_the_keypoints() -> None:
    config = SETTINGS.model_copy(update={"subpixel": "none"})
    images = (texture(0, 0.0), texture(0, 8.4))
    left, right = np.array([[40.25, 20.0]]), np.array([[32.0, 20.5]])
    disparities, is_valid = refine_disparities(images, left, right, config)
    assert disparities.tolist() == [8.25]
    assert is_valid.all()


@given(minimum=st.floats(0.51, 5.49), curvature=st.floats(1e-3, 1e3), height=st.floats(-1e3, 1e3))
def test_a_parabola_has_its_minimum_found(minimum: float, curvature: float, height: float) -> None:
    values = curvature * (np.arange(7) - minimum) ** 2 + height
    positions, is_minimum = parabola_minimum(values[np.newaxis].astype(np.float64))
    assert is_minimum.all()
    assert positions[0] == pytest.approx(minimum, abs=1e-6)


def test_curves_without_an_inner_minimum_are_told() -> None:
    curves = np.array(
        [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 1, 1, 1, 1], [5, 4, 1, 4, 5]], dtype=np.float32
    )
    assert parabola_minimum(curves)[1].tolist() == [False, False, False, True]
    assert parabola_minimum(curves[:0])[0].shape == (0,)


@pytest.mark.parametrize(("max_ratio", "is_found"), [(1.0, True), (0.51, True), (0.49, False)])
def test_a_match_must_stand_out_from_the_second_best(max_ratio: float, is_found: bool) -> None:
    code = np.zeros((1, 32), np.uint8)
    best, second = code.copy(), code.copy()
    best[0, 0], second[0, 0] = 0b11, 0b1111  # two bits and four: a ratio of a half
    left = features(np.array([[40.0, 10.0]]), code)
    right = features(np.array([[30.0, 10.0], [35.0, 10.0]]), np.concatenate([best, second]))
    config = SETTINGS.model_copy(update={"max_ratio": max_ratio})
    expected = [[0, 0]] if is_found else []
    assert match_stereo(left, right, CAMERA, config).tolist() == expected
