"""Pairing by stamp."""

from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from gvo.errors import RecordingError
from gvo.sources.recording import StampedImage
from gvo.sources.sync import MAX_PENDING, pair_images
from gvo.types import FaultyFrame

_LIMIT = 20
_any_stamps = st.lists(st.integers(0, 400), max_size=30)
_stamps = st.one_of(_any_stamps.map(sorted), _any_stamps)
_sorted_stamps = st.lists(st.integers(0, 300), unique=True, max_size=30).map(sorted)


def _image(stream: int, stamp_ns: int) -> StampedImage:
    return StampedImage(stream=stream, stamp_ns=stamp_ns, load=lambda: np.zeros((1, 1)))


def _interleave(
    first: list[int], second: list[int], order: Iterable[bool]
) -> Iterator[StampedImage]:
    waiting = [list(reversed(first)), list(reversed(second))]
    for is_second in order:
        if waiting[is_second]:
            yield _image(int(is_second), waiting[is_second].pop())
    for stream in (0, 1):
        while waiting[stream]:
            yield _image(stream, waiting[stream].pop())


def _pair(
    first: list[int], second: list[int], order: Iterable[bool] = (), limit_ns: int = _LIMIT
) -> list[tuple[int, int] | str]:
    """Return stamps of pairs, or what is wrong with an image of stream 0."""
    found: list[tuple[int, int] | str] = []
    images = _interleave(first, second, order)
    for item in pair_images(images, limit_ns=limit_ns, partner="depth"):
        if isinstance(item, FaultyFrame):
            found.append(f"{item.stamp_ns}: {item.reason}")
        else:
            found.append((item[0].stamp_ns, item[1].stamp_ns))
    return found


def _pairs(first: list[int], second: list[int]) -> list[tuple[int, int]]:
    return [answer for answer in _pair(first, second) if isinstance(answer, tuple)]


def _least_cost(first: list[int], second: list[int]) -> int:
    """Return the least sum of differences, the limit and one for each image left alone."""
    differences = np.abs(np.subtract.outer(np.array(first), np.array(second))).astype(float)
    differences[differences > _LIMIT] = 1e9
    costs = np.hstack([differences, np.full((len(first), len(first)), _LIMIT + 1.0)])
    return int(costs[linear_sum_assignment(costs)].sum())


@given(first=_stamps, second=_stamps, order=st.lists(st.booleans(), max_size=60))
def test_the_interleaving_of_the_streams_does_not_matter(
    first: list[int], second: list[int], order: list[bool]
) -> None:
    assert _pair(first, second, order) == _pair(first, second)


@given(first=_sorted_stamps, second=_sorted_stamps)
def test_pairs_keep_the_limit_and_the_order_and_use_each_image_once(
    first: list[int], second: list[int]
) -> None:
    pairs = _pairs(first, second)
    assert all(abs(image - partner) <= _LIMIT for image, partner in pairs)
    for stream in zip(*pairs, strict=True):
        assert list(stream) == sorted(set(stream))


@given(first=_sorted_stamps, second=_sorted_stamps)
def test_no_image_is_left_alone_that_is_nearer_than_the_one_that_got_the_partner(
    first: list[int], second: list[int]
) -> None:
    pairs = _pairs(first, second)
    alone = set(first) - {image for image, _ in pairs}
    free = set(second) - {partner for _, partner in pairs}
    for image in alone:
        assert all(abs(image - partner) > _LIMIT for partner in free)
        assert all(abs(image - used) >= abs(other - used) for other, used in pairs)


@given(first=_sorted_stamps, second=_sorted_stamps)
def test_no_other_assignment_is_better_on_the_whole(first: list[int], second: list[int]) -> None:
    pairs = _pairs(first, second)
    cost = sum(abs(image - partner) for image, partner in pairs)
    cost += (_LIMIT + 1) * (len(first) - len(pairs))
    assert cost == (_least_cost(first, second) if first else 0)


@given(first=_stamps, second=_stamps)
def test_every_image_of_the_first_stream_is_answered_once_and_in_order(
    first: list[int], second: list[int]
) -> None:
    answers = [
        item[0] if isinstance(item, tuple) else int(item.partition(":")[0])
        for item in _pair(first, second)
    ]
    assert answers == first


@given(stamps=st.lists(st.integers(0, 10**18), unique=True, max_size=20).map(sorted))
def test_equal_stamps_pair_without_a_tolerance(stamps: list[int]) -> None:
    assert _pair(stamps, stamps, limit_ns=0) == [(stamp, stamp) for stamp in stamps]


