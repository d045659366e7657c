"""Relative poses from matched observations of points at known places."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.config import Config
from gvo.frontend import registration
from gvo.frontend.registration import check_rows, estimate_roughly, register_correspondences
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import Failure, FloatArray, IntArray, MotionPrior, Observations, RelativePose
from tests.make.results import observations_of

seeds = st.integers(min_value=0, max_value=2**32 - 1)
CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)
SIGMAS = np.array([0.5, 0.5, 0.3])


def configure(
    refine: Literal["gauss_newton", "none"] = "gauss_newton",
    weighting: Literal["inverse_depth", "none"] = "inverse_depth",
    **ransac: object,
) -> Config:
    return Config.model_validate(
        {
            "ransac": {"n_hypotheses": 150, "min_inliers": 12, "min_disparity_px": 3.0} | ransac,
            "registration": {"refine": refine, "weighting": weighting},
        }
    )


def observe(
    stamp_ns: int, points: FloatArray, noise: float, rng: np.random.Generator
) -> Observations:
    n = len(points)
    uvd = CAMERA.project_stereo(points) + noise * SIGMAS * rng.normal(size=(n, 3))
    points, sigmas = CAMERA.unproject_stereo(uvd[:, :2], uvd[:, 2]), np.tile(SIGMAS, (n, 1))
    return observations_of(
        stamp_ns, points, keypoints=uvd[:, :2], disparities=uvd[:, 2], sigmas=sigmas
    )


def register_matches(
    reference: Observations,
    current: Observations,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
    *,
    start: FloatArray | None = None,
) -> RelativePose | Failure:
    return register_correspondences(
        Correspondences.of(reference, current, matches),
        matches,
        camera,
        config,
        stamps_ns=(reference.stamp_ns, current.stamp_ns),
        prior=None if start is None else MotionPrior(T_predicted=start),
    )


def two_frames(
    seed: int, n: int = 120, n_outliers: int = 40, noise: float = 1.0, *, size: float = 1.0
) -> tuple[FloatArray, Observations, Observations, IntArray]:
    """Return T_reference_current, observations and matches, the first of them wrong."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.03 * size * rng.normal(size=3)).as_matrix()
    T[:3, 3] = 0.2 * size * rng.normal(size=3)
    points_current = rng.uniform([-2, -1.5, 3], [2, 1.5, 12], size=(n, 3))
    points_reference = points_current @ T[:3, :3].T + T[:3, 3]
    order = rng.permutation(n)  # index in current of each match
    partners = np.arange(n)
    partners[:n_outliers] = np.roll(partners[:n_outliers], 1)
    reference = observe(10, points_reference, noise, rng)
    current = observe(20, points_current[np.argsort(order)], noise, rng)
    return T, reference, current, np.stack([partners, order], axis=1)


@settings(max_examples=25)
@given(seed=seeds)
def test_the_motion_of_the_current_frame_is_found_among_outliers(seed: int) -> None:
    T, reference, current, matches = two_frames(seed)
    result = register_matches(reference, current, matches, CAMERA, configure())
    assert isinstance(result, RelativePose)
    error = se3.log(np.linalg.inv(T) @ result.T_reference_current)
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < 0.05
    assert result.inliers[40:].mean() > 0.8
    assert result.inliers[:40].mean() < 0.2
    np.testing.assert_array_equal(result.matches, matches)
    np.testing.assert_array_equal(result.covariance, result.covariance.T)


def test_the_covariance_perturbs_the_pose_on_the_right() -> None:
    # A motion so large that it matters on which side, and in which frame.
    whitened = []
    for seed in range(150):
        T, reference, current, matches = two_frames(seed, n=80, n_outliers=0, size=6.0)
        result = register_matches(reference, current, matches, CAMERA, configure())
        assert isinstance(result, RelativePose)
        error = se3.log(np.linalg.inv(T) @ result.T_reference_current)
        whitened.append(error @ np.linalg.solve(result.covariance, error))
    # Twice as much on the other side. The gate leaves the largest residuals out: above 1.
    assert 0.7 < np.mean(whitened) / 6 < 2.0


