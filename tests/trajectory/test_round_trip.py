"""Errors of round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.trajectory.round_trip import RoundTripError, round_trip_error
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray
from tests.trajectory.paths import straight

_TURN_NS = 1_700_000_000_000_000_000
_STEP_NS = 50_000_000

_twists = arrays(np.float64, 6, elements=st.floats(-0.5, 0.5))


def round_trip(
    poses: FloatArray, errors: FloatArray, *, covariances: FloatArray | None = None
) -> Trajectory:
    """Return n poses, then the first n - 1 in opposite order, with an error each."""
    n = len(poses)
    back = (poses[:-1] @ errors)[::-1]
    stamps_ns = _TURN_NS + _STEP_NS * np.arange(1 - n, n)
    return Trajectory(
        stamps_ns=stamps_ns, T_world_frame=np.concatenate([poses, back]), covariances=covariances
    )


def measured(trajectory: Trajectory, *, path_m: float | None = None) -> RoundTripError:
    error = round_trip_error(trajectory, _TURN_NS, path_m=path_m)
    assert isinstance(error, RoundTripError)
    return error


@given(
    poses=st.integers(2, 6).flatmap(
        lambda n: arrays(np.float64, (n, 6), elements=st.floats(-2.0, 2.0)).map(se3.exp)
    ),
    data=st.data(),
)
def test_what_is_planted_on_the_way_back_is_found(poses: FloatArray, data: st.DataObject) -> None:
    xi = np.array(data.draw(st.lists(_twists, min_size=len(poses) - 1, max_size=len(poses) - 1)))
    error = measured(round_trip(poses, se3.exp(xi)))
    planted_m = np.linalg.norm(se3.exp(xi)[:, :3, 3], axis=1)
    planted_deg = np.degrees(Rotation.from_rotvec(xi[:, :3]).magnitude())
    assert error.errors_m == pytest.approx([*planted_m, 0.0], abs=1e-9)
    assert error.errors_deg == pytest.approx([*planted_deg, 0.0], abs=1e-5)
    assert error.error_m == pytest.approx(planted_m[0], abs=1e-9)
    assert error.as_json()["mean_m"] == pytest.approx(planted_m.mean(), abs=1e-9)


def test_the_error_is_a_share_of_the_path_both_ways() -> None:
    errors = np.tile(np.eye(4), (10, 1, 1))
    errors[0, 0, 3] = 0.2
    error = measured(round_trip(straight(11).T_world_frame, errors), path_m=20.0)
    assert error.error_pct == pytest.approx(1.0)
    turned = np.tile(np.eye(4), (10, 1, 1))
    turned[0, :3, :3] = Rotation.from_euler("y", 3.0, degrees=True).as_matrix()
    error = measured(round_trip(straight(11).T_world_frame, turned))
    assert error.path_m == pytest.approx(20.0)
    assert error.error_deg_per_100m == pytest.approx(15.0)
    assert error.error_pct == pytest.approx(0.0)


def test_what_stands_still_has_no_share() -> None:
    error = measured(round_trip(np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(4), (2, 1, 1))))
    assert (error.error_m, error.error_pct, error.error_deg_per_100m) == (0, None, None)


def test_the_error_is_measured_by_the_covariance_of_the_last_pose() -> None:
    errors = np.tile(np.eye(4), (2, 1, 1))
    errors[0, :3, 3] = [0.3, 0.0, 0.8]
    covariances = np.tile(np.eye(6), (5, 1, 1))
    covariances[-1] = np.diag(np.square([1.0, 1.0, 1.0, 0.1, 1.0, 0.4]))
    trajectory = round_trip(straight(3).T_world_frame, errors, covariances=covariances)
    assert measured(trajectory).chi2 == pytest.approx(9.0 + 4.0)
    singular = round_trip(straight(3).T_world_frame, errors, covariances=np.zeros((5, 6, 6)))
    assert measured(singular).chi2 is None
    assert measured(round_trip(straight(3).T_world_frame, errors)).chi2 is None


def test_a_frame_without_a_pose_one_way_is_left_out() -> None:
    whole = round_trip(straight(4).T_world_frame, np.tile(np.eye(4), (3, 1, 1)))
    error = measured(whole.select([0, 2, 3, 4, 5, 6]))
    assert (error.forward.stamps_ns - _TURN_NS).tolist() == [-3 * _STEP_NS, -_STEP_NS, 0]


@pytest.mark.parametrize("kept", [[3], [0, 1, 2, 3], [0, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5, 6]])
def test_a_way_back_that_is_missing_or_ends_early_has_no_error(kept: list[int]) -> None:
    whole = round_trip(straight(4).T_world_frame, np.tile(np.eye(4), (3, 1, 1)))
    assert isinstance(round_trip_error(whole.select(kept), _TURN_NS), Failure)
