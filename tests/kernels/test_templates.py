"""Patches: cut, prepared and aligned, against the formulas of their docstrings."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.kernels import templates as kernels
from gvo.kernels.sampling import cut_patches
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray
from tests.kernels.images import around, shifted, slopes_along, texture

R = kernels.RADIUS_PX
SIDE = 2 * R + 1


def cut(image: ImageArray, pixels: FloatArray, radius: int = R + 1) -> NDArray[np.uint8]:
    patches = np.full((len(pixels), 2 * radius + 1, 2 * radius + 1), 7, np.uint8)
    cut_patches(image, pixels, patches)
    return patches


@pytest.mark.parametrize("n", [0, 1, 40])
@pytest.mark.parametrize("radius", [0, 1, 5])
def test_patches_are_cut_out_with_the_border_replicated(n: int, radius: int) -> None:
    rng = np.random.default_rng(n)
    image = texture(rng, (20, 30))
    pixels = np.floor(rng.uniform([0, 0], [30, 20], (n, 2)))
    pixels[:3] = np.reshape([0, 0, 29, 19, 29, 0], (3, 2))[:n]
    padded = np.pad(image, radius, mode="edge")
    expected = [
        padded[v : v + 2 * radius + 1, u : u + 2 * radius + 1] for u, v in pixels.astype(int)
    ]
    found = cut(image, pixels, radius)
    np.testing.assert_array_equal(found, np.reshape(expected, found.shape))


Prepared = tuple[NDArray[np.float32], NDArray[np.float32], FloatArray]


def prepare(patches: NDArray[np.uint8]) -> Prepared:
    values = np.full((len(patches), SIDE**2), 7.0, np.float32)
    gradients = np.full((len(patches), 2, SIDE**2), 7.0, np.float32)
    inverses = np.full((len(patches), 4), 7.0)
    kernels.prepare(patches, values, gradients, inverses)
    return values, gradients, inverses


@pytest.mark.parametrize("n", [0, 1, 20])
def test_prepared_patches_have_gradients_and_inverse_hessians(n: int) -> None:
    rng = np.random.default_rng(n)
    patches = cut(texture(rng), rng.integers(0, 48, (n, 2)).astype(float))
    patches[:1] = 90  # flat
    values, gradients, inverses = prepare(patches)
    for k, patch in enumerate(patches.astype(float)):
        inside = patch[1:-1, 1:-1].ravel()
        G = np.stack([slopes_along(patch, axis).ravel() for axis in (1, 0)])
        G -= G.mean(axis=1, keepdims=True)
        inverse = np.linalg.inv(G @ G.T + np.eye(2))
        np.testing.assert_allclose(values[k], inside - inside.mean(), rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(gradients[k], G, rtol=1e-5, atol=1e-5)
        expected = [inverse[0, 0], inverse[0, 1], inverse[1, 1], inside.var()]
        np.testing.assert_allclose(inverses[k], expected, rtol=1e-9, atol=1e-12)


def align(
    image: ImageArray, prepared: Prepared, indices: IntArray, warps: FloatArray, start: FloatArray
) -> tuple[FloatArray, BoolArray]:
    pixels, is_found = start.copy(), np.ones(len(start), np.bool_)
    kernels.align(image, *prepared, indices, warps, pixels, is_found)
    return pixels, is_found


def align_plainly(
    image: ImageArray, prepared: Prepared, index: int, warp: FloatArray, start: FloatArray
) -> tuple[FloatArray, bool, int]:
    """Do as `align` says, for one patch; return its number of steps as well."""
    values, G = prepared[0][index].astype(float), prepared[1][index].astype(float)
    a, b, c, variance = prepared[2][index]
    pixel, step, n_steps = start, np.full(2, np.inf), 0
    while n_steps < 2 or (n_steps < 4 and (np.linalg.norm(step) > 0.03 or n_steps == 3)):
        difference = around(image, pixel, (R, R), warp).ravel() - values
        moved = np.array([[a, b], [b, c]]) @ G @ difference
        unlike = difference.var() - moved @ G @ difference / SIDE**2
        step = warp @ np.clip(moved, -1.0, 1.0)
        pixel, n_steps = pixel - step, n_steps + 1
    is_found = unlike <= 0.5 * variance + 25.0 and np.linalg.norm(step) < 0.2
    return pixel, bool(is_found), n_steps


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("n", [0, 1, 100])
def test_patches_are_aligned_by_inverse_compositional_steps(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    image, warp = texture(rng), np.array([[1.05, 0.1], [-0.08, 0.95]])
    image[28:] = 100 + image[28:] // 16  # faint
    other = shifted(rng, image, warp, (0.4, -0.3))
    noise = np.linspace(0, 1, 80) * rng.normal(size=(48, 80))
    noise *= np.where(np.arange(48) < 28, 80.0, 7.0)[:, np.newaxis]
    other = np.clip(other + noise, 0, 255).astype(np.uint8)
    pixels = rng.integers([0, 0], [80, 48], (n, 2)).astype(float)
    pixels[:4] = np.reshape([0, 0, 79, 47, 4, 4, 75, 43], (4, 2))[:n]
    prepared, indices = prepare(cut(image, pixels)), rng.permutation(n)
    warps = warp + 0.02 * rng.normal(size=(n, 2, 2))
    expected = (pixels[indices] - [40, 24]) @ warp.T + [40.4, 23.7]
    start = expected + rng.choice([0.0, 0.5, 2.0], (n, 1)) * rng.normal(size=(n, 2))
    found, is_found = align(other, prepared, indices, warps, start)
    plain = [
        align_plainly(other, prepared, *each) for each in zip(indices, warps, start, strict=True)
    ]
    for k, (pixel, is_expected, _) in enumerate(plain):
        np.testing.assert_allclose(found[k], pixel, rtol=1e-9, atol=1e-9)
        assert is_found[k] == is_expected
    if n > 1:
        assert {n_steps for *_, n_steps in plain} == {2, 4}
        assert 0.2 < is_found.mean() < 0.95


def test_an_unknown_place_spoils_itself_alone() -> None:
    image = texture(np.random.default_rng(3))
    pixels, warps = np.array([[20.0, 20.0], [40.0, 20.0]]), np.tile(np.eye(2), (2, 1, 1))
    prepared, start = prepare(cut(image, pixels)), pixels.copy()
    start[0, 0] = np.nan
    found, is_found = align(image, prepared, np.arange(2), warps, start)
    assert is_found.tolist() == [False, True]
    np.testing.assert_allclose(found[1], pixels[1], atol=0.01)