@pytest.mark.parametrize("weighting", ["inverse_depth", "none"])
@pytest.mark.parametrize("refine", ["gauss_newton", "none"])
def test_exact_points_give_the_exact_motion_whatever_the_method(
    refine: Literal["gauss_newton", "none"], weighting: Literal["inverse_depth", "none"]
) -> None:
    T, reference, current, matches = two_frames(1, noise=0.0)
    config = configure(refine, weighting)
    result = register_matches(reference, current, matches, CAMERA, config)
    assert isinstance(result, RelativePose)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-5)


def test_refinement_and_weights_each_reduce_the_error() -> None:
    variants = {
        "plain": configure("none", "none"),
        "weighted": configure("none", "inverse_depth"),
        "refined": configure("gauss_newton", "none"),
    }
    squares = dict.fromkeys(variants, 0.0)
    for seed in range(60):
        T, reference, current, matches = two_frames(seed)
        for name, config in variants.items():
            result = register_matches(reference, current, matches, CAMERA, config)
            assert isinstance(result, RelativePose)
            squares[name] += float(np.sum((result.T_reference_current - T)[:3, 3] ** 2))
    assert squares["refined"] < 0.8 * squares["weighted"] < 0.8 * squares["plain"]


@settings(max_examples=10)
@given(seed=seeds)
def test_the_result_depends_on_the_frames_and_the_seed_alone(seed: int) -> None:
    _, reference, current, matches = two_frames(seed)
    results = [
        register_matches(reference, current, matches, CAMERA, configure(seed=ransac_seed))
        for ransac_seed in (0, 0, 1)
    ]
    poses = [r.T_reference_current.tobytes() for r in results if isinstance(r, RelativePose)]
    assert len(poses) == 3
    assert poses[0] == poses[1]


def test_another_seed_draws_other_samples() -> None:
    _, reference, current, matches = two_frames(0)
    poses = set()
    for ransac_seed in range(4):
        config = configure("none", seed=ransac_seed, n_hypotheses=3, inlier_threshold_px=20.0)
        result = register_matches(reference, current, matches, CAMERA, config)
        poses.add(result.T_reference_current.tobytes() if isinstance(result, RelativePose) else b"")
    assert len(poses) > 1


@pytest.mark.parametrize("n", [0, 5, 11])
def test_too_few_matches_are_a_failure(n: int) -> None:
    _, reference, current, matches = two_frames(0)
    result = register_matches(reference, current, matches[:n], CAMERA, configure())
    assert isinstance(result, Failure)
    assert result.n_matches == n


def test_a_pose_rests_on_as_many_matches_as_are_needed_after_refinement_too() -> None:
    # Noise of twice the stated sigmas: RANSAC's threshold takes what the gate leaves out.
    outcomes = []
    for seed in range(30):
        _, reference, current, matches = two_frames(seed, n=80, n_outliers=0, noise=2.0)
        config = configure(min_inliers=60, inlier_threshold_px=20.0)
        result = register_matches(reference, current, matches, CAMERA, config)
        assert result.n_matches == 80
        outcomes.append(bool(result))
        assert (result.n_inliers >= 60) == bool(result)
    assert any(outcomes)
    assert not all(outcomes)


def test_matches_without_a_common_motion_are_a_failure_that_counts_them() -> None:
    rng = np.random.default_rng(0)
    frames = [
        observe(i, rng.uniform([-2, -1.5, 3], [2, 1.5, 12], size=(80, 3)), 0.0, rng)
        for i in range(2)
    ]
    matches = np.stack([np.arange(80)] * 2, axis=1)
    result = register_matches(frames[0], frames[1], matches, CAMERA, configure())
    assert isinstance(result, Failure)
    assert result.n_matches == 80
    assert result.n_inliers < 12


def forbid_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def search(*_: object, **__: object) -> None:
        raise AssertionError("samples are drawn")

    monkeypatch.setattr(registration, "ransac_rigid", search)


