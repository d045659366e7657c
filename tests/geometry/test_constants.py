"""Errors of a camera's constants, planted in simulated matches and found again."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.refinement import Constants, Refinement, eliminate_pose, refine_pose
from gvo.geometry.residuals import StereoResiduals
from gvo.geometry.se3 import invert, log
from gvo.types import FloatArray
from tests.geometry.scenes import (
    all_of,
    derivative,
    matched,
    project,
    random_motion,
    seen_from,
    unproject,
)

CAMERA = StereoCamera(fx=700.0, fy=690.0, cx=600.0, cy=180.0, width=1226, height=370, baseline=0.5)
SETTINGS = {"huber": 2.8, "gate": 5.0}
SIGMA = 0.2


def drive(seed: int, offset_px: float, *, noise: float = 1.0) -> tuple[FloatArray, Correspondences]:
    """Return T_reference_current and matches, the disparities of both frames too large."""
    rng = np.random.default_rng(seed)
    T = random_motion(rng, 0.01)
    T[:3, 3] = [-0.02, -0.01, 1.0]
    disparities = 350 * rng.uniform(1 / 50, 1 / 5, 400)
    pixels = rng.uniform([100, 40], [1100, 330], size=(400, 2))
    reference = unproject(np.column_stack([pixels, disparities]), CAMERA)
    first, second = [
        project(points, CAMERA) + noise * SIGMA * rng.normal(size=(400, 3)) + [0.0, 0.0, offset_px]
        for points in (reference, seen_from(T, reference))
    ]
    return T, measured(first, second, {"offset": np.tile([0.0, 0.0, 1.0], (2, 400, 1))})


def measured(
    reference_uvd: FloatArray, current_uvd: FloatArray, sensitivities: Mapping[str, FloatArray]
) -> Correspondences:
    points = [unproject(uvd, CAMERA) for uvd in (reference_uvd, current_uvd)]
    matches = matched(
        *points,
        reference_uvd=reference_uvd,
        current_uvd=current_uvd,
        reference_sigmas=SIGMA,
        current_sigmas=SIGMA,
    )
    return replace(matches, sensitivities=sensitivities)


def residuals_of(T: FloatArray, matches: Correspondences) -> StereoResiduals:
    return StereoResiduals.of(T, matches, CAMERA, huber=1e9)


def refine(T: FloatArray, matches: Correspondences) -> Refinement:
    result = refine_pose(T, matches, all_of(matches), CAMERA, **SETTINGS)
    assert isinstance(result, Refinement), result
    return result


def told(T: FloatArray, matches: Correspondences) -> Constants:
    """Return what matches tell at their refined pose."""
    refined = refine(T, matches)
    T = refined.T_reference_current
    found = eliminate_pose(T, residuals_of(T, matches), refined.inliers)
    assert found is not None
    return found


def estimate(T: FloatArray, matches: Correspondences) -> tuple[FloatArray, FloatArray]:
    """Return the errors of the constants, and their sigmas."""
    found = told(T, matches)
    covariance = np.linalg.inv(found.information)
    return covariance @ found.score, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("planted_px", [-0.3, 0.0, 0.1, 0.3])
def test_a_planted_offset_is_found_within_its_sigma(planted_px: float) -> None:
    errors = []
    for seed in range(40):
        (value,), (sigma,) = estimate(*drive(seed, planted_px))
        assert abs(value - planted_px) < 4.0 * sigma
        errors.append((value - planted_px) / sigma)
    assert abs(np.mean(errors)) < 3.0 / np.sqrt(40)
    assert 0.7 < np.std(errors) < 1.4


def test_the_mean_of_many_registrations_tells_a_small_offset_from_none() -> None:
    for planted_px in (0.0, 0.08):
        values, sigmas = (
            np.array([estimate(*drive(seed, planted_px)) for seed in range(100, 160)])
            .reshape(-1, 2)
            .T
        )
        mean = np.average(values, weights=sigmas**-2)
        sigma = 1.0 / np.sqrt(np.sum(sigmas**-2))
        assert sigma < 0.02
        assert abs(mean - planted_px) < 3.0 * sigma


def test_the_estimate_is_that_of_least_squares_over_pose_and_offset() -> None:
    T, matches = drive(3, 0.2, noise=0.01)

    def residuals(x: FloatArray) -> FloatArray:
        reference = unproject(matches.reference_uvd - [0.0, 0.0, x[6]], CAMERA)
        moved = (reference - x[3:6]) @ Rotation.from_rotvec(x[:3]).as_matrix()
        return np.asarray((matches.current_uvd - [0.0, 0.0, x[6]] - project(moved, CAMERA)).ravel())

    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3], [0.0]])
    optimum = least_squares(residuals, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    # Other weights and one step only: equal but for the noise, which is nearly none.
    assert estimate(T, matches)[0] == pytest.approx(optimum.x[6:], abs=0.005)


def row_by_row(
    offset_px: float, readout: float, seed: int, noise: float
) -> tuple[FloatArray, Correspondences]:
    """Return a drive whose rows are shifted too, by another velocity in either frame."""
    T, matches = drive(seed, offset_px, noise=noise)
    shifts = np.stack(
        [
            (uvd[:, 1:2] / CAMERA.height - 0.5) * velocity_px
            for uvd, velocity_px in (
                (matches.reference_uvd, [12.0, 5.0, 0.0]),
                (matches.current_uvd, [-3.0, 9.0, 0.0]),
            )
        ]
    )
    uvds = matches.reference_uvd + readout * shifts[0], matches.current_uvd + readout * shifts[1]
    return T, measured(*uvds, {**matches.sensitivities, "readout": shifts})


def test_constants_are_those_of_least_squares_over_pose_and_all_of_them() -> None:
    T, matches = row_by_row(0.2, 0.1, 5, 0.01)
    shifts = matches.sensitivities["readout"]

    def residuals(x: FloatArray) -> FloatArray:
        uvds = [
            uvd - [0.0, 0.0, x[6]] - x[7] * shift
            for uvd, shift in zip((matches.reference_uvd, matches.current_uvd), shifts, strict=True)
        ]
        moved = (unproject(uvds[0], CAMERA) - x[3:6]) @ Rotation.from_rotvec(x[:3]).as_matrix()
        return np.asarray((uvds[1] - project(moved, CAMERA)).ravel())

    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3], [0.0, 0.0]])
    optimum = least_squares(residuals, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = estimate(T, matches)[0]
    assert np.all(np.abs(found - optimum.x[6:]) < [0.01, 0.005])
    # Alone, each takes the other's part.
    for k, name, truth in ((0, "offset", 0.2), (1, "readout", 0.1)):
        alone = replace(matches, sensitivities={name: matches.sensitivities[name]})
        assert abs(estimate(T, alone)[0][0] - truth) > 2.0 * abs(found[k] - truth)


def test_constants_are_found_together_within_their_sigmas() -> None:
    scores = []
    for seed in range(40):
        values, sigmas = estimate(*row_by_row(0.1, 0.01, seed, 1.0))
        scores.append((values - [0.1, 0.01]) / sigmas)
    assert np.all(np.abs(np.mean(scores, axis=0)) < 3.0 / np.sqrt(40))
    assert np.all(np.abs(np.log(np.std(scores, axis=0))) < np.log(1.4))


def test_a_constant_that_shows_nowhere_leaves_the_other_as_it_is() -> None:
    T, matches = drive(6, 0.2)
    nowhere = {**matches.sensitivities, "readout": np.zeros((2, 400, 3))}
    alone, both = told(T, matches), told(T, replace(matches, sensitivities=nowhere))
    assert both.score[0] == pytest.approx(alone.score[0])
    assert both.information[0, 0] == pytest.approx(alone.information[0, 0])
    assert not both.information[1].any()


def test_the_effect_of_an_error_is_by_how_much_it_moves_the_pose() -> None:
    T, matches = drive(7, 0.0, noise=0.1)
    poses = []
    for offset_px in (0.0, 0.02):
        offset = np.array([0.0, 0.0, offset_px])
        uvd = matches.reference_uvd + offset, matches.current_uvd + offset
        poses.append(refine(T, measured(*uvd, matches.sensitivities)))
    moved = log(invert(poses[0].T_reference_current) @ poses[1].T_reference_current)
    np.testing.assert_allclose(moved, 0.02 * poses[0].effects["offset"], rtol=0.1, atol=2e-6)


def test_the_pose_is_the_same_with_and_without_the_estimate() -> None:
    T, matches = drive(1, 0.2)
    with_it, without = refine(T, matches), refine(T, replace(matches, sensitivities={}))
    assert without.effects == {}
    np.testing.assert_array_equal(with_it.T_reference_current, without.T_reference_current)
    np.testing.assert_array_equal(with_it.covariance, without.covariance)


def test_a_camera_at_rest_says_nothing_of_the_offset() -> None:
    # Both frames are wrong alike: the residuals are those of a rig without offset.
    _, matches = drive(2, 0.3, noise=0.0)
    same = replace(
        matches, current_points=matches.reference_points, current_uvd=matches.reference_uvd
    )
    alone = 400 / SIGMA**2
    assert told(np.eye(4), same).information[0, 0] < 1e-12 * alone


def information_share(T: FloatArray, matches: Correspondences) -> float:
    """Return what is known of the offset beside the pose, over what current disparities tell.

    By QR of the derivatives, the offset's behind those of the pose.
    """
    rows = []
    for reference, sigmas in zip(matches.reference_points, matches.current_sigmas, strict=True):
        J = derivative(seen_from(T, reference), CAMERA)
        # A larger disparity draws a point along its ray.
        by_offset = [0, 0, 1] + J[:, 3:] @ T[:3, :3].T @ reference * reference[2] / 350
        J = np.column_stack([J, by_offset])
        rows.append(J / sigmas[:, np.newaxis])
    R = np.linalg.qr(np.concatenate(rows))[1]
    return float(R[6, 6] ** 2 / np.sum(1.0 / matches.current_sigmas[:, 2] ** 2))


def test_what_is_known_of_the_offset_is_what_no_motion_explains() -> None:
    T, matches = drive(4, 0.0)
    matches = replace(matches, reference_sigmas=np.full((400, 3), 1e-12))
    found = eliminate_pose(T, residuals_of(T, matches), all_of(matches))
    assert found is not None
    expected = information_share(T, matches) * 400 / SIGMA**2
    assert found.information[0, 0] == pytest.approx(expected, rel=1e-3)
