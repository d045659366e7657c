"""Counts and warnings of a run."""

import numpy as np
import pytest

from gvo.runs.statistics import RunTally
from gvo.types import Estimate, FaultyFrame, FrameResult, SegmentJoin, Status


def counted(n_ok: int, n_coasting: int) -> RunTally:
    tally = RunTally()
    for number, status in enumerate([Status.OK] * n_ok + [Status.COASTING] * n_coasting):
        add(tally, number, status, 0)
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


def add(
    tally: RunTally, stamp_ns: int, status: Status, segment: int, *joins: tuple[int, int]
) -> None:
    pose = Estimate(stamp_ns=stamp_ns, T_world_cam=np.eye(4), covariance=np.eye(6))
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
        segment=segment,
        joins=tuple(
            SegmentJoin(segment=first, to_segment=second, stamp_ns=stamp_ns, reference_ns=0)
            for first, second in joins
        ),
    )
    tally.add_result(result)


def test_segments_are_told_with_their_frames_and_what_they_are_joined_to() -> None:
    tally = RunTally()
    add(tally, 10, Status.OK, 0)
    add(tally, 20, Status.COASTING, 0)
    add(tally, 30, Status.LOST, 1)
    add(tally, 40, Status.RESUMED, 1)
    add(tally, 50, Status.OK, 1, (1, 0))
    tally.add_faulty(FaultyFrame(stamp_ns=60, reason="black"), is_loss=True)
    first, second = tally.segments_json()
    assert first == {
        "id": 0,
        "first_stamp_ns": 10,
        "last_stamp_ns": 20,
        "n_frames": 2,
        "n_tracked": 1,
        "joined_to": None,
        "joined_at_ns": None,
    }
    assert (second["n_frames"], second["n_tracked"]) == (3, 2)
    assert (second["joined_to"], second["joined_at_ns"]) == (0, 50)
    assert tally.coverage_percent == pytest.approx(100 * 4 / 6, abs=1e-3)
    assert tally.unjoined == [tally.segments[0]]
    assert any("joined (1 to 0)" in warning for warning in tally.warnings())
    assert tally.is_partly


def test_segments_that_nothing_ties_to_others_are_a_warning() -> None:
    tally = RunTally()
    for segment in range(3):
        add(tally, 100 * segment, Status.OK, segment)
        add(tally, 100 * segment + 1, Status.LOST, segment)
    assert any("3 segments are not joined" in warning for warning in tally.warnings())
    add(tally, 400, Status.OK, 2, (2, 1))
    assert len(tally.unjoined) == 2
    # What was joined to a segment comes along with it.
    add(tally, 500, Status.OK, 2, (2, 0))
    assert [segment.joined_to for segment in tally.segments.values()] == [None, 0, 1]
    assert tally.unjoined == [tally.segments[0]]


def test_a_segment_without_any_registration_is_not_one_that_could_be_joined() -> None:
    tally = RunTally()
    add(tally, 1, Status.OK, 0)
    add(tally, 2, Status.LOST, 1)
    assert len(tally.segments) == 2
    assert len(tally.unjoined) == 1


def test_nothing_is_covered_where_there_is_no_frame() -> None:
    assert RunTally().coverage_percent == 0.0
