"""Intervals are cut from the samples of an IMU as if these were a line between them."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.backend.imu_buffer import ImuBuffer
from gvo.geometry.imu import ImuSamples
from gvo.types import FloatArray
from tests.backend.imus import START_NS, ns
from tests.backend.walks import seeds

SLOPES = np.array([0.3, -2.0, 1.0, 5.0, 0.1, -0.7])
OFFSETS = np.array([1.0, 0.5, -0.2, 0.0, 0.3, 9.81])
gaps_ns = st.lists(st.integers(1, 99_000_000), min_size=3, max_size=40)
shares = st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(sorted)


def line(times_s: Any) -> FloatArray:
    return np.asarray(OFFSETS + np.multiply.outer(np.asarray(times_s), SLOPES))


def samples_of(stamps_ns: Any, values: Any = None) -> ImuSamples:
    """Return samples whose values are linear in their stamps, if none are given."""
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    values = line(1e-9 * (stamps_ns - START_NS)) if values is None else np.asarray(values)
    return ImuSamples.of(stamps_ns, values[:, :3], values[:, 3:])


def filled(stamps_ns: Any) -> ImuBuffer:
    buffer = ImuBuffer()
    buffer.add(samples_of(stamps_ns))
    return buffer


def cut(buffer: ImuBuffer, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
    """Return the lengths of the pieces of an interval, seconds, and their values (n, 6)."""
    pieces = buffer.between(start_ns, end_ns)
    assert pieces is not None
    return pieces


@given(gaps_ns, shares)
def test_a_linear_signal_is_cut_exactly_at_both_ends(gaps: list[int], at: list[float]) -> None:
    stamps_ns = START_NS + np.cumsum(gaps)
    length_ns = int(stamps_ns[-1] - stamps_ns[0])
    start_ns, end_ns = (int(stamps_ns[0]) + int(share * length_ns) for share in at)
    lengths_s, values = cut(filled(stamps_ns), start_ns, end_ns)
    assert abs(lengths_s.sum() - 1e-9 * (end_ns - start_ns)) < 1e-12
    assert (lengths_s >= 0.0).all()
    middles_s = 1e-9 * (start_ns - START_NS) + np.cumsum(lengths_s) - 0.5 * lengths_s
    np.testing.assert_allclose(values, line(middles_s), atol=1e-9)


@pytest.mark.parametrize("every_ms", [1, 5, 100])
def test_an_interval_between_samples_has_one_piece_per_sample(every_ms: int) -> None:
    every_s = 1e-3 * every_ms
    stamps_ns = [ns(k * every_s) for k in range(6)]
    lengths_s, _ = cut(filled(stamps_ns), stamps_ns[1], stamps_ns[4])
    assert len(lengths_s[lengths_s > 0.0]) == 3


@pytest.mark.parametrize("hole_ms", [90, 100, 101, 200])
def test_a_hole_of_more_than_a_tenth_of_a_second_is_an_unknown_time(hole_ms: int) -> None:
    before_ns = [ns(0.01 * k) for k in range(11)]
    after_ns = [before_ns[-1] + 1_000_000 * hole_ms + 10_000_000 * k for k in range(11)]
    buffer = filled(before_ns + after_ns)
    is_hole = hole_ms > 100
    middle_ns = (before_ns[-1] + after_ns[0]) // 2
    for start_ns, end_ns in [
        (before_ns[3], after_ns[7]),  # inside
        (before_ns[3], middle_ns),  # at its end
        (middle_ns, after_ns[7]),  # at its start
        (middle_ns - 1_000_000, middle_ns + 1_000_000),  # all around it
    ]:
        assert (buffer.between(start_ns, end_ns) is None) == is_hole
    assert buffer.between(before_ns[3], before_ns[-1]) is not None
    assert buffer.between(after_ns[0], after_ns[-1]) is not None


@pytest.mark.parametrize(("late_ms", "is_known"), [(99, True), (101, False)])
def test_beyond_the_first_and_the_last_sample_values_are_held_for_a_tenth_of_a_second(
    late_ms: int, is_known: bool
) -> None:
    stamps_ns = [ns(0.01 * k) for k in range(11)]
    buffer, late_ns = filled(stamps_ns), 1_000_000 * late_ms
    for start_ns, end_ns, held_s in [
        (stamps_ns[-1], stamps_ns[-1] + late_ns, 0.1),
        (stamps_ns[0] - late_ns, stamps_ns[0], 0.0),
    ]:
        assert (buffer.between(start_ns, end_ns) is not None) == is_known
        if is_known:
            lengths_s, values = cut(buffer, start_ns, end_ns)
            np.testing.assert_allclose(lengths_s.sum(), 1e-3 * late_ms)
            np.testing.assert_allclose(values[lengths_s > 0.0], [line(held_s)], atol=1e-9)


def test_without_samples_every_time_is_unknown() -> None:
    assert ImuBuffer().between(START_NS, START_NS + 1) is None


@given(seeds)
def test_samples_that_repeat_or_go_back_or_are_absurd_are_passed_over(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.integers(-2, 4, 40))
    spoilt = rng.choice([1.0, np.nan, np.inf, -1e5], 40, p=[0.7, 0.1, 0.1, 0.1])
    latest, expected = int(stamps.min()) - 1, []
    for stamp, value in zip(stamps.tolist(), spoilt, strict=True):
        if stamp > latest and value == 1.0:
            latest = stamp
            expected.append(stamp)
    values = np.ones((40, 6))
    values[np.arange(40), rng.integers(0, 6, 40)] = spoilt
    buffer = ImuBuffer()
    for part in np.split(np.arange(40), np.sort(rng.integers(0, 41, 5))):
        buffer.add(samples_of(START_NS + stamps[part], values[part]))
    assert (buffer.stamps_ns - START_NS).tolist() == expected
    assert buffer.gyro.shape == (len(buffer), 3)


@pytest.mark.parametrize("damaged_ns", [0, START_NS + 10**15, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("n_at_once", [1, 3, 20])
@pytest.mark.parametrize("place", [2, 5, 9, 18])
def test_a_damaged_stamp_costs_one_sample(damaged_ns: int, n_at_once: int, place: int) -> None:
    stamps_ns = np.array([ns(0.01 * k) for k in range(20)])
    spoilt = stamps_ns.copy()
    spoilt[place] = damaged_ns
    buffer = ImuBuffer()
    for start in range(0, 20, n_at_once):
        part = spoilt[start : start + n_at_once]
        buffer.add(samples_of(part, np.ones((len(part), 6))))
    np.testing.assert_array_equal(buffer.stamps_ns, np.delete(stamps_ns, place))


def test_all_samples_may_be_added_at_once() -> None:
    stamps_ns = [ns(0.1 * k) for k in range(3000)]
    assert filled(stamps_ns).stamps_ns.tolist() == stamps_ns


@given(st.integers(-100_000_000, 100_000_000), shares)
def test_a_delay_shifts_stamps_to_the_clock_of_the_camera(delay_ns: int, at: list[float]) -> None:
    stamps_ns = [ns(0.01 * k) for k in range(21)]
    start_ns, end_ns = (stamps_ns[0] + int(2e8 * share) for share in at)
    expected = cut(filled(stamps_ns), start_ns, end_ns)
    buffer = filled(stamps_ns)
    buffer.delay_ns = delay_ns
    found = cut(buffer, start_ns + delay_ns, end_ns + delay_ns)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])


@given(gaps_ns, shares, st.integers(-20_000_000, 20_000_000))
def test_what_is_dropped_is_not_needed_from_the_stamp_on(
    gaps: list[int], at: list[float], delay_ns: int
) -> None:
    stamps_ns = START_NS + np.cumsum(gaps)
    length_ns = int(stamps_ns[-1] - stamps_ns[0])
    start_ns, end_ns = (int(stamps_ns[0]) + delay_ns + int(share * length_ns) for share in at)
    buffer = filled(stamps_ns)
    buffer.delay_ns = delay_ns
    expected = cut(buffer, start_ns, end_ns)
    buffer.drop(start_ns)
    found = cut(buffer, start_ns, end_ns)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])


def test_samples_of_ten_minutes_do_not_pile_up() -> None:
    buffer = ImuBuffer()
    for second in range(600):
        stamps_ns = [ns(second + 0.05 * k) for k in range(20)]
        buffer.add(samples_of(stamps_ns))
        buffer.drop(ns(second + 0.5))
        assert len(buffer) < 60
