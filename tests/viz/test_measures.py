"""What the report measures, against other routes."""

import numpy as np

from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.measures import compare
from tests.trajectory.paths import circle


def test_rotation_errors_are_of_the_rotation_since_the_first_pose() -> None:
    truth = circle(50)
    turned = truth.T_world_frame.copy()
    turned[25:] = turned[25:] @ se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=turned)
    errors = compare(
        truth, estimate.moved(truth.T_world_frame[7]), name="a", align="se3"
    ).errors_rad
    assert errors is not None
    np.testing.assert_allclose(errors, [0.0] * 25 + [0.1] * 25, atol=1e-6)
