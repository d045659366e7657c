"""Kernels of depth images, each against a few lines of NumPy."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.kernels import depth as kernels
from gvo.types import BoolArray, DepthArray, FloatArray

CAMERA = np.array([40.0, 42.0, 19.3, 14.6, 0.1, 40.0, 30.0])
NEAREST, FARTHEST = 0.5, 6.0


def scene(seed: int = 0, *, unknown: float = 0.1, noise: float = 0.002) -> DepthArray:
    """Return the depth of three walls, shape (30, 40), with noise and holes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:30, :40]
    inverse = np.maximum(0.4 + 0.008 * (u - 20), np.maximum(0.35, 0.6 - 0.012 * v))
    inverse *= 1.0 + noise * rng.standard_normal(inverse.shape)
    inverse[rng.random(inverse.shape) < unknown] = np.nan
    return np.asarray(1.0 / inverse, dtype=np.float32)


def motion(twist: tuple[float, ...]) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return T


def moved(points: FloatArray, T: FloatArray) -> FloatArray:
    """Return points of the reference as the current camera sees them."""
    return np.asarray((np.linalg.inv(T) @ np.column_stack([points, np.ones(len(points))]).T).T)[
        :, :3
    ]


def sample(
    image: DepthArray, keypoints: FloatArray, *, radius: int = 2, max_step: float = 0.1
) -> tuple[FloatArray, BoolArray]:
    depths, is_valid = np.full(len(keypoints), 7.0), np.ones(len(keypoints), np.bool_)
    limits = NEAREST, FARTHEST, max_step
    kernels.sample_depths(image, keypoints, radius, *limits, depths, is_valid)
    return depths, is_valid


