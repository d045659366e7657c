"""Disparities against the formulas of their docstrings, corner by corner."""

import numpy as np
import pytest

from gvo.kernels import stereo as kernels
from gvo.types import BoolArray, FloatArray, ImageArray
from tests.kernels.images import around, shifted, slopes_along, texture

R = kernels.RADIUS_PX
SIDE, MARGIN, N_PLACES = 2 * R + 1, 4, 9
WARP = np.array([[0.93, 0.06], [0.0, 1.0]])
"""Of the right image: that of a slanted surface."""


def peak(values: FloatArray) -> float:
    """Return the place of the parabola's vertex, or the end."""
    best = int(np.argmax(values))
    if best in (0, len(values) - 1):
        return best
    a, b, _ = np.polyfit([-1.0, 0.0, 1.0], values[best - 1 : best + 2], 2)
    return float(best - b / (2.0 * a))


def pair(
    rng: np.random.Generator, warp: FloatArray = WARP, *, blur: float = 1.5
) -> tuple[ImageArray, ImageArray]:
    """Return images of a plane.

    Windows more or less alike, from above; bars that are alike from five and six pixels to the
    next; faint texture; clear one.
    """
    left = texture(rng, (84, 128), blur=blur)
    unlike = np.linspace(0, 0.5, 128) * (texture(rng, (26, 128), blur=blur) - 120.0)
    left[:26] = np.clip(np.tile(left[:26, :26], 5)[:, :128] + unlike, 0, 255)
    for first, period in ((0, 5), (60, 6)):
        bar = left[26:46, first : first + period]
        left[26:46, first : first + 60] = np.tile(bar, 12)[:, :60]
    left[46:62] = 100 + left[46:62] // 20
    right = shifted(rng, left, warp, (-14.0, 0.3))
    right[:, 84:] = texture(rng, (84, 44))
    return left, right


