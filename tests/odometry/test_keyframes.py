"""How much the current frame has in common with the kept ones."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.odometry.keyframes import Keyframes, misclosure
from gvo.types import Edge, Estimate, FloatArray, Observations
from tests.make.results import observations_of

CAMERA = StereoCamera(fx=100.0, fy=100.0, cx=50.0, cy=40.0, width=100, height=80, baseline=0.1)


def wall(n: int = 2000, depth: float = 4.0) -> FloatArray:
    """Return points of a wall that fills the image, in random order."""
    rng = np.random.default_rng(0)
    return np.asarray(depth * CAMERA.unproject(rng.uniform([0, 0], [99, 79], (n, 2))))


def keyframes(*stamps: int, **changes: Any) -> Keyframes[Observations]:
    values = {
        "size": 3,
        "n_keyframes": 3,
        "n_links": 3,
    }
    kept: Keyframes[Observations] = Keyframes(CAMERA, WindowConfig.model_validate(values | changes))
    for stamp in stamps:
        kept.add(observations_of(stamp, wall()))
    return kept


def shifted(dx: float = 0.0, dz: float = 0.0) -> FloatArray:
    T = np.eye(4)
    T[0, 3], T[2, 3] = dx, dz
    return T


@pytest.mark.parametrize("n", [40, 2000])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 0.9])
def test_the_overlap_is_the_share_of_the_points_still_in_view(share: float, n: int) -> None:
    # The image shows 4 m of a wall 4 m away, so that a shift of 4 m leaves nothing.
    kept = keyframes()
    points = wall(n)
    kept.add(observations_of(7, points))
    shift = 4.0 * (1.0 - share)
    scores = kept.scores({7: shifted(dx=shift)}, 1)
    assert list(scores) == [7]
    expected = np.mean(points[:, 0] + shift < 4.0 * 50 / 100)
    assert scores[7] == pytest.approx(expected, abs=0.15)


def test_points_behind_the_camera_are_not_in_view() -> None:
    assert keyframes(7).scores({7: np.diag([-1.0, 1.0, -1.0, 1.0])}, 1) == {7: 0.0}
    assert keyframes(7).scores({7: shifted(dz=-5.0)}, 1) == {7: 0.0}


def test_points_at_a_quite_other_distance_are_not_counted() -> None:
    assert keyframes(7).scores({7: shifted(dz=8.0)}, 1) == {7: 0.0}  # thrice as far
    assert keyframes(7).scores({7: shifted(dz=0.4)}, 1)[7] > 0.9


def test_a_frame_without_points_overlaps_with_nothing() -> None:
    kept = keyframes()
    kept.add(observations_of(3, np.zeros((0, 3))))
    assert kept.scores({3: np.eye(4)}, 1) == {3: 0.0}


def test_a_keyframe_was_in_view_at_the_last_step_that_had_enough_in_common() -> None:
    kept = keyframes(7, 8)
    kept.scores({7: np.eye(4), 8: shifted(dx=3.9)}, 5)
    assert [kept.kept[ns].seen_at for ns in (7, 8)] == [5, 0]


@dataclass(frozen=True)
class Bare:
    """Observations of a front-end that has no points to show."""

    stamp_ns: int


def test_without_points_or_camera_the_score_is_the_proximity_of_the_poses() -> None:
    config = WindowConfig(keyframe_distance_m=2.0)
    pointless: Keyframes[Bare] = Keyframes(CAMERA, config)
    pointless.add(Bare(7))
    blind: Keyframes[Observations] = Keyframes(None, config)
    blind.add(observations_of(7, wall()))
    for kept in (pointless, blind):
        for distance_m, score in ((0.0, 1.0), (2.0, 0.9), (5.0, 0.75), (50.0, 0.0)):
            assert kept.scores({7: shifted(dz=distance_m)}, 1) == {7: pytest.approx(score)}


def chain(n: int, sigmas: FloatArray, rng: np.random.Generator) -> tuple[Estimate, Estimate]:
    """Return the 20th and the last pose of a chain of true steps and noise."""
    step = se3.exp(np.array([0.01, 0.03, 0.0, 0.1, 0.0, 0.8]))
    T, covariance, found = np.eye(4), np.zeros((6, 6)), list[Estimate]()
    for _ in range(n):
        measured = step @ se3.exp(sigmas * rng.normal(size=6))
        T = T @ measured
        covariance = se3.compose_covariance(covariance, measured, np.diag(sigmas**2))
        found.append(Estimate(stamp_ns=len(found), T_world_frame=T, covariance=covariance))
    return found[19], found[-1]


def test_a_misclosure_is_one_on_average_where_covariances_fit() -> None:
    rng = np.random.default_rng(4)
    sigmas = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 1e-2])
    step = se3.exp(np.array([0.01, 0.03, 0.0, 0.1, 0.0, 0.8]))
    found = []
    for _ in range(200):
        T_true = np.linalg.matrix_power(step, 10)
        link = Edge(
            reference_id=19,
            T_reference_frame=T_true @ se3.exp(2.0 * sigmas * rng.normal(size=6)),
            covariance=np.diag(4.0 * sigmas**2),
        )
        found.append(misclosure(link, *chain(30, sigmas, rng)))
    assert np.mean(found) == pytest.approx(1.0, abs=0.12)


def test_a_chain_whose_covariance_cannot_be_subtracted_tells_nothing() -> None:
    rng = np.random.default_rng(4)
    start, end = chain(30, np.full(6, 1e-3), rng)
    link = Edge(reference_id=19, T_reference_frame=np.eye(4), covariance=1e-12 * np.eye(6))
    assert np.isnan(misclosure(link, end, start))
    assert np.isnan(misclosure(replace(link, covariance=np.full((6, 6), np.nan)), start, end))
