"""Pairing by stamp."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.io.recording import StampedImage
from gvo.io.sync import StampFilter, pair_images
from gvo.types import FaultyFrame

_LIMIT = 20
_QUEUE = 100
_rising_stamps = st.lists(st.integers(0, 300), unique=True, max_size=30).map(sorted)
_KNOWN = [
    ([100, 130], [85, 112], 20, [(0, 1)]),
    ([100, 130], [85, 112, 131], 20, [(0, 1), (1, 2)]),
    ([100, 200], [92, 110, 190, 210], 20, [(0, 0), (1, 2)]),
    ([100, 200], [92, 106, 190, 205], 20, [(0, 1), (1, 3)]),
    ([0, 33, 67, 100, 133, 167], [10, 77, 143], 20, [(0, 0), (2, 1), (4, 2)]),
    ([0, 33, 66, 99], [16, 50, 82, 116], 20, [(0, 0), (1, 1), (2, 2), (3, 3)]),
    ([100, 200, 150, 300], [100, 200, 150, 300], 20, [(0, 0), (1, 1), (3, 3)]),
    ([100, 100, 130], [95, 100, 100, 131], 20, [(0, 1), (2, 3)]),
    ([0, 10, 20, 31, 100], [31, 101], 40, [(3, 0), (4, 1)]),
    ([31, 101], [0, 10, 20, 30, 100], 40, [(0, 3), (1, 4)]),
    ([0, 20, 40, 60, 80], [19, 41, 59, 81], 20, [(1, 0), (2, 1), (3, 2), (4, 3)]),
    ([1, 3, 2, 4], [1, 2, 3, 4], 0, [(0, 0), (2, 1), (1, 2), (3, 3)]),
    # nearer by the penalty exactly, in floating point
    ([10**8], [89_000_000, 110_000_000], 20_000_000, [(0, 0)]),
    ([100], [88, 110], 20, [(0, 1)]),
]
_any_stamps = st.lists(st.integers(0, 400), max_size=30)
_stamps = st.one_of(_any_stamps.map(sorted), _any_stamps)
_order = st.lists(st.booleans(), max_size=60)


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
    first: list[int],
    second: list[int],
    order: Iterable[bool] = (),
    *,
    limit_ns: int = _LIMIT,
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


def _answered(answers: list[tuple[int, int] | str]) -> list[int]:
    return [
        answer[0] if isinstance(answer, tuple) else int(answer.partition(":")[0])
        for answer in answers
    ]


def _pairs(first: list[int], second: list[int]) -> list[tuple[int, int]]:
    answers = _pair(first, second)
    return [answer for answer in answers if isinstance(answer, tuple)]


@given(first=_rising_stamps, second=_rising_stamps)
def test_pairs_keep_the_limit_and_the_order_and_use_each_image_once(
    first: list[int], second: list[int]
) -> None:
    pairs = _pairs(first, second)
    assert all(abs(image - partner) <= _LIMIT for image, partner in pairs)
    for stream in zip(*pairs, strict=True):
        assert list(stream) == sorted(set(stream))


@pytest.mark.parametrize(("first", "second", "limit_ns", "places"), _KNOWN)
def test_known_pairs_are_found(
    first: list[int], second: list[int], limit_ns: int, places: list[tuple[int, int]]
) -> None:
    answers = _pair(first, second, limit_ns=limit_ns)
    pairs = [answer for answer in answers if isinstance(answer, tuple)]
    assert pairs == [(first[n], second[k]) for n, k in places]


@given(first=_stamps, second=_stamps, order=_order, limit_ns=st.sampled_from([0, _LIMIT]))
def test_every_image_of_the_first_stream_is_answered_once(
    first: list[int], second: list[int], order: list[bool], limit_ns: int
) -> None:
    answered = _answered(_pair(first, second, order, limit_ns=limit_ns))
    assert sorted(answered) == sorted(first)
    if limit_ns > 0 or first == sorted(set(first)):
        assert answered == first


@given(
    st.lists(st.integers(0, 4), min_size=40, max_size=40),
    st.integers(-16, 16),
    st.sets(st.integers(12, 39)),
    st.sets(st.integers(12, 39)),
)
def test_what_is_given_early_is_what_would_be_given_late(
    jitter: list[int], offset: int, lost_first: set[int], lost_second: set[int]
) -> None:
    first = [33 * n for n in range(40) if n not in lost_first]
    second = [33 * n + offset + jitter[n] for n in range(40) if n not in lost_second]
    images = sorted(
        [*(_image(0, stamp) for stamp in first), *(_image(1, stamp) for stamp in second)],
        key=lambda image: image.stamp_ns,
    )
    found = []
    for is_live in (False, True):
        items = pair_images(images, limit_ns=20, partner="depth", is_live=is_live)
        found.append([item for item in items if not isinstance(item, FaultyFrame)])
    assert found[0] == found[1]


def test_a_pair_is_given_with_its_last_image_where_the_period_is_known() -> None:
    stamps = [(stream, 33 * n + 10 * stream) for n in range(20) for stream in (0, 1)]
    n_pushed = 0

    def images() -> Iterator[StampedImage]:
        nonlocal n_pushed
        for stream, stamp_ns in stamps:
            n_pushed += 1
            yield _image(stream, stamp_ns)

    pairs = pair_images(images(), limit_ns=20, partner="depth", is_live=True)
    given_after = [n_pushed for _ in pairs]
    assert given_after[:5] == [3, 5, 7, 9, 11]
    assert given_after[12:] == [2 * n for n in range(13, 21)]


@pytest.mark.parametrize("limit_ns", [0, 20])
@pytest.mark.parametrize(("is_live", "n_paired"), [(True, 25), (False, 40)])
def test_images_of_a_camera_that_wait_for_a_partner_take_512_mb(
    limit_ns: int, is_live: bool, n_paired: int
) -> None:
    stamps = [33 * n for n in range(40)]
    large = [replace(_image(0, stamp), n_bytes=20_000_000) for stamp in stamps]
    images = [*large, *(_image(1, stamp) for stamp in stamps)]
    items = [*pair_images(images, limit_ns=limit_ns, partner="depth", is_live=is_live)]
    faulty = [item for item in items if isinstance(item, FaultyFrame)]
    assert [item.stamp_ns for item in faulty] == stamps[: 40 - n_paired]  # the oldest
    assert all("512 MB, wait already" in item.reason for item in faulty)
    assert len(items) == 40


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


@pytest.mark.parametrize("limit_ms", [0, 20])
def test_an_image_without_a_partner_says_how_far_the_nearest_is(limit_ms: int) -> None:
    ms = 1_000_000
    stamps = [100 * ms, 200 * ms]
    answer, _ = _pair(stamps, [50 * ms, 133 * ms, 200 * ms], limit_ns=limit_ms * ms)
    assert answer == f"{100 * ms}: no depth={limit_ms}: the nearest is 33 ms away"
    assert "there is none" in str(_pair([100], [], limit_ns=limit_ms)[0])
    taken, _ = _pair([100, 108], [10, 106])
    assert str(taken).endswith("e-06 ms away and belongs to another image")


@pytest.mark.parametrize("limit_ns", [0, _LIMIT])
@pytest.mark.parametrize(("late", "word"), [(200, "repeats"), (150, "goes back from 200 to 150")])
def test_a_pair_whose_stamp_does_not_advance_is_faulty(late: int, word: str, limit_ns: int) -> None:
    stamps = [100, 200, late, 300]
    pairs = _pair(stamps, stamps, [False, True] * 4, limit_ns=limit_ns)
    assert pairs[:2] == [(100, 100), (200, 200)]
    assert word in str(pairs[2])
    assert pairs[3] == (300, 300)


def test_a_wrong_stamp_without_partner_does_not_spoil_those_after_it() -> None:
    stamps = [100, 200, 300, 400]
    answers = _pair([100, 10**9, 200, 300, 400], stamps, [False, True] * 5, limit_ns=0)
    assert [answer for answer in answers if isinstance(answer, tuple)] == [(s, s) for s in stamps]


@pytest.mark.parametrize("limit_ns", [0, _LIMIT])
@pytest.mark.parametrize("stream", [0, 1])
def test_few_images_are_kept_where_the_other_stream_ends(stream: int, limit_ns: int) -> None:
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
        for stamp_ns in range(10 * _QUEUE):
            yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=Counted())
            assert alive <= _QUEUE + 3

    results = list(pair_images(images(), limit_ns=limit_ns, partner="right"))
    assert len(results) == (10 * _QUEUE if stream == 0 else 0)
    assert all(isinstance(result, FaultyFrame) for result in results)


_S = 1_000_000_000


def _sorted_out(stamps_s: list[float]) -> tuple[list[float], list[float]]:
    """Return the stamps that are let through and those that are taken out, seconds."""
    stray = StampFilter(_image(0, round(stamp_s * _S)) for stamp_s in stamps_s)
    through = [image.stamp_ns / _S for image in stray.images()]
    return through, [frame.stamp_ns / _S for frame in stray.take_faulty()]


@pytest.mark.parametrize("strays", [[3600.2], [3600.2, 3600.3], [1.3], [9e8]])
def test_one_or_two_stamps_ahead_are_taken_out(strays: list[float]) -> None:
    through, out = _sorted_out([0.0, 0.1, *strays, 0.4, 0.5, 0.6])
    assert through == [0.0, 0.1, 0.4, 0.5, 0.6]
    assert out == strays


@pytest.mark.parametrize(
    "stamps_s",
    [
        [0.0, 0.1, 10.0, 10.1, 10.2, 10.3],  # a gap
        [0.0, 0.1, 10.0],  # a gap before the last image
        [0.0, 0.1, 10.0, 10.1],
        [0.0, 0.1, 10.0, 10.1, 10.2, 0.6, 0.7],  # a clock set ahead and back again
        [0.0, 5.0, 10.0, 15.0, 20.0],  # a slow camera
        [0.0, 0.1, 10.0, 0.05, 10.1, 10.2],  # the next one is late, not early
        [0.0, 0.0, 0.1, 0.05, 0.2],
    ],
)
def test_whatever_else_stamps_do_is_let_through_in_its_order(stamps_s: list[float]) -> None:
    assert _sorted_out(stamps_s) == (stamps_s, [])


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(-5, 30)), max_size=30))
def test_each_image_comes_through_or_is_taken_out(steps: list[tuple[int, int]]) -> None:
    images = [_image(stream, number * _S // 3) for stream, number in steps]
    stray = StampFilter(images)
    through = list(stray.images())
    assert len({id(image) for image in through}) == len(through)
    for stream in (0, 1):
        order = [images.index(image) for image in through if image.stream == stream]
        assert order == sorted(order)
    n_left = sum(image.stream == 0 for image in through)
    assert n_left + len(stray.take_faulty()) == sum(stream == 0 for stream, _ in steps)