@settings(max_examples=25)
@given(seed=seeds)
def test_a_prediction_that_most_matches_confirm_is_refined_without_samples(seed: int) -> None:
    T, reference, current, matches = two_frames(seed, n_outliers=20)
    start = T @ se3.exp(np.random.default_rng(seed).normal(size=6) * np.repeat([0.0005, 0.002], 3))
    with pytest.MonkeyPatch.context() as patch:
        forbid_search(patch)
        known = register_matches(reference, current, matches, CAMERA, configure(), start=start)
        # From the truth, without the wrong ones: samples may end at worse than that.
        best = register_matches(reference, current, matches[20:], CAMERA, configure(), start=T)
    assert isinstance(known, RelativePose)
    assert isinstance(best, RelativePose)
    difference = se3.log(np.linalg.inv(best.T_reference_current) @ known.T_reference_current)
    assert difference @ np.linalg.solve(best.covariance, difference) / 6 < 1.0
    assert known.inliers[20:].mean() > 0.8
    assert known.inliers[:20].mean() < 0.2


@pytest.mark.parametrize("error", [0.1, 1.0])
def test_a_prediction_that_few_matches_confirm_changes_nothing(error: float) -> None:
    T, reference, current, matches = two_frames(4)
    start = T @ se3.exp(np.array([0.0, error, 0.0, 0.0, 0.0, 0.0]))
    searched = register_matches(reference, current, matches, CAMERA, configure())
    result = register_matches(reference, current, matches, CAMERA, configure(), start=start)
    assert isinstance(searched, RelativePose)
    assert isinstance(result, RelativePose)
    np.testing.assert_array_equal(result.T_reference_current, searched.T_reference_current)


@pytest.mark.parametrize("is_predicted", [True, False])
def test_a_rough_estimate_is_near_and_starts_the_next_without_samples(is_predicted: bool) -> None:
    T, reference, current, matches = two_frames(7, n_outliers=20)
    start = T @ se3.exp(np.repeat([0.002, 0.02], 3))
    given = Correspondences.of(reference, current, matches), matches, CAMERA, configure()
    found = register_correspondences(*given, stamps_ns=(10, 20))
    prior = MotionPrior(T_predicted=start) if is_predicted else None
    rough = estimate_roughly(given[0], *given[2:], stamps_ns=(10, 20), prior=prior)
    assert isinstance(found, RelativePose)
    assert not isinstance(rough, Failure)
    # Not as good: its inliers are those of the prediction or of a sample.
    difference = se3.log(np.linalg.inv(found.T_reference_current) @ rough)
    assert difference @ np.linalg.solve(found.covariance, difference) / 6 < 5.0
    assert np.linalg.norm(difference) < 0.5 * np.linalg.norm(se3.log(np.linalg.inv(T) @ start))
    with pytest.MonkeyPatch.context() as patch:
        forbid_search(patch)
        again = register_correspondences(*given, stamps_ns=(10, 20), T_start=rough)
    assert isinstance(again, RelativePose)
    difference = se3.log(np.linalg.inv(found.T_reference_current) @ again.T_reference_current)
    assert difference @ np.linalg.solve(found.covariance, difference) / 6 < 0.5


def test_a_rough_estimate_of_too_few_matches_is_a_failure() -> None:
    _, reference, current, matches = two_frames(6, n_outliers=0)
    given = Correspondences.of(reference, current, matches[:11]), CAMERA, configure()
    rough = estimate_roughly(*given, stamps_ns=(10, 20), prior=None)
    assert isinstance(rough, Failure)
    assert rough.n_matches == 11


@pytest.mark.parametrize(("n_outliers", "is_known"), [(30, True), (45, False)])
def test_seven_in_ten_matches_must_confirm_a_prediction(
    monkeypatch: pytest.MonkeyPatch, n_outliers: int, is_known: bool
) -> None:
    T, reference, current, matches = two_frames(5, n_outliers=n_outliers, noise=0.0)
    forbid_search(monkeypatch)
    if is_known:
        register_matches(reference, current, matches, CAMERA, configure(), start=T)
        return
    with pytest.raises(AssertionError, match="samples"):
        register_matches(reference, current, matches, CAMERA, configure(), start=T)


