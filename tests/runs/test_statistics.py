"""Counts and warnings of a run."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.runs.statistics import RunStatistics
from gvo.types import FaultyFrame, SegmentJoin, Status
from tests.make.results import estimate_at, result_of


def counted(n_ok: int, n_coasting: int) -> RunStatistics:
    statistics = RunStatistics()
    for number, status in enumerate([Status.OK] * n_ok + [Status.COASTING] * n_coasting):
        add(statistics, number, status, 0)
    return statistics


@pytest.mark.parametrize(
    ("n_ok", "n_coasting", "is_complete"), [(30, 0, True), (27, 3, True), (26, 4, False)]
)
def test_a_run_of_which_a_tenth_is_made_up_is_not_complete(
    n_ok: int, n_coasting: int, is_complete: bool
) -> None:
    statistics = counted(n_ok, n_coasting)
    assert statistics.is_complete == is_complete
    assert len(statistics.warnings()) == (n_coasting > 0)


def test_a_camera_that_moves_far_in_the_frame_asked_for_is_told() -> None:
    statistics = counted(5, 0)
    statistics.mount_travel_m = 0.6  # a head that turns
    assert statistics.warnings() == []
    statistics.mount_travel_m = 38.0
    (warning,) = statistics.warnings()
    assert "38.0 m" in warning


def test_images_without_partner_count_as_frames_only_where_they_are_a_loss() -> None:
    statistics = counted(5, 0)
    statistics.add_faulty(FaultyFrame(stamp_ns=7, reason="alone", is_unpaired=True), is_loss=False)
    assert (statistics.n_frames, statistics.is_complete) == (5, True)
    statistics.add_faulty(FaultyFrame(stamp_ns=8, reason="dark"), is_loss=True)
    assert (statistics.n_frames, statistics.is_complete) == (6, False)
    assert statistics.progress(10).n_done == 7


def add(
    statistics: RunStatistics, stamp_ns: int, status: Status, segment: int, *joins: tuple[int, int]
) -> None:
    result = result_of(
        estimate_at(stamp_ns),
        status=status,
        segment=segment,
        joins=tuple(
            SegmentJoin(segment=first, to_segment=second, stamp_ns=stamp_ns, reference_ns=0)
            for first, second in joins
        ),
    )
    statistics.add_result(result)


def test_segments_are_told_with_their_frames_and_what_they_are_joined_to() -> None:
    statistics = RunStatistics()
    add(statistics, 10, Status.OK, 0)
    add(statistics, 20, Status.COASTING, 0)
    add(statistics, 30, Status.LOST, 1)
    add(statistics, 40, Status.RESUMED, 1)
    add(statistics, 50, Status.OK, 1, (1, 0))
    statistics.add_faulty(FaultyFrame(stamp_ns=60, reason="black"), is_loss=True)
    first, second = statistics.as_json()["segments"]
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
    assert statistics.coverage_percent == 50.0
    assert statistics.unjoined == [statistics.segments[0]]
    assert any("joined (1 to 0)" in warning for warning in statistics.warnings())
    assert not statistics.is_complete


def test_segments_that_nothing_ties_to_others_are_a_warning() -> None:
    statistics = RunStatistics()
    for segment in range(3):
        add(statistics, 100 * segment, Status.OK, segment)
        add(statistics, 100 * segment + 1, Status.LOST, segment)
    assert any("3 segments are not joined" in warning for warning in statistics.warnings())
    add(statistics, 400, Status.OK, 2, (2, 1))
    assert len(statistics.unjoined) == 2
    # What was joined to a segment comes along with it.
    add(statistics, 500, Status.OK, 2, (2, 0))
    assert [segment.joined_to for segment in statistics.segments.values()] == [None, 0, 1]
    assert statistics.unjoined == [statistics.segments[0]]


@given(durations=st.lists(st.floats(0.0, 1e6), min_size=1, max_size=40))
def test_the_time_of_a_stage_is_its_median(durations: list[float]) -> None:
    statistics = RunStatistics()
    for elapsed_ms in durations:
        statistics.add_duration("track", elapsed_ms)
    found = statistics.as_json()["median_ms"]["track"]
    assert found == pytest.approx(np.median(durations), rel=1e-6, abs=1e-3)
