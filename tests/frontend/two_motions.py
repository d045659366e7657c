"""Matches of points that move by one twist or another."""

import numpy as np

from gvo.config import Config
from gvo.frontend.registration import register_correspondences
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import Failure, FloatArray, MotionPrior, RelativePose


def matches_of(
    *groups: tuple[FloatArray, int],
    camera: StereoCamera,
    disparities: tuple[float, float],
    noise_px: float,
    stated_px: float,
    seed: int,
    n_wrong: int = 0,
) -> Correspondences:
    """Return matches, so many of each twist T_reference_current, and wrong ones."""
    rng = np.random.default_rng(seed)
    low, high = np.transpose([(20, 620), (20, 460), disparities])
    sources, targets = [], []
    for twist, n in groups:
        uvd = np.column_stack([rng.uniform(*limits, n) for limits in zip(low, high, strict=True)])
        points = camera.unproject_stereo(uvd[:, :2], uvd[:, 2])
        moved = se3.transform_points(se3.invert(se3.exp(twist)), points)
        sources.append(uvd)
        targets.append(camera.project_stereo(moved))
    for each in (sources, targets):
        each.append(rng.uniform(low, high, (n_wrong, 3)))
    source, target = np.concatenate(sources), np.concatenate(targets)
    noise = rng.normal(0.0, noise_px, (2, *source.shape))
    sigmas = np.full(source.shape, stated_px)
    return Correspondences.of_pixels(
        (source + noise[0], target + noise[1]), (sigmas, sigmas), camera
    )


def register(
    matches: Correspondences, camera: StereoCamera, prior: MotionPrior | None
) -> RelativePose | Failure:
    indices = np.tile(np.arange(len(matches))[:, np.newaxis], 2)
    return register_correspondences(
        matches, indices, camera, Config(), stamps_ns=(1, 2), prior=prior
    )