def test_rows_that_are_bent_are_inliers_of_a_rough_estimate_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    T, reference, current, matches = two_frames(7, n_outliers=0, noise=0.0)
    given = Correspondences.of(reference, current, matches)
    bent = given.current_uvd + [[5.0, 0.0, 0.0]] * np.sign(given.current_uvd[:, 1:2] - CAMERA.cy)
    given = Correspondences.of_pixels(
        (given.reference_uvd, bent), (given.reference_sigmas, given.current_sigmas), CAMERA
    )
    forbid_search(monkeypatch)
    prior = MotionPrior(T_predicted=T)
    rough = estimate_roughly(given, CAMERA, configure(), stamps_ns=(10, 20), prior=prior)
    assert not isinstance(rough, Failure)
    with pytest.raises(AssertionError, match="samples"):
        register_correspondences(
            given, matches, CAMERA, configure(), stamps_ns=(10, 20), prior=prior
        )


def test_a_prediction_does_not_make_up_for_too_few_matches() -> None:
    T, reference, current, matches = two_frames(6, n_outliers=0)
    result = register_matches(reference, current, matches[:11], CAMERA, configure(), start=T)
    assert isinstance(result, Failure)
    assert result.n_matches == 11


def test_without_refinement_the_fit_to_the_consensus_is_the_result_whatever_was_predicted() -> None:
    T, reference, current, matches = two_frames(7, n_outliers=0)
    config = configure("none")
    plain = register_matches(reference, current, matches, CAMERA, config)
    predicted = register_matches(reference, current, matches, CAMERA, config, start=T)
    assert isinstance(plain, RelativePose)
    assert isinstance(predicted, RelativePose)
    np.testing.assert_array_equal(plain.T_reference_current, predicted.T_reference_current)


@pytest.mark.parametrize("refine", ["gauss_newton", "none"])
def test_effects_of_constants_are_told_if_asked_for(
    refine: Literal["gauss_newton", "none"],
) -> None:
    _, reference, current, matches = two_frames(8, n_outliers=0)
    given = Correspondences.of(reference, current, matches)
    asked = replace(given, sensitivities={"offset": np.tile([0.0, 0.0, 1.0], (2, len(given), 1))})
    without, result = (
        register_correspondences(each, matches, CAMERA, configure(refine), stamps_ns=(1, 2))
        for each in (given, asked)
    )
    assert isinstance(without, RelativePose)
    assert isinstance(result, RelativePose)
    assert without.effects == {}
    assert np.linalg.norm(result.effects["offset"]) > 0.0


def test_flow_pixels_and_points_are_those_of_the_matches() -> None:
    T, reference, current, matches = two_frames(9, noise=0.0)
    result = register_matches(reference, current, matches, CAMERA, configure(), start=T)
    assert isinstance(result, RelativePose)
    i, j = matches[result.inliers].T
    displacements = current.keypoints[j] - reference.keypoints[i]
    assert result.flow_px == pytest.approx(np.median(np.linalg.norm(displacements, axis=1)))
    np.testing.assert_array_equal(result.pixels_reference, reference.keypoints[matches[:, 0]])
    np.testing.assert_array_equal(result.pixels_current, current.keypoints[matches[:, 1]])
    np.testing.assert_array_equal(result.points_current, current.points_cam[matches[:, 1]])


def seen_at(rows: FloatArray, inliers: list[bool]) -> RelativePose:
    pixels = np.column_stack([np.full(len(rows), 320.0), rows])
    return RelativePose(
        T_reference_current=np.eye(4),
        covariance=1e-6 * np.eye(6),
        matches=np.tile([0, -1], (len(rows), 1)),
        inliers=np.array(inliers),
        pixels_reference=pixels,
        pixels_current=pixels,
    )


def test_inliers_of_a_band_of_rows_are_no_consensus_of_matches_all_over_the_image() -> None:
    rows = np.linspace(-1.0, 480.0, 97)
    failure = check_rows(seen_at(rows, [240.0 <= row < 300.0 for row in rows]), CAMERA)
    assert isinstance(failure, Failure)
    assert "12 of 97 matches agree, but in few rows" in failure.reason
    assert (failure.n_matches, failure.n_inliers) == (97, 12)
    half = seen_at(rows, [row < 240.0 for row in rows])
    assert check_rows(half, CAMERA) is half
    # All that is textured: a horizon.
    horizon = seen_at(rows[48:60], [True] * 12)
    assert check_rows(horizon, CAMERA) is horizon
