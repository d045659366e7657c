"""Covariances against the truth: by the motions between poses."""

from dataclasses import replace

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.trajectory.consistency import (
    Consistency,
    Motions,
    Reference,
    consistency,
    fit_reference,
    judged,
    motions_of_chain,
    truth_jump,
)
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from tests.trajectory.paths import circle, straight, unturned

# Of a step of 0.1 s, at its end.
COVARIANCE = np.diag([1e-6, 4e-6, 1e-6, 1e-4, 1e-4, 9e-4])


def chain_along(truth: Trajectory, *, stated: float = 1.0) -> Trajectory:
    """Return a chain of noisy steps, with the covariances that its noise makes, times a factor."""
    noise = np.random.default_rng(1).multivariate_normal(np.zeros(6), COVARIANCE, size=len(truth))
    T, C = [np.eye(4)], [np.zeros((6, 6))]
    for k, step in enumerate(se3.invert(truth.T_world_frame[:-1]) @ truth.T_world_frame[1:]):
        moved = step @ se3.invert(se3.exp(noise[k]))
        Ad = se3.adjoint(se3.invert(moved))
        T.append(T[-1] @ moved)
        C.append(Ad @ C[-1] @ Ad.T + stated * COVARIANCE)
    return Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=np.array(T), covariances=np.array(C))


def found_in(truth: Trajectory, motions: Motions) -> Consistency:
    found = consistency(truth, motions)
    assert found is not None
    return found


def test_a_chain_whose_covariances_are_right_gives_one_over_all_spans() -> None:
    truth = circle(3000)
    chain = chain_along(truth)
    for span_s, tolerance in ((1, 0.15), (5, 0.3)):
        motions = motions_of_chain(chain, span_s)
        np.testing.assert_allclose(1e-9 * (motions.end_ns - motions.start_ns), span_s)
        np.testing.assert_allclose(found_in(truth, motions).mean_nees(), 1.0, atol=tolerance)


@pytest.mark.parametrize("stated", [0.01, 1.0, 100.0])
def test_covariances_are_told_by_chance_and_factor(stated: float) -> None:
    truth = circle(500)
    found = found_in(truth, motions_of_chain(chain_along(truth, stated=stated)))
    told = found.as_json()
    for name in ("rotation", "translation", "along"):
        assert told[name] == pytest.approx(1.0 / stated, rel=0.3)
    # 49 motions that do not overlap, of six degrees of freedom each
    assert told["low"] == pytest.approx(1.0 - 1.96 * np.sqrt(2 / 294), abs=0.01)
    assert told["high"] == pytest.approx(1.0 + 1.96 * np.sqrt(2 / 294), abs=0.01)
    assert told["n"] == 490
    turns, shifts = (np.linalg.norm(found.errors[:, each], axis=1) for each in np.s_[:3, 3:])
    assert told["error_deg"] == pytest.approx(np.rad2deg(np.sqrt(np.mean(turns**2))))
    assert told["error_m"] == pytest.approx(np.sqrt(np.mean(shifts**2)))
    assert told["error_m"] == pytest.approx(np.sqrt(10 * 11e-4), rel=0.3)


def test_errors_across_the_way_are_not_along_it() -> None:
    truth = circle(100)
    step = se3.invert(truth.T_world_frame[0]) @ truth.T_world_frame[10]
    backward = se3.invert(step)[:3, 3]  # of the motion, in the frame at its end
    aside = np.cross(backward, [0.0, 1.0, 0.0])
    for error, is_along in ((backward, True), (aside, False)):
        moved = step @ se3.exp(np.concatenate([np.zeros(3), 0.01 * error]))
        motions = Motions(
            start_ns=truth.stamps_ns[:1],
            end_ns=truth.stamps_ns[10:11],
            T_start_end=moved[np.newaxis],
            covariances=1e-4 * np.eye(6)[np.newaxis],
        )
        rotation, translation, along = found_in(truth, motions).mean_nees()
        length = float(error @ error)
        assert rotation == pytest.approx(0.0, abs=1e-9)
        assert translation == pytest.approx(length / 3.0, rel=0.05)
        assert along == pytest.approx(length if is_along else 0.0, rel=0.05, abs=1e-3 * length)


def test_of_a_camera_at_rest_its_z_axis_is_along() -> None:
    truth = Trajectory(
        stamps_ns=np.arange(11) * 10**8, T_world_frame=np.tile(np.eye(4), (11, 1, 1))
    )
    motions = motions_of_chain(replace(truth, covariances=np.tile(COVARIANCE, (11, 1, 1))))
    motions = replace(motions, covariances=COVARIANCE[np.newaxis])
    told = found_in(truth, motions).as_json()
    assert told["along"] == 0.0


