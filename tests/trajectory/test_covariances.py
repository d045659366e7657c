"""Covariances against the truth: by the motions between poses."""

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.trajectory.evaluation import Motions, consistency, motions_of_chain
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from tests.trajectory.paths import circle

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


def nees(truth: Trajectory, motions: Motions) -> FloatArray:
    found = consistency(truth, motions)
    assert found is not None
    return np.array(found.mean_nees())


def test_a_chain_whose_covariances_are_right_gives_one_over_all_spans() -> None:
    truth = circle(3000)
    motions = motions_of_chain(chain_along(truth))
    assert [each.name for each in motions] == [
        "raw over 1 s",
        "raw over 10 s",
        "raw over 100 to 800 m",
    ]
    for each, tolerance in zip(motions, (0.15, 0.35, 0.7), strict=True):
        np.testing.assert_allclose(nees(truth, each), 1.0, atol=tolerance)
    spans_s = [1e-9 * (each.end_ns - each.start_ns) for each in motions[:2]]
    np.testing.assert_allclose(spans_s[0], 1.0)
    np.testing.assert_allclose(spans_s[1], 10.0)
    assert motions_of_chain(chain_along(circle(90)))[2].name == "raw over 20 to 50 m"


@pytest.mark.parametrize("stated", [0.01, 1.0, 100.0])
def test_covariances_are_told_by_chance_and_factor(stated: float) -> None:
    truth = circle(500)
    found = consistency(truth, motions_of_chain(chain_along(truth, stated=stated))[0])
    assert found is not None
    told = found.as_json()
    assert told["nees"] == pytest.approx(1.0 / stated, rel=0.3)
    # 49 motions that do not overlap, of six degrees of freedom each
    assert told["nees_low"] == pytest.approx(1.0 - 1.96 * np.sqrt(2 / 294), abs=0.01)
    assert told["nees_high"] == pytest.approx(1.0 + 1.96 * np.sqrt(2 / 294), abs=0.01)
    assert (told["motion"], told["n"]) == ("raw over 1 s", 490)
    turns, shifts = (np.linalg.norm(found.errors[:, each], axis=1) for each in np.s_[:3, 3:])
    assert told["error_deg"] == pytest.approx(np.rad2deg(np.sqrt(np.mean(turns**2))))
    assert told["error_m"] == pytest.approx(np.sqrt(np.mean(shifts**2)))
    assert told["error_m"] == pytest.approx(np.sqrt(10 * 11e-4), rel=0.3)


def test_the_truth_is_interpolated_at_the_stamps_of_the_estimate() -> None:
    truth = circle(200)
    between = truth.interpolate(truth.stamps_ns[:-1] + 50_000_000)
    covariances = np.tile(COVARIANCE, (len(between), 1, 1))
    estimate = Trajectory(
        stamps_ns=between.stamps_ns, T_world_frame=between.T_world_frame, covariances=covariances
    )
    stamps_ns = between.stamps_ns
    motions = Motions(
        name="exact",
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
    (motions, over_10_s, _) = motions_of_chain(chain_along(truth))
    assert consistency(Trajectory.of_positions(truth.stamps_ns, truth.positions), motions) is None
    assert consistency(truth, motions_of_chain(truth)[0]) is None
    assert consistency(truth.select([0]), motions) is None
    assert consistency(truth, over_10_s) is None
