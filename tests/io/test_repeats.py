"""An image that is given again is no new one."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gvo.errors import RecordingError
from gvo.io.frames import refuse_repeats
from gvo.types import FaultyFrame, Frame, RgbdFrame, StereoFrame

_RNG = np.random.default_rng(0)
_A, _B, _C, _D = (_RNG.integers(0, 255, (32, 48)).astype(np.uint8) for _ in range(4))
_DEPTH = np.ones((32, 48), dtype=np.float32)


def _kept(frames: list[Frame | FaultyFrame]) -> list[bool]:
    found = list(refuse_repeats(frames, ("left", "right")))
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in frames]
    return [not isinstance(frame, FaultyFrame) for frame in found]


def _pairs(*images: Any) -> list[Frame | FaultyFrame]:
    return [
        StereoFrame(stamp_ns=n, left=left.copy(), right=right.copy())
        for n, (left, right) in enumerate(images)
    ]


def test_two_repeats_in_a_row_are_refused_and_all_after_them() -> None:
    assert _kept(_pairs((_A, _B), (_A, _B), (_A, _B), (_C, _D))) == [True, False, False, True]
    assert _kept(_pairs((_A, _B), (_A, _D), (_C, _B), (_A, _B))) == [True, False, False, False]
    hanging = _pairs((_A, _B), *[(_A, _B)] * 4, (_C, _D), (_C, _D), (_A, _B))
    assert _kept(hanging) == [True, False, False, False, False, True, True, True]


def test_a_single_repeat_is_let_through_as_drivers_give_it_now_and_then() -> None:
    assert _kept(_pairs((_A, _B), (_A, _B), (_C, _D))) == [True, True, True]
    assert _kept(_pairs((_A, _B), (_A, _B))) == [True, True]
    assert _kept(_pairs((_A, _B), (_C, _D), (_A, _B), (_C, _D))) == [True] * 4


def test_what_waits_is_given_before_an_error() -> None:
    def read() -> Iterator[Frame | FaultyFrame]:
        yield from _pairs((_A, _B), (_A, _B))
        raise RecordingError("cut off")

    frames = refuse_repeats(read(), ("left", "right"))
    assert [next(frames).stamp_ns for _ in range(2)] == [0, 1]
    with pytest.raises(RecordingError, match="cut off"):
        next(frames)


def test_one_pixel_makes_another_image() -> None:
    other, last = _A.copy(), _B.copy()
    other[31, 47] ^= 1
    last[0, 0] ^= 1
    assert _kept(_pairs((_A, _B), (other, last), (_A, _B))) == [True, True, True]


def test_faulty_frames_in_between_do_not_hide_a_repeat() -> None:
    first, second, third, fourth = _pairs((_A, _B), (_A, _B), (_A, _B), (_C, _D))
    faulty = FaultyFrame(stamp_ns=9, reason="damaged")
    read = [faulty, first, faulty, second, faulty, third, faulty, fourth]
    assert _kept(read) == [False, True, False, False, False, False, False, True]


def test_depth_may_repeat_and_so_may_images_of_one_value() -> None:
    rgbd: list[Frame | FaultyFrame] = [
        RgbdFrame(stamp_ns=n, image=image, depth=_DEPTH) for n, image in enumerate((_A, _B, _B, _B))
    ]
    assert _kept(rgbd) == [True, True, False, False]
    black = np.zeros_like(_A)
    assert _kept(_pairs(*[(black, black)] * 4)) == [True] * 4


@pytest.mark.parametrize(("index", "name"), [(0, "left"), (1, "right")])
def test_the_reason_names_the_stream_and_what_to_do(index: int, name: str) -> None:
    images = [(_A, _B), *[(_A, _D) if index == 0 else (_C, _B)] * 2]
    *_, frame = refuse_repeats(_pairs(*images), ("left", "right"))
    assert isinstance(frame, FaultyFrame)
    assert frame.reason.startswith(f"the {name} image is that of the frame before")
    assert "--set sync.repeated_images=keep" in frame.reason