def test_the_truth_is_interpolated_at_the_stamps_of_the_estimate() -> None:
    truth = circle(200)
    between = truth.interpolate(truth.stamps_ns[:-1] + 50_000_000)
    covariances = np.tile(COVARIANCE, (len(between), 1, 1))
    estimate = Trajectory(
        stamps_ns=between.stamps_ns, T_world_frame=between.T_world_frame, covariances=covariances
    )
    stamps_ns = between.stamps_ns
    motions = Motions(
        start_ns=stamps_ns[:-10],
        end_ns=stamps_ns[10:],
        T_start_end=se3.invert(estimate.T_world_frame[:-10]) @ estimate.T_world_frame[10:],
        covariances=covariances[10:],
    )
    found = consistency(truth, motions)
    assert found is not None
    assert np.abs(found.errors).max() < 1e-9


def test_without_rotations_or_covariances_there_is_nothing_to_compare() -> None:
    truth = circle(30)
    chain = chain_along(truth)
    motions, over_5_s = (motions_of_chain(chain, span_s) for span_s in (1, 5))
    assert consistency(Trajectory.of_positions(truth.stamps_ns, truth.positions), motions) is None
    assert consistency(truth, motions_of_chain(truth)) is None
    assert consistency(truth.select([0]), motions) is None
    assert consistency(truth, over_5_s) is None


def shaken(*, noise_m: float = 0.0, seed: int = 0) -> Trajectory:
    """Return 300 poses of a camera in a shaking hand; their own noise is independent."""
    phases = np.outer(np.arange(300), [0.31, 0.23, 0.17])
    noise = np.random.default_rng(seed).normal(scale=noise_m, size=phases.shape)
    poses = unturned(0.2 * np.sin(phases) + noise)
    return Trajectory(stamps_ns=np.arange(300) * 33_000_000, T_world_frame=poses)


@pytest.mark.parametrize("estimated_m", [0.0, 1e-3, 3e-3])
def test_the_jump_of_the_truth_is_its_own_noise_and_not_that_of_the_estimate(
    estimated_m: float,
) -> None:
    estimate = shaken(noise_m=estimated_m, seed=1)
    # a step is the difference of two positions of three axes each
    assert truth_jump(shaken(noise_m=1e-2), estimate) == pytest.approx(6**0.5 * 1e-2, rel=0.3)
    jump_m = truth_jump(shaken(), estimate)
    assert jump_m is not None
    assert jump_m < 1e-3


def test_the_jump_of_the_truth_needs_three_poses_with_rotations() -> None:
    truth = straight(5)
    assert truth_jump(truth, truth.select(slice(2))) is None
    assert truth_jump(truth, truth.select(slice(3))) == pytest.approx(0.0, abs=1e-9)
    assert truth_jump(Trajectory.of_positions(truth.stamps_ns, truth.positions), truth) is None


# Of the reference on the frame of the estimate: radians, metres, seconds late.
PLANTED = np.array([*np.deg2rad([0.5, -0.4, 0.3]), 0.010, -0.015, 0.008, 0.006])


def hand(seconds: FloatArray) -> FloatArray:
    """Return the poses of a hand that turns about and moves along all axes."""
    phases = np.array([0.0, 1.0, 2.0])
    turns = 0.4 * np.sin(np.outer(seconds, [1.3, 1.7, 0.9]) + phases)
    T = se3.exp(np.concatenate([turns, np.zeros_like(turns)], axis=1))
    T[:, :3, 3] = 0.5 * np.sin(np.outer(seconds, [0.8, 1.1, 1.5]) - phases)
    return T


def referred(
    seed: int, *, seconds: int = 30, planted: FloatArray = PLANTED
) -> tuple[Trajectory, Trajectory]:
    """Return true poses at 100 Hz of a frame off the camera's, and the camera's raw chain."""
    rng, stamps = np.random.default_rng(seed), np.arange(20 * seconds) / 20.0
    covariance, T = 1e-6 * np.eye(6), hand(stamps)
    steps = se3.invert(T[:-1]) @ T[1:] @ se3.exp(rng.normal(scale=1e-3, size=(len(T) - 1, 6)))
    chain, covariances = [np.eye(4)], [np.zeros((6, 6))]
    for step in steps:
        chain.append(chain[-1] @ step)
        covariances.append(se3.compose_covariance(covariances[-1], step, covariance))
    raw = Trajectory(
        stamps_ns=np.round(1e9 * stamps).astype(np.int64),
        T_world_frame=np.array(chain),
        covariances=np.array(covariances),
    )
    true_stamps = np.arange(-10, 100 * seconds + 10) / 100.0
    T_reference_cam = se3.exp(np.concatenate([planted[:3], np.zeros(3)]))
    T_reference_cam[:3, 3] = planted[3:6]
    truth = Trajectory(
        stamps_ns=np.round(1e9 * (true_stamps + planted[6])).astype(np.int64),
        T_world_frame=hand(true_stamps) @ se3.invert(T_reference_cam),
    )
    return truth, raw


def fitted(truth: Trajectory, motions: Motions) -> Reference:
    reference = fit_reference(truth, motions)
    assert reference is not None
    return reference


