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


def test_the_times_for_which_an_imu_led_are_added_up_gap_by_gap() -> None:
    statistics = RunStatistics()
    for number, letter in enumerate("m.ccc.mccmmmc"):
        if letter == ".":
            statistics.add_faulty(FaultyFrame(stamp_ns=number, reason="torn"), is_loss=True)
            continue
        is_carried = letter == "c"
        status = Status.COASTING if is_carried else Status.OK
        pose = estimate_at(number * 10**8)
        statistics.add_result(result_of(pose, status=status, is_carried=is_carried))
    assert statistics.n_carried == 6
    # from the last frame before
    np.testing.assert_allclose(statistics.gaps_s, [0.4, 0.2, 0.1])


def test_what_an_imu_led_to_is_not_made_up() -> None:
    statistics = counted(20, 0)
    for number in range(20, 40):
        pose = estimate_at(number)
        statistics.add_result(result_of(pose, status=Status.COASTING, is_carried=True))
    assert statistics.is_complete
    assert statistics.warnings() == []
    assert statistics.coverage_percent == 50.0
    for number in range(40, 45):
        statistics.add_result(result_of(estimate_at(number), status=Status.COASTING))
    assert not statistics.is_complete
    (warning,) = statistics.warnings()
    assert "5 of 45 poses continue the last velocity" in warning


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


RATE_HZ = 10


def driven(speeds_mps: list[float], *, lost: tuple[int, ...] = ()) -> RunStatistics:
    """Return the counts of a drive: the speed of each step, and steps that are no measurement."""
    statistics, T = RunStatistics(), np.eye(4)
    for frame, speed_mps in enumerate([0.0, *speeds_mps]):
        T[2, 3] += speed_mps / RATE_HZ
        status = Status.COASTING if frame in lost else Status.OK
        raw = estimate_at(frame * 10**9 // RATE_HZ, T.copy(), status=status)
        statistics.add_result(result_of(raw))
    return statistics


def test_images_that_stand_still_in_mid_motion_are_told() -> None:
    found = driven([8.0] * 20 + [0.02] * 30).as_json()["standstill"]
    assert found == {"frame": 21, "speed_mps": 8.0}
    # the first of two, and not what did not last
    found = driven([8.0] * 20 + [0.0] * 10 + [9.0] * 5 + [0.0] * 10).as_json()["standstill"]
    assert found["frame"] == 21
    found = driven([8.0] * 20 + [0.0] * 9 + [9.0] * 5 + [0.0] * 10).as_json()["standstill"]
    assert found == {"frame": 35, "speed_mps": 9.0}


@pytest.mark.parametrize(
    ("speeds_mps", "lost"),
    [
        ([8.0, 6.0, 4.0, 2.0] + [0.0] * 30, ()),  # 20 m/s^2
        ([2.5] * 20 + [0.0] * 30, ()),  # a slow one may halt within a frame
        ([8.0] * 20 + [4.0] * 30, ()),
        ([8.0] * 20 + [0.0] * 9 + [8.0] * 5, ()),
        ([0.0] * 20 + [8.0] + [0.0] * 30, ()),  # one step that is wrong
        ([8.0] * 20 + [0.0] * 30, (20,)),  # a guess tells no speed
    ],
)
def test_a_halt_and_a_wrong_step_are_no_standstill(
    speeds_mps: list[float], lost: tuple[int, ...]
) -> None:
    assert driven(speeds_mps, lost=lost).as_json()["standstill"] is None


@given(durations=st.lists(st.floats(0.0, 1e6), min_size=1, max_size=40))
def test_the_time_of_a_stage_is_its_median(durations: list[float]) -> None:
    statistics = RunStatistics()
    for elapsed_ms in durations:
        statistics.add_duration("track", elapsed_ms)
    found = statistics.as_json()["median_ms"]["track"]
    assert found == pytest.approx(np.median(durations), rel=1e-6, abs=1e-3)