def test_the_nearest_depth_is_taken_and_the_earlier_of_two_equally_near_ones() -> None:
    assert _pair([100, 200], [92, 110, 190, 210]) == [(100, 92), (200, 190)]


def test_a_partner_is_left_to_the_next_image_that_has_no_other() -> None:
    # 112 is the nearest of both; 85 is good enough for the first image
    assert _pair([100, 130], [85, 112]) == [(100, 85), (130, 112)]
    assert _pair([100, 130], [85, 112, 131]) == [(100, 112), (130, 131)]


def test_images_of_twice_the_rate_of_depth_pair_where_their_stamps_are_equal() -> None:
    color = [0, 17, 33, 50, 67, 83, 100]
    assert _pairs(color, [17, 50, 83]) == [(17, 17), (50, 50), (83, 83)]


def test_a_missing_depth_image_does_not_shift_those_after_it() -> None:
    color = list(range(0, 1000, 17))
    assert _pairs(color, color[1:]) == [(stamp, stamp) for stamp in color[1:]]
    assert _pairs(color, color[:-1]) == [(stamp, stamp) for stamp in color[:-1]]


def test_images_that_compete_for_long_are_decided_before_too_many_wait() -> None:
    """Each image is nearer to the depth before it, by little, but the first one has none."""
    color = list(range(0, 900 * 2001, 2001))
    n_pushed = n_answered = 0

    def images() -> Iterator[StampedImage]:
        nonlocal n_pushed
        for stamp in color:
            n_pushed += 1
            yield _image(0, stamp)
            yield _image(1, stamp + 1001)

    for answer in pair_images(images(), limit_ns=2000, partner="depth"):
        n_answered += 1
        assert n_pushed - n_answered <= MAX_PENDING + 1
        assert isinstance(answer, tuple)
        assert answer[1].stamp_ns - answer[0].stamp_ns == 1001
    assert n_answered == len(color)


def test_the_pairs_before_a_fault_of_the_recording_come_first() -> None:
    def images() -> Iterator[StampedImage]:
        for stamp in (0, 30, 60):
            yield _image(0, stamp)
            yield _image(1, stamp + 15)
        raise RecordingError("cut off")

    pairs = pair_images(images(), limit_ns=20, partner="depth")
    assert [next(pairs)[0].stamp_ns for _ in range(3)] == [0, 30, 60]  # type: ignore[index]
    with pytest.raises(RecordingError, match="cut off"):
        next(pairs)


def test_an_image_without_a_partner_says_how_far_the_nearest_is() -> None:
    ms = 1_000_000
    (answer,) = _pair([100 * ms], [50 * ms, 133 * ms], limit_ns=20 * ms)
    assert answer == f"{100 * ms}: no depth=20: the nearest is 33 ms away"
    taken = _pair([0, 5 * ms], [1 * ms], limit_ns=20 * ms)[1]
    assert isinstance(taken, str)
    assert taken.endswith("4 ms away and belongs to another image")


@pytest.mark.parametrize(("late", "word"), [(200, "repeats"), (150, "goes back from 200 to 150")])
def test_a_stamp_that_repeats_or_goes_back_makes_the_late_image_faulty(
    late: int, word: str
) -> None:
    pairs = _pair([100, 200, late, 300], [100, 200, late, 300], limit_ns=0)
    assert pairs[:2] == [(100, 100), (200, 200)]
    assert word in str(pairs[2])
    assert pairs[3] == (300, 300)


def test_one_stream_may_run_ahead_as_far_as_the_buffer_reaches() -> None:
    stamps = list(range(MAX_PENDING))
    assert _pair(stamps, stamps, [False] * MAX_PENDING, limit_ns=0) == [(s, s) for s in stamps]


@pytest.mark.parametrize("stream", [0, 1])
def test_few_images_are_kept_where_the_other_stream_ends(stream: int) -> None:
    alive = 0

    class Counted:
        def __init__(self) -> None:
            nonlocal alive
            alive += 1

        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

        def __call__(self) -> NDArray[np.uint8]:
            return np.zeros((1, 1), np.uint8)

    def images() -> Iterator[StampedImage]:
        for stamp_ns in range(10 * MAX_PENDING):
            yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=Counted())
            assert alive <= MAX_PENDING + 3

    results = list(pair_images(images(), limit_ns=0, partner="right"))
    assert len(results) == (10 * MAX_PENDING if stream == 0 else 0)
    assert all(isinstance(result, FaultyFrame) for result in results)
