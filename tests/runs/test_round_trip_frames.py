"""Frames of a round trip: only the order and the stamps change on the way back."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.runs.round_trip import RoundTripFrames
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame, Frame, StereoFrame

_CAMERA = PinholeCamera(fx=10.0, fy=10.0, cx=3.5, cy=2.5, width=8, height=6)
_FRAME_BYTES = 2 * _CAMERA.width * _CAMERA.height
_FIRST_NS = 1_700_000_000_000_000_000
_STEP_NS = 100_000_000
_CONFIGS = {
    n: Config.model_validate({"runtime": {"threads": n}, "sync": {"stereo_tolerance_ms": 5.0}})
    for n in (1, 2)
}
KINDS = ("sound", "sound", "sound", "late right", "no right", "broken", "stamp 0", "repeated")


@dataclass
class Numbered:
    """A recording whose frames hold their numbers, some of them not sound."""

    kinds: list[str]
    breaks_off: bool = False
    n_loaded: list[int] = field(default_factory=list)

    @property
    def info(self) -> RecordingInfo:
        left = Calibration.from_camera(_CAMERA)
        right = Calibration.from_camera(_CAMERA, baseline=0.1)
        return RecordingInfo(
            name="numbered", sensor="stereo", calibrations=(left, right), n_images=len(self.kinds)
        )

    def images(self) -> Iterator[StampedImage]:
        for number, kind in enumerate(self.kinds):
            stamp_ns = _FIRST_NS + _STEP_NS * number
            if kind == "repeated":
                stamp_ns -= _STEP_NS
            elif kind == "stamp 0":
                stamp_ns = 0
            load = partial(self._load, number, kind)
            yield StampedImage(stream=0, stamp_ns=stamp_ns, load=load)
            if kind != "no right":
                late_ns = 3_000_000 * (kind == "late right")
                yield StampedImage(stream=1, stamp_ns=stamp_ns + late_ns, load=load)
        if self.breaks_off:
            raise RecordingError("the file ends")

    def ground_truth(self) -> Trajectory | None:
        return None

    def _load(self, number: int, kind: str) -> NDArray[Any]:
        self.n_loaded.append(number)
        if kind == "broken":
            raise RecordingError(f"image {number} is cut off")
        return np.full((_CAMERA.height, _CAMERA.width), number, dtype=np.uint8)


def content(item: Frame | FaultyFrame) -> tuple[int, str]:
    if isinstance(item, FaultyFrame):
        return item.stamp_ns, f"{item.reason}, unpaired: {item.is_unpaired}"
    assert isinstance(item, StereoFrame)
    return item.stamp_ns, f"{item.left[0, 0]}, {item.right[0, 0]}"


def read(items: Iterator[Frame | FaultyFrame]) -> tuple[list[tuple[int, str]], list[bool], str]:
    found: list[tuple[int, str]] = []
    is_sound: list[bool] = []
    try:
        for item in items:
            found.append(content(item))
            is_sound.append(not isinstance(item, FaultyFrame))
    except RecordingError as error:
        return found, is_sound, str(error)
    return found, is_sound, ""


def expected(
    source: Numbered, config: Config, excerpt: Excerpt
) -> tuple[list[tuple[int, str]], str]:
    """Return the whole list and its reverse, all in memory."""
    there, is_sound, fault = read(frames(source, config, excerpt))
    sound = [index for index, sound in enumerate(is_sound) if sound]
    if not sound:
        return there, fault
    turn_ns = there[sound[-1]][0]
    back = [(2 * turn_ns - stamp_ns, held) for stamp_ns, held in there[: sound[-1]]]
    return there + back[::-1], fault


_excerpts = st.builds(
    Excerpt,
    start_s=st.sampled_from([0.0, 0.35]),
    duration_s=st.sampled_from([None, 0.5, 1.05]),
    every=st.integers(1, 3),
)


@given(
    kinds=st.lists(st.sampled_from(KINDS), max_size=16),
    n_held=st.integers(0, 20),
    excerpt=_excerpts,
    threads=st.sampled_from([1, 2]),
    breaks_off=st.booleans(),
)
def test_pieces_of_any_size_give_the_reversed_list(
    kinds: list[str], n_held: int, excerpt: Excerpt, threads: int, breaks_off: bool
) -> None:
    source, config = Numbered(kinds, breaks_off), _CONFIGS[threads]
    round_trip = RoundTripFrames(source, config, excerpt, max_bytes=n_held * _FRAME_BYTES)
    found, _, fault = read(iter(round_trip))
    assert (found, fault) == expected(source, config, excerpt)


def test_a_frame_is_given_with_mirrored_stamp_and_the_turning_one_once() -> None:
    round_trip = RoundTripFrames(Numbered(["sound"] * 4 + ["broken"]), _CONFIGS[1])
    found, is_sound, _ = read(iter(round_trip))
    sound = list(itertools.compress(found, is_sound))
    steps = [(stamp_ns - _FIRST_NS) // _STEP_NS for stamp_ns, _ in sound]
    assert steps == [0, 1, 2, 3, 4, 5, 6]
    assert [held[0] for _, held in sound] == ["0", "1", "2", "3", "2", "1", "0"]
    assert round_trip.turn_ns == _FIRST_NS + 3 * _STEP_NS


def test_an_image_is_decoded_once_there_and_once_back_however_many_the_pieces() -> None:
    source = Numbered(["sound"] * 12)
    round_trip = RoundTripFrames(source, _CONFIGS[1], max_bytes=3 * _FRAME_BYTES)
    assert len(read(iter(round_trip))[0]) == 23
    # both images of each; those of the last piece are held
    assert sorted(source.n_loaded) == sorted([*range(9)] * 4 + [9, 10, 11] * 2)


def test_images_of_no_more_than_the_limit_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    alive: list[int] = []
    greatest: list[int] = []

    class Counted(StereoFrame):
        __slots__ = ()

        def __init__(self, **fields: Any) -> None:
            super().__init__(**fields)
            alive.append(1)
            greatest.append(sum(alive))

        def __del__(self) -> None:
            alive.append(-1)

    monkeypatch.setattr("gvo.io.frames.StereoFrame", Counted)
    round_trip = RoundTripFrames(Numbered(["sound"] * 30), _CONFIGS[1], max_bytes=5 * _FRAME_BYTES)
    assert sum(1 for _ in round_trip) == 59
    # five of the piece, and those on their way: one read, one mirrored, one with the reader
    assert max(greatest) <= 8


def test_a_recording_without_a_sound_frame_has_no_way_back() -> None:
    round_trip = RoundTripFrames(Numbered(["broken", "no right"]), _CONFIGS[1])
    assert read(iter(round_trip))[1] == [False, False]
    assert round_trip.turn_ns is None
