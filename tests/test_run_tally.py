"""Counts and warnings of a run."""

import numpy as np
import pytest

from gvo.odometry import FrameResult
from gvo.run_tally import RunTally
from gvo.types import Estimate, FaultyFrame, Status


def counted(n_ok: int, n_coasting: int) -> RunTally:
    tally = RunTally()
    for number, status in enumerate([Status.OK] * n_ok + [Status.COASTING] * n_coasting):
        pose = Estimate(stamp_ns=number, T_world_cam=np.eye(4), covariance=np.eye(6))
        result = FrameResult(
            raw=pose,
            causal=pose,
            finished=(),
            status=status,
            reason="",
            n_keypoints=9,
            n_points=8,
            n_matches=7,
            n_inliers=6,
            n_links=3,
        )
        tally.add_result(result)
    return tally


@pytest.mark.parametrize(
    ("n_ok", "n_coasting", "is_partly"), [(30, 0, False), (27, 3, False), (26, 4, True)]
)
def test_a_run_of_which_a_tenth_is_made_up_is_not_complete(
    n_ok: int, n_coasting: int, is_partly: bool
) -> None:
    tally = counted(n_ok, n_coasting)
    assert tally.is_partly == is_partly
    assert len(tally.warnings()) == (n_coasting > 0)


def test_a_camera_that_moves_far_in_the_frame_asked_for_is_told() -> None:
    tally = counted(5, 0)
    tally.mount_travel_m = 0.6  # a head that turns
    assert tally.warnings() == []
    tally.mount_travel_m = 38.0
    (warning,) = tally.warnings()
    assert "38.0 m" in warning


def test_images_without_partner_count_as_frames_only_where_they_are_a_loss() -> None:
    tally = counted(5, 0)
    tally.add_faulty(FaultyFrame(stamp_ns=7, reason="alone", is_unpaired=True), is_loss=False)
    assert (tally.n_frames, tally.is_partly) == (5, False)
    tally.add_faulty(FaultyFrame(stamp_ns=8, reason="dark"), is_loss=True)
    assert (tally.n_frames, tally.is_partly) == (6, True)
    assert tally.progress(10).n_done == 7
