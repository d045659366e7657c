"""Matched observations of two frames, by hand-written loops and projections."""

import numpy as np
from hypothesis import given

from gvo.geometry.correspondences import Correspondences
from gvo.types import FloatArray
from tests.geometry.scenes import CAMERA, seeds, unproject
from tests.make.results import observations_of


def random_pixels(rng: np.random.Generator, n: int) -> FloatArray:
    return rng.uniform([0.0, 0.0, 5.0], [640.0, 480.0, 50.0], size=(n, 3))


def random_correspondences(rng: np.random.Generator, n: int) -> Correspondences:
    pixels = random_pixels(rng, n), random_pixels(rng, n)
    sigmas = rng.uniform(0.1, 1.0, (n, 3)), rng.uniform(0.1, 1.0, (n, 3))
    return Correspondences.of_pixels(pixels, sigmas, CAMERA)


@given(seed=seeds)
def test_pixels_of_both_frames_become_points_of_their_own_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = random_pixels(rng, 7), random_pixels(rng, 7)
    sigmas = rng.uniform(0.1, 1.0, (7, 3)), rng.uniform(0.1, 1.0, (7, 3))
    matches = Correspondences.of_pixels(pixels, sigmas, CAMERA)
    assert len(matches) == 7
    for index, side in enumerate(("reference", "current")):
        points = getattr(matches, f"{side}_points")
        np.testing.assert_allclose(points, unproject(pixels[index]), rtol=1e-12)
        np.testing.assert_array_equal(getattr(matches, f"{side}_uvd"), pixels[index])
        np.testing.assert_array_equal(getattr(matches, f"{side}_sigmas"), sigmas[index])


def test_matches_pair_what_each_frame_saw() -> None:
    rng = np.random.default_rng(0)
    frames = []
    for n in (6, 5):
        uvd = random_pixels(rng, n)
        frames.append(
            observations_of(
                n,
                unproject(uvd),
                keypoints=uvd[:, :2],
                disparities=uvd[:, 2],
                sigmas=rng.uniform(0.1, 1.0, (n, 3)),
            )
        )
    pairs = [(4, 0), (1, 3), (5, 4)]
    matches = Correspondences.of(frames[0], frames[1], np.array(pairs))
    chosen = matches.select(np.array([2, 0]))
    for found, expected in ((matches, pairs), (chosen, [pairs[2], pairs[0]])):
        assert len(found) == len(expected)
        for row, (i, j) in enumerate(expected):
            for frame, index, side in zip(frames, (i, j), ("reference", "current"), strict=True):
                point, uvd = getattr(found, f"{side}_points"), getattr(found, f"{side}_uvd")
                np.testing.assert_array_equal(point[row], frame.points_cam[index])
                np.testing.assert_array_equal(uvd[row, :2], frame.keypoints[index])
                assert uvd[row, 2] == frame.disparities[index]
                sigmas = getattr(found, f"{side}_sigmas")
                np.testing.assert_array_equal(sigmas[row], frame.sigmas[index])