def sample_plainly(
    image: DepthArray, keypoint: FloatArray, radius: int, max_step: float
) -> tuple[float, bool]:
    """Do as `sample_depths` says, for one keypoint."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    column, row = np.rint(keypoint)
    if not np.any((u == column) & (v == row)):
        return np.nan, False
    nearest = float(image[int(row), int(column)])
    is_around = (abs(u - column) <= radius) & (abs(v - row) <= radius) & ~np.isnan(image)
    around = image[is_around].astype(float)
    if not NEAREST <= nearest <= FARTHEST or np.ptp(around) > max_step * nearest:
        return nearest, False
    basis = np.column_stack([np.ones(len(around)), u[is_around], v[is_around]])
    is_fitted = len(around) > 0.5 * (2 * radius + 1) ** 2 and np.linalg.matrix_rank(basis) == 3
    if not is_fitted or np.any(around <= 0.0):
        return nearest, True
    plane = np.linalg.lstsq(basis, 1.0 / around)[0]
    return float(np.clip(1.0 / (plane @ [1.0, *keypoint]), around.min(), around.max())), True


@pytest.mark.parametrize("unknown", [0.0, 0.1, 0.45])
@pytest.mark.parametrize("radius", [0, 1, 2, 3])
@pytest.mark.parametrize("max_step", [0.12, 0.3])
def test_depths_at_keypoints_are_those_of_planes(
    unknown: float, radius: int, max_step: float
) -> None:
    image = scene(unknown=unknown)
    image[12:14, 7:9], image[20, 30], image[25, 10] = 0.0, 0.2, np.inf
    keypoints = np.random.default_rng(1).uniform([-3, -3], [43, 33], (300, 2))
    borders = [[-0.5, 3], [0, 0], [39, 29], [39.5, 29], [39.6, 3], [5, -0.6], [12.5, 29.49]]
    keypoints = np.concatenate([keypoints, borders, [[np.nan, 3], [np.inf, 3], [-1e300, 3]]])
    depths, is_valid = sample(image, keypoints, radius=radius, max_step=max_step)
    pairs = [sample_plainly(image, each, radius, max_step) for each in keypoints]
    expected, is_expected = zip(*pairs, strict=True)
    np.testing.assert_array_equal(is_valid, is_expected)
    np.testing.assert_allclose(depths, expected, rtol=1e-9)
    assert 20 < np.count_nonzero(is_valid) < 290


def test_one_keypoint_and_none_are_sampled() -> None:
    image = np.full((1, 1), 2.0, np.float32)
    assert sample(image, np.zeros((1, 2)), radius=0)[0] == [2.0]
    assert len(sample(image, np.zeros((0, 2)))[0]) == 0


def compare(points: FloatArray, image: DepthArray, T: FloatArray) -> FloatArray:
    differences = np.full(len(points), 7.0)
    limits = NEAREST, FARTHEST, 0.4
    n = kernels.compare_depths(points, image, T, CAMERA, *limits, differences)
    return differences[:n]


@pytest.mark.parametrize("twist", [(0, 0, 0, 0, 0, 0), (0.1, -0.2, 0.15, 0.1, -0.2, 0.4)])
def test_differences_are_those_of_disparities_in_sigmas(twist: tuple[float, ...]) -> None:
    image, T = scene(), motion(twist)
    points = np.random.default_rng(2).uniform([-3, -3, -1], [3, 3, 8], (400, 3))
    x, y, z = moved(points, T).T
    fx, fy, cx, cy, baseline = CAMERA[:5]
    u, v = np.rint(fx * x / z + cx), np.rint(fy * y / z + cy)
    is_seen = (z > NEAREST) & (u >= 0) & (u < 40) & (v >= 0) & (v < 30)
    measured = image[v[is_seen].astype(int), u[is_seen].astype(int)].astype(float)
    is_known = (measured >= NEAREST) & (measured <= FARTHEST)
    disparities = fx * baseline / measured[is_known] - fx * baseline / z[is_seen][is_known]
    assert np.count_nonzero(is_known) > 20
    np.testing.assert_allclose(
        compare(points, image, T), disparities / (np.sqrt(2.0) * 0.4), rtol=1e-9, atol=1e-12
    )


def test_points_that_are_nowhere_are_not_compared() -> None:
    image = np.full((30, 40), 2.0, np.float32)
    points = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 2.0], [1e300, 0.0, 2.0]])
    assert len(compare(points, image, np.eye(4))) == 0
    assert len(compare(points[:0], image, np.eye(4))) == 0
    np.testing.assert_array_equal(compare(np.array([[0.0, 0.0, 2.0]]), image, np.eye(4)), [0.0])


def reduce(image: DepthArray, step: int = 1) -> NDArray[np.float32]:
    height, width = (-(-n // step) // 2 for n in image.shape)
    inverse = np.full((height, width), 7.0, np.float32)
    kernels.reduce_depth(image, step, NEAREST, FARTHEST, inverse)
    return inverse


@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize("cut", [0, 1])
def test_a_reduced_depth_is_the_mean_of_four_inverse_ones(step: int, cut: int) -> None:
    image = scene(noise=0.01)[: 30 - cut, : 40 - cut]
    image = np.ascontiguousarray(image)
    image[3, 5], image[8, 20], image[16:, 30:] = 0.0, np.inf, 0.3
    taken = image[::step, ::step].astype(float)
    height, width = (n // 2 for n in taken.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        blocks = 1.0 / taken[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
        mean = blocks.mean(axis=(1, 3), keepdims=True)
        is_smooth = abs(blocks - mean).sum(axis=(1, 3)) < 4 * 0.03 * mean[:, 0, :, 0]
        mean = mean[:, 0, :, 0]
        is_known = is_smooth & (1.0 / mean >= NEAREST) & (1.0 / mean <= FARTHEST)
    assert 0.05 < np.mean(is_known) < 0.95
    np.testing.assert_allclose(reduce(image, step), np.where(is_known, mean, np.nan), rtol=1e-5)


def surfaces(inverse: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
    points, normals = np.full((2, inverse.size // kernels.STRIDE + 1, 3), 7.0)
    n = kernels.fit_surfaces(inverse, CAMERA, points, normals)
    return points[:n], normals[:n]


def test_normals_are_those_of_planes_through_neighbours() -> None:
    inverse = (1.0 / scene(unknown=0.02)).astype(np.float32)
    fx, fy, cx, cy = CAMERA[:4]
    v, u = np.mgrid[:30, :40]
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
    points /= inverse[..., np.newaxis].astype(float)
    smooth = []
    for row, column in np.ndindex(30, 40):
        if not (2 <= row < 28 and 2 <= column < 38):
            continue
        at, sides = (float(inverse[row, column]), inverse[row, [column - 2, column + 2]])
        ends = inverse[[row - 2, row + 2], column]
        bends = [abs(pair.astype(float).sum() - 2 * at) for pair in (sides, ends)]
        if all(bend < 0.03 * at for bend in bends):
            smooth.append((row, column))
    found, normals = surfaces(inverse)
    rows, columns = np.transpose(smooth[:: kernels.STRIDE])
    np.testing.assert_allclose(found, points[rows, columns], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-9)
    # On each axis the chord between the neighbours, moved through the point, lies in the plane.
    for dv, du in ((0, 2), (2, 0)):
        slope = (inverse[rows + dv, columns + du] - inverse[rows - dv, columns - du]).astype(float)
        ends = np.stack([(columns + du - cx) / fx, (rows + dv - cy) / fy, np.ones(len(rows))])
        chord = ends.T / (inverse[rows, columns] + 0.5 * slope)[:, np.newaxis] - found
        cosines = np.sum(normals * chord, axis=1) / np.linalg.norm(chord, axis=1)
        np.testing.assert_allclose(cosines, 0.0, atol=1e-6)
    assert 100 < len(found) < 350


@pytest.mark.parametrize("shape", [(0, 0), (4, 30), (5, 5), (30, 40)])
def test_surfaces_need_a_border_and_something_known(shape: tuple[int, int]) -> None:
    inverse = np.full(shape, 0.5, np.float32)
    assert len(surfaces(inverse)[0]) == -(-max(shape[0] - 4, 0) * max(shape[1] - 4, 0) // 3)
    assert len(surfaces(np.full(shape, np.nan, np.float32))[0]) == 0


@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize("gate", [1.0, 2.5, np.inf])
def test_normal_equations_are_those_of_distances_to_planes(every: int, gate: float) -> None:
    image, T = scene(3, unknown=0.02), motion((0.01, -0.015, 0.02, 0.01, 0.02, -0.015))
    image[:, 20:] *= np.linspace(1.0, 1.3, 20, dtype=np.float32)  # another surface, further on
    points, normals = surfaces((1.0 / scene(4, unknown=0.02)).astype(np.float32))
    inverse = (1.0 / image).astype(np.float32)
    # Points that are seen just within and just beyond the borders, and one behind the camera.
    edges = [[-0.5, 9], [0.3, 9], [38.7, 9], [39.5, 9], [9, -0.5], [9, 0.3], [9, 28.7], [9, 29.5]]
    rays = np.column_stack([(edges - CAMERA[2:4]) / CAMERA[:2], np.ones(8)])
    columns, rows = np.clip(np.rint(edges), 0, [39, 29]).astype(int).T
    there = rays / inverse[rows, columns, np.newaxis] @ T[:3, :3].T + T[:3, 3]
    behind = T[:3, 3] - T[:3, 2]
    points = np.concatenate([[behind], there, points])
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (9, 1)), normals])
    H, g, squares = np.full((6, 6), 7.0), np.full(6, 7.0), np.full(1, 7.0)
    n = kernels.linearize_planes(T, points, normals, inverse, CAMERA, gate, every, H, g, squares)
    expected_H, expected_g, rows = np.zeros((6, 6)), np.zeros(6), []
    for point, normal in zip(points[::every], normals[::every], strict=True):
        x, y, z = moved(point[np.newaxis], T)[0]
        u, v = CAMERA[0] * x / z + CAMERA[2], CAMERA[1] * y / z + CAMERA[3]
        i, j = int(np.floor(u)), int(np.floor(v))
        if not (0 <= i < 39 and 0 <= j < 29):
            continue
        weights = np.outer([j + 1 - v, v - j], [i + 1 - u, u - i])
        measured = 1.0 / np.sum(weights * inverse[j : j + 2, i : i + 2])
        sigma = 0.003 + 0.003 * z**2
        if not abs(measured - z) < 10.0 * sigma + 0.03 * z:
            continue
        turned = T[:3, :3].T @ normal
        r = turned @ np.array([x, y, z]) * (measured - z) / z / sigma
        if not abs(r) < gate:
            continue
        # By differences: how the point's distance along its normal changes as the camera moves.
        shifts = [
            turned @ (moved(point[np.newaxis], T @ motion(tuple(side)))[0] - [x, y, z])
            for side in 1e-6 * np.concatenate([np.eye(6), -np.eye(6)])
        ]
        J = np.subtract(shifts[:6], shifts[6:]) / 2e-6 / sigma
        weight = min(1.0, 1.5 / max(abs(r), 1e-9))
        expected_H += weight * np.outer(J, J)
        expected_g += weight * r * J
        rows.append(r)
    assert n == len(rows) > 50 / every
    assert squares[0] == pytest.approx(np.sum(np.square(rows)), rel=1e-9)
    np.testing.assert_allclose(H, expected_H, rtol=1e-6, atol=1e-7 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, rtol=1e-6, atol=1e-7 * np.abs(expected_g).max())


def test_a_step_of_the_normal_equations_leads_to_where_the_camera_is() -> None:
    """Points of one depth image, seen by a camera that moved less than a pixel."""
    inverse = (1.0 / scene(unknown=0.0, noise=0.0)).astype(np.float32)
    points, normals = surfaces(inverse)
    start = motion((0.002, -0.001, 0.003, 0.004, -0.002, 0.003))
    H, g = np.empty((6, 6)), np.empty(6)
    surface = points, normals, inverse, CAMERA
    kernels.linearize_planes(start, *surface, np.inf, 1, H, g, np.empty(1))
    left = start @ motion(tuple(np.linalg.solve(H, g)))
    np.testing.assert_allclose(left, np.eye(4), atol=0.2 * np.abs(start - np.eye(4)).max())


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 0.0])
def test_points_that_are_seen_nowhere_tell_nothing(value: float) -> None:
    inverse = np.full((30, 40), 0.5, np.float32)
    normals, squares = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full(1, 7.0)
    H, g = np.full((6, 6), 7.0), np.full(6, 7.0)
    points = np.array([[0.0, 0.0, value], [value, 0.0, value], [0.0, 0.0, -value]])
    for given in (points, points[:0]):
        arguments = given, normals, inverse, CAMERA, np.inf, 1
        assert kernels.linearize_planes(np.eye(4), *arguments, H, g, squares) == squares[0] == 0.0
        np.testing.assert_array_equal(H, np.zeros((6, 6)))
        np.testing.assert_array_equal(g, np.zeros(6))
    unknown = np.full((30, 40), np.nan, np.float32)
    seen = np.array([[0.0, 0.0, 2.0]] * 3)
    arguments = seen, normals, unknown, CAMERA, np.inf, 1
    assert kernels.linearize_planes(np.eye(4), *arguments, H, g, squares) == squares[0] == 0.0