@pytest.mark.parametrize("planted", [PLANTED, np.zeros(7)])
def test_the_place_and_the_delay_of_the_reference_are_found_within_sigmas(
    planted: FloatArray,
) -> None:
    offs = []
    for seed in range(6):
        truth, raw = referred(seed, planted=planted)
        found = fitted(truth, motions_of_chain(raw))
        offs.append((found.values - planted) / found.sigmas)
        assert np.all(found.sigmas < [*[np.deg2rad(0.15)] * 3, *[0.005] * 3, 0.002])
    assert np.abs(offs).max() < 4.0
    assert 0.7 < np.sqrt(np.mean(np.square(offs))) < 1.4


def test_motions_that_overlap_count_once() -> None:
    truth, raw = referred(0)
    motions = motions_of_chain(raw)
    whole = fitted(truth, motions)
    names = ("start_ns", "end_ns", "T_start_end", "covariances")
    apart = Motions(**{name: getattr(motions, name)[::20] for name in names})
    np.testing.assert_allclose(fitted(truth, apart).sigmas, whole.sigmas, rtol=0.4)


def test_motions_are_not_trusted_more_than_they_say() -> None:
    truth, raw = referred(0)
    motions = motions_of_chain(raw)
    doubtful = replace(motions, covariances=100.0 * motions.covariances)
    ratios = fitted(truth, doubtful).sigmas / fitted(truth, motions).sigmas
    assert np.all((ratios > 1.5) & (ratios < 11.0))
    # what tells hardly anything leaves the reference where it is by itself
    dim = fitted(truth, replace(motions, covariances=1e5 * motions.covariances))
    assert np.all(np.abs(dim.values) < 0.2 * np.abs(PLANTED))


def test_noise_of_the_reference_makes_it_less_certain() -> None:
    truth, raw = referred(0)
    noise = np.random.default_rng(0).normal(scale=5e-3, size=(len(truth), 6))
    noisy = replace(truth, T_world_frame=truth.T_world_frame @ se3.exp(noise))
    motions = motions_of_chain(raw)
    found = fitted(noisy, motions)
    assert np.all(found.sigmas > 1.3 * fitted(truth, motions).sigmas)
    assert np.all(np.abs(found.values - PLANTED) < 4.0 * found.sigmas)


def test_where_the_truth_jumps_the_fit_stays() -> None:
    truth, raw = referred(0)
    motions, poses = motions_of_chain(raw), truth.T_world_frame.copy()
    poses[1500:, :3, 3] += 0.3
    right, wrong = fitted(truth, motions), fitted(replace(truth, T_world_frame=poses), motions)
    assert np.all(np.abs(wrong.values - right.values) < 2.0 * right.sigmas)


def test_covariances_are_judged_bare_and_fitted() -> None:
    truth, raw = referred(0)
    told = judged(truth, raw, {1: motions_of_chain(raw), 5: motions_of_chain(raw, 5)})
    assert told["nees"]["window"] == told["nees"]["raw"]
    for span, high in (("1s", 1.3), ("5s", 1.8)):
        bare, corrected = (told["nees"]["raw"][span][way] for way in ("bare", "fitted"))
        assert bare["translation"] > 1.3 * corrected["translation"]
        for key in ("rotation", "translation", "along"):
            assert 0.3 < corrected[key] < high
    reference = told["reference"]
    assert reference["delay_ms"] == pytest.approx(6.0, abs=2.0)
    assert reference["lever_m"] == pytest.approx(PLANTED[3:6].tolist(), abs=0.006)
    assert reference["rotation_deg"] == pytest.approx([0.5, -0.4, 0.3], abs=0.2)
    assert [*reference["sigmas"]] == ["rotation_deg", "lever_m", "delay_ms"]


def test_the_reference_is_fitted_to_the_window_which_errs_less() -> None:
    truth, raw = referred(0)
    exact = motions_of_chain(replace(raw, T_world_frame=hand(raw.stamps_ns / 1e9)))
    reference = judged(truth, raw, {1: exact})["reference"]
    assert reference["lever_m"] == pytest.approx(PLANTED[3:6].tolist(), abs=3e-4)


def test_of_an_exact_truth_both_ways_agree() -> None:
    truth, raw = referred(3, planted=np.zeros(7))
    ways = judged(truth, raw, {1: motions_of_chain(raw)})["nees"]["window"]["1s"]
    for key in ("rotation", "translation"):
        assert ways["fitted"][key] == pytest.approx(ways["bare"][key], rel=0.2)


def test_fewer_than_twenty_motions_are_too_few_to_fit_a_reference() -> None:
    truth, raw = referred(0, seconds=20)
    told = judged(truth, raw, {1: motions_of_chain(raw)})
    assert told["reference"] == "too short to fit"
    assert [*told["nees"]["raw"]["1s"]] == ["bare"]
    truth, raw = referred(0, seconds=22)
    assert fit_reference(truth, motions_of_chain(raw)) is not None


def test_a_reference_without_rotations_judges_nothing() -> None:
    truth, raw = referred(0)
    points = Trajectory.of_positions(truth.stamps_ns, truth.positions)
    told = judged(points, raw, {})
    assert told == {"truth_jump_m": None, "reference": None, "nees": {}}
