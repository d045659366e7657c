"""Single stamps far ahead of the others are taken out, gaps are not."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import RecordingError
from gvo.io.recording import StampedImage
from gvo.io.sync import StampFilter

_S = 1_000_000_000


def _image(stamp_ns: int, stream: int = 0) -> StampedImage:
    return StampedImage(stream=stream, stamp_ns=stamp_ns, load=lambda: np.zeros((2, 2), np.uint8))


def _sorted_out(stamps_s: list[float]) -> tuple[list[float], list[float]]:
    """Return the stamps that are let through and those that are taken out, seconds."""
    stray = StampFilter(_image(round(stamp_s * _S)) for stamp_s in stamps_s)
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
    images = [_image(number * _S // 3, stream) for stream, number in steps]
    stray = StampFilter(images)
    through = list(stray.images())
    assert len({id(image) for image in through}) == len(through)
    for stream in (0, 1):
        order = [images.index(image) for image in through if image.stream == stream]
        assert order == sorted(order)
    n_left = sum(image.stream == 0 for image in through)
    assert n_left + len(stray.take_faulty()) == sum(stream == 0 for stream, _ in steps)


def test_nothing_waits_while_stamps_go_on_evenly() -> None:
    def images() -> Iterator[StampedImage]:
        for number in range(3):
            yield _image(number * _S // 10)
        raise AssertionError("one more was asked for")

    sound = StampFilter(images()).images()
    assert [next(sound).stamp_ns for _ in range(3)] == [0, _S // 10, _S // 5]


def test_what_waits_is_given_before_an_error() -> None:
    def images() -> Iterator[StampedImage]:
        yield from (_image(0), _image(5 * _S), _image(5 * _S, 1))
        raise RecordingError("cut off")

    sound = StampFilter(images()).images()
    assert sorted(next(sound).stamp_ns for _ in range(3)) == [0, 5 * _S, 5 * _S]
    with pytest.raises(RecordingError, match="cut off"):
        next(sound)


def test_the_reason_tells_how_far_ahead_the_stamp_is() -> None:
    stray = StampFilter([_image(0), _image(7 * _S, 1), _image(9 * _S), _image(1), _image(2, 1)])
    assert [image.stamp_ns for image in stray.images()] == [0, 7 * _S, 1, 2]
    (frame,) = stray.take_faulty()
    assert frame.stamp_ns == 9 * _S
    assert (
        frame.reason
        == "the stamp is 9 s ahead of the one before, and the next one goes back to 1 ns"
    )
    assert stray.take_faulty() == []