def corners_of(
    rng: np.random.Generator, n: int, warp: FloatArray = WARP
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, some of them near or beyond the border, and their disparities."""
    corners = np.rint(rng.uniform([14, 4], [118, 80], (n, 2)))
    ends = np.reshape([24.0, 5, 24, 4, 122, 78, 122, 79, 123, 50, np.nan, 30], (6, 2))
    corners[:6] = ends[:n]
    return corners, 14.0 + (corners - [64, 42]) @ ([1.0, 0.0] - warp[0])


def search_plainly(
    images: tuple[ImageArray, ImageArray], pixel: FloatArray, max_disparity: float
) -> tuple[float, bool, list[float]]:
    """Do as `search` says, for one pixel."""
    width = images[0].shape[1]
    n_steps = min(int(np.ceil(max_disparity / 4)), width)
    column, row = np.minimum(pixel // 4, np.subtract(images[0].shape[::-1], 1))
    scores, a = np.full(n_steps + 1, -1.0), around(images[0], (column, row), (2, 2))
    for step in range(n_steps + 1):
        b = around(images[1], (column - n_steps + step, row), (2, 2))
        if column - n_steps + step >= 0:
            energies = [max(25 * each.var(), 50.0) for each in (a, b)]
            scores[step] = 25 * np.mean((a - a.mean()) * (b - b.mean())) / np.prod(energies) ** 0.5
    found, top, rivals = 4 * (n_steps - peak(scores)), float(np.max(scores)), [np.nan] * 3
    for rank in range(3):
        best = int(np.argmax(scores))
        scores[max(best - 2, 0) : best + 3] = -1.0
        if not np.max(scores) > top - 0.25:
            break
        rivals[rank] = 4 * (n_steps - peak(scores))
    return found, top > 0.7, rivals


@pytest.mark.parametrize("n", [0, 1, 60])
@pytest.mark.parametrize("max_disparity", [0.0, 30.5, 40.0, 1e3])
def test_the_coarse_search_takes_peaks_of_correlation(n: int, max_disparity: float) -> None:
    rng = np.random.default_rng(n)
    left = texture(rng, (20, 32), blur=0.8)
    left[:8] = np.tile(left[:8, :5], 7)[:, :32]
    right = shifted(rng, left, np.eye(2), (-4.3, 0.0))
    left[-6:, -6:], right[8:14] = 100, 100 + right[8:14] // 32  # flat, and nearly so
    pixels = rng.integers([0, 0], [130, 82], (n, 2)).astype(float)
    pixels[:3] = np.reshape([0.0, 0, 131, 83, 126, 79], (3, 2))[:n]
    found, is_found, rivals = np.full(n, 7.0), np.ones(n, np.bool_), np.full((n, 3), 7.0)
    kernels.search(left, right, pixels, max_disparity, found, is_found, rivals)
    plain = [search_plainly((left, right), pixel, max_disparity) for pixel in pixels]
    for k, (disparity, is_expected, others) in enumerate(plain):
        np.testing.assert_allclose([found[k], *rivals[k]], [disparity, *others], rtol=1e-9)
        assert is_found[k] == is_expected
    if n > 1 and max_disparity:
        assert 0.2 < is_found.mean() < 0.9
        assert 0.05 < np.isfinite(rivals).mean() < 0.9


def has_room(u: float, v: float, disparity: float) -> bool:
    return R <= u <= 127 - R and R <= v <= 83 - R and R <= u - disparity <= 127 - R


def weights_of(wide: FloatArray) -> FloatArray:
    """Return the gradients along rows less their mean, over their energy."""
    along = slopes_along(wide, 1)
    along = along - along.mean()
    return np.asarray(along / max(float(np.sum(along**2)), 50.0))


def follow_plainly(
    wide: FloatArray, strip: FloatArray, place: float, n_steps: int, max_step: float
) -> tuple[float, float]:
    """Return the place in a strip after Gauss-Newton steps, and the last of them."""
    place, step = float(np.clip(place, 0.0, N_PLACES - 1.0)), 0.0
    for _ in range(n_steps):
        whole = min(int(place), N_PLACES - 2)
        before, after = strip[:, whole : whole + SIDE], strip[:, whole + 1 : whole + 1 + SIDE]
        seen = before + (place - whole) * (after - before)
        step = float(np.sum(weights_of(wide) * (seen - wide[1:-1, 1:-1])))
        step = float(np.clip(step, -max_step, max_step))
        place = float(np.clip(place - step, 0.0, N_PLACES - 1.0))
    return place, step


def nearest_plainly(wide: FloatArray, strip: FloatArray) -> tuple[float, bool]:
    """Return the place of the least squared difference less its mean, and whether it is one."""
    patch = wide[1:-1, 1:-1]
    likeness = [-float(np.var(strip[:, p : p + SIDE] - patch)) for p in range(N_PLACES)]
    return peak(np.array(likeness)), 0 < int(np.argmax(likeness)) < N_PLACES - 1


def assert_same(
    found: tuple[FloatArray, BoolArray], plain: list[tuple[float, bool]], low: float, high: float
) -> None:
    """Check disparities, and which of them are valid: a share between two bounds."""
    expected = np.reshape(np.array(plain, dtype=float), (-1, 2))
    np.testing.assert_allclose(found[0], expected[:, 0], rtol=1e-9)
    np.testing.assert_array_equal(found[1], expected[:, 1].astype(bool))
    assert len(plain) < 2 or low < np.mean(found[1]) < high


def away(rng: np.random.Generator, disparities: FloatArray) -> FloatArray:
    """Return starts of searches, some of them too far, and the last one unknown."""
    starts = disparities + rng.choice([0.3, 2.0, 4.0], len(disparities)) * rng.uniform(
        -1, 1, len(disparities)
    )
    starts[6:7] = np.nan
    return starts


def searches(
    rng: np.random.Generator, n: int
) -> tuple[tuple[ImageArray, ImageArray], FloatArray, FloatArray]:
    """Return images, pixels between whole ones, and where to search for their disparities."""
    images = pair(rng)
    pixels, disparities = corners_of(rng, n)
    pixels += rng.choice([0.0, 0.37], (n, 2))
    return images, pixels, away(rng, disparities)


@pytest.mark.parametrize("n", [0, 1, 80])
@pytest.mark.parametrize("n_steps", [1, 4])
def test_disparities_are_followed_by_gauss_newton_steps(n: int, n_steps: int) -> None:
    rng = np.random.default_rng(n)
    (left, right), pixels, starts = searches(rng, n)
    slopes = [1.0, 0.0] - WARP[0] + 0.05 * rng.normal(size=(n, 2))
    found, is_valid, plain = np.full(n, 7.0), np.ones(n, np.bool_), []
    kernels.follow(
        left, right, pixels, starts, slopes, np.full(len(pixels), 0.3), n_steps, found, is_valid
    )
    for (u, v), start, (along, across) in zip(pixels, starts, slopes, strict=True):
        if not has_room(u, v, start):
            plain.append((np.nan, False))
            continue
        wide = around(left, (u, v), (R + 1, R + 1))
        warp = np.array([[1.0 - along, -across], [0.0, 1.0]])
        strip = around(right, (u - start, v + 0.3), (R + MARGIN, R), warp)
        place, step = follow_plainly(wide, strip, MARGIN, n_steps, 1.5)
        shift = (1.0 - along) * (place - MARGIN)
        plain.append((start - shift, abs(shift) < 3.0 and abs(step) < 0.3))
    assert_same((found, is_valid), plain, 0.2, 0.9)


@pytest.mark.parametrize("n", [0, 1, 80])
@pytest.mark.parametrize("is_refined", [False, True])
def test_disparities_are_searched_for_near_predictions(n: int, is_refined: bool) -> None:
    rng = np.random.default_rng(n)
    (left, right), pixels, starts = searches(rng, n)
    found, is_valid, plain = np.full(n, 7.0), np.ones(n, np.bool_), []
    kernels.search_near(
        left, right, pixels, starts, np.full(len(pixels), 0.3), is_refined, found, is_valid
    )
    for (u, v), start in zip(pixels, starts, strict=True):
        if not has_room(u, v, start):
            plain.append((np.nan, False))
            continue
        column = np.floor(u - start)
        wide = around(left, (u, v), (R + 1, R + 1))
        strip = around(right, (column, v + 0.3), (R + MARGIN, R))
        place, is_minimum = nearest_plainly(wide, strip)
        if is_refined:
            place, _ = follow_plainly(wide, strip, place, 3, 0.5)
        disparity = u - column - (place - MARGIN)
        plain.append((disparity if is_refined else float(np.rint(disparity)), is_minimum))
    assert_same((found, is_valid), plain, 0.2, 0.9)


def fit_plainly(
    wide: FloatArray, right: ImageArray, u: float, row: float, disparity: float
) -> tuple[FloatArray, FloatArray, bool]:
    """Return a plane (disparity, slopes), the patch seen before the last step, whether it fits."""
    j, i = np.mgrid[-R : R + 1, -R : R + 1]
    along, sharper = slopes_along(wide, 1), np.diff(wide, 2, axis=1)[1:-1]
    B = np.stack([along, along * i, along * j, sharper]).reshape(4, -1)
    B -= B.mean(axis=1, keepdims=True)
    priors, plane = np.diag([1.0, 100.0, 100.0, 1000.0]), np.array([disparity, 0.0, 0.0])
    for _ in range(2):
        warp = np.array([[1.0 - plane[1], -plane[2]], [0.0, 1.0]])
        seen = around(right, (u - plane[0], row), (R, R), warp)
        pull = B @ (seen - wide[1:-1, 1:-1]).ravel() - priors @ [0.0, plane[1], plane[2], 0.0]
        step = np.linalg.solve(B @ B.T + priors, pull)
        plane = plane + (1.0 - plane[1]) / max(1.0 + step[1], 0.5) * step[:3]
    is_fit = np.all(np.abs(plane[1:]) < 0.5) and abs(plane[0] - disparity) < 1.5
    return plane, seen, bool(is_fit)


def match_plainly(
    wide: FloatArray, right: ImageArray, u: float, row: float, start: float, is_refined: bool
) -> tuple[float, float]:
    """Return a disparity near a start, and the variance of the difference there; inf: none."""
    column = np.floor(u - start)
    strip = around(right, (column, row), (R + MARGIN, R))
    if is_refined:
        place, step = follow_plainly(wide, strip, u - start - column + MARGIN, 6, 1.5)
        disparity = u - column - place + MARGIN
        is_found = abs(disparity - start) < 3.0 and abs(step) < 0.3
    else:
        place, is_found = nearest_plainly(wide, strip)
        disparity = np.rint(u - column - place + MARGIN)
    difference = around(right, (u - disparity, row), (R, R)) - wide[1:-1, 1:-1]
    return float(disparity), float(difference.var()) if is_found else np.inf


def measure_plainly(
    images: tuple[ImageArray, ImageArray], corner: FloatArray, starts: FloatArray, is_refined: bool
) -> tuple[list[float], bool]:
    """Do as `measure` says, for one corner: (disparity, slopes, row shift), and whether reliable.

    The first start is NaN where it was not found, the others are those of rivals.
    """
    (left, right), (u, v), row = images, corner, corner[1] + 0.3
    if not has_room(u, v, starts[0]):
        return [np.nan, 0.0, 0.0, np.nan], False
    wide = around(left, (u, v), (R + 1, R + 1))
    limit = 0.2 * wide[1:-1, 1:-1].var() + 18.0
    (disparity, unlike), *rivals = (
        match_plainly(wide, right, u, row, start, is_refined)
        for start in starts
        if has_room(u, v, start)
    )
    others = [each for there, each in rivals if abs(there - disparity) > 5.0]
    if unlike > limit or any(each <= min(limit, 2.0 * unlike + 18.0) for each in others):
        return [disparity, 0.0, 0.0, np.nan], False
    plane, is_fit = np.array([disparity, 0.0, 0.0]), True
    seen = around(right, (u - disparity, row), (R, R))
    if is_refined:
        plane, seen, is_fit = fit_plainly(wide, right, u, row, disparity)
    across = slopes_along(wide, 0)
    across = across - across.mean()
    shift = np.sum(across * (wide[1:-1, 1:-1] - seen)) / max(float(np.sum(across**2)), 50.0)
    return [*plane, shift if is_fit else np.nan], is_fit


@pytest.mark.parametrize("n", [0, 1, 120])
@pytest.mark.parametrize("is_refined", [False, True])
@pytest.mark.parametrize(("row", "blur"), [((0.93, 0.06), 1.5), ((1.0, 0.55), 5), ((1.8, 0), 5)])
def test_corners_are_measured_where_they_match_and_nothing_else_does(
    n: int, is_refined: bool, row: tuple[float, float], blur: float
) -> None:
    rng, warp = np.random.default_rng(n), np.array([row, (0.0, 1.0)])
    images = pair(rng, warp, blur=blur)
    corners, disparities = corners_of(rng, n, warp)
    rough, is_known = away(rng, disparities), np.arange(n) != 7
    rivals = rough[:, np.newaxis] + [26.0, -26.0, np.nan] + rng.uniform(-1, 1, (n, 3))
    rivals[9:, 2] = rough[9:] + rng.uniform(3, 8, len(rough[9:]))  # the same minimum, or not
    found, slopes, shifts = np.full(n, 7.0), np.full((n, 2), 7.0), np.full(n, 7.0)
    is_reliable = np.ones(n, np.bool_)
    given = *images, corners, rough, is_known, rivals, np.full(n, 0.3), is_refined
    kernels.measure(*given, found, slopes, is_reliable, shifts)
    for k in range(n):
        starts = np.append(rough[k] if is_known[k] else np.nan, rivals[k])
        expected, is_expected = measure_plainly(images, corners[k], starts, is_refined)
        assert is_reliable[k] == is_expected
        np.testing.assert_allclose([found[k], *slopes[k], shifts[k]], expected, rtol=1e-9)
    if n > 1 and row[0] < 1.0:
        assert 0.2 < is_reliable[corners[:, 1] > 50].mean() < 0.9
        assert 0.0 < is_reliable[corners[:, 1] < 20].mean() < 0.5


def test_what_is_unknown_is_not_valid() -> None:
    rng = np.random.default_rng(4)
    images, found, is_valid = pair(rng), np.empty(2), np.ones(2, np.bool_)
    given = np.full((2, 2), 40.0), np.full(2, 14.0), np.array([[np.nan, 0.0], [0.0, np.nan]])
    kernels.follow(*images, *given, np.full(2, 0.3), 3, found, is_valid)
    assert not is_valid.any()
    kernels.follow(*images, *given[:2], np.zeros((2, 2)), np.full(2, np.nan), 3, found, is_valid)
    assert not is_valid.any()
