"""Kernels of corners, each against a few lines of NumPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gvo.kernels import corners as kernels
from gvo.types import FloatArray, ImageArray, IntArray

BORDER = 3


def noise(shape: tuple[int, int], seed: int = 0, contrast: float = 1.0) -> ImageArray:
    """Return squares of two pixels, some of them of one grey."""
    rng = np.random.default_rng(seed)
    values = 120 + contrast * rng.integers(-2, 3, (shape[0] // 2 + 1, shape[1] // 2 + 1)) * 40
    picture: ImageArray = np.kron(values, np.ones((2, 2))).astype(np.uint8)
    return np.ascontiguousarray(picture[: shape[0], : shape[1]])


def find(half: ImageArray, spacing_px: int) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return the corners by rows, and their scores."""
    shape = 2 * half.shape[0] // spacing_px + 1, 2 * half.shape[1] // spacing_px + 1
    places, scores = np.full(shape, 7), np.full(shape, 7.0, np.float32)
    rows = np.full((kernels.N_ROWS, half.shape[1]), np.nan, np.float32)
    kernels.find_corners(half, BORDER, spacing_px, rows, places, scores)
    assert np.all(scores[places == -1] == 0.0)
    order = [place for place in np.argsort(places, axis=None) if places.flat[place] >= 0]
    v, u = np.divmod(places.ravel()[order], half.shape[1])
    return 2.0 * np.stack([u, v], axis=1), scores.ravel()[order]


def scores_plainly(half: ImageArray) -> FloatArray:
    """Return the smaller eigenvalue of each pixel, zero at the border; grey in [0, 1]."""
    windows = sliding_window_view(half / 255.0, (3, 3))
    sobel = np.outer([1, 2, 1], [-1, 0, 1])
    along, across = (np.sum(windows * each, axis=(2, 3)) for each in (sobel, sobel.T))
    gradients = np.stack([along, across]) / 4.0 / 3.0
    products = sliding_window_view(gradients[:, None] * gradients[None], (3, 3), axis=(2, 3))
    covariances = np.moveaxis(products.sum(axis=(4, 5)), (0, 1), (2, 3))
    return np.pad(np.linalg.eigvalsh(covariances)[..., 0], 2)


def find_plainly(half: ImageArray, spacing_px: int) -> dict[tuple[int, int], float]:
    """Do as `find_corners` says; of what is equal up to rounding the last."""
    scores, best = scores_plainly(half).round(9), dict[tuple[int, int], tuple[float, int, int]]()
    for v in range(BORDER, half.shape[0] - BORDER):
        for u in range(BORDER, half.shape[1] - BORDER):
            score = scores[v, u]
            if score > 1e-4 and score == scores[v - 1 : v + 2, u - 1 : u + 2].max():
                cell = 2 * v // spacing_px, 2 * u // spacing_px
                best[cell] = max(best.get(cell, (0.0, 0, 0)), (score, v, u))
    return {(2 * u, 2 * v): score for score, v, u in best.values()}


@pytest.mark.parametrize("shape", [(24, 31), (40, 9), (7, 60)])
@pytest.mark.parametrize("spacing_px", [5, 10, 40])
def test_each_cell_gives_its_best_local_maximum(shape: tuple[int, int], spacing_px: int) -> None:
    for seed in range(3):
        half = noise(shape, seed)
        pixels, scores = find(half, spacing_px)
        expected = find_plainly(half, spacing_px)
        found = {(int(u), int(v)): score for (u, v), score in zip(pixels, scores, strict=True)}
        assert set(found) == set(expected)
        assert len(expected) > 0
        for place, score in expected.items():
            assert found[place] == pytest.approx(score, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 50), (2, 2), (6, 6), (50, 6)])
def test_images_that_are_all_border_have_no_corners(shape: tuple[int, int]) -> None:
    assert len(find(noise(shape), 4)[0]) == 0


def test_what_is_fainter_than_noise_is_no_corner() -> None:
    # A step by s grey values at a corner has an eigenvalue of about (s / 255)^2 / 2.
    assert len(find(noise((30, 40), contrast=0.02), 8)[0]) == 0
    assert len(find(noise((30, 40), contrast=0.2), 8)[0]) > 0


def choose(pixels: FloatArray, order: IntArray, size_px: int, n_wanted: int) -> list[int]:
    chosen = np.full(len(pixels), -7)
    cells, ranks = np.full((100 // size_px + 1, 100 // size_px + 1), 7), np.full(len(pixels), 7)
    n = kernels.spread(pixels, order, size_px, n_wanted, cells, ranks, chosen)
    found: list[int] = chosen[:n].tolist()
    return found


def choose_plainly(pixels: FloatArray, order: IntArray, size_px: int, n_wanted: int) -> list[int]:
    """Do as `spread` says: by the number of better ones in the same cell, then by the order."""
    cells = [tuple(cell) for cell in (pixels // size_px)[order]]
    ranks = [cells[:k].count(cell) for k, cell in enumerate(cells)]
    best = sorted(range(len(order)), key=lambda k: (ranks[k], k))[:n_wanted]
    return sorted(int(order[k]) for k in best)


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(0, 60),
    size_px=st.sampled_from([1, 7, 33, 100, 400]),
    n_wanted=st.integers(0, 80),
)
def test_the_best_of_all_cells_come_before_the_second_of_any(
    seed: int, n: int, size_px: int, n_wanted: int
) -> None:
    rng = np.random.default_rng(seed)
    pixels, order = rng.uniform(0.0, 100.0, (n, 2)), rng.permutation(n)
    expected = choose_plainly(pixels, order, size_px, n_wanted)
    assert choose(pixels, order, size_px, n_wanted) == expected
