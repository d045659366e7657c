"""A recording with faults is the recording with these faults, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.recording import Sensor
from gvo.testing import Black, Dropped, FaultySource
from tests.make.recordings import Held, Item, held

_N = 8
_CAMERA = PinholeCamera(fx=40.0, fy=40.0, cx=23.5, cy=15.5, width=48, height=32)


def small(sensor: Sensor = "stereo") -> Held:
    """Return images of noise, no two alike; the stamps are the numbers of the frames."""
    calibrations = (Calibration.from_camera(_CAMERA),) * (2 if sensor == "stereo" else 1)
    items: list[Item] = [
        (stream, frame, np.random.default_rng([frame, stream]).integers(1, 256, (32, 48), np.uint8))
        for frame in range(_N)
        for stream in (0, 1)
    ]
    return held(sensor, items, calibrations=calibrations)


def stamps(source: FaultySource, stream: int = 0) -> list[int]:
    return [image.stamp_ns for image in source.images() if image.stream == stream]


def black(source: FaultySource, stream: int = 0) -> list[int]:
    """Return the frames whose image is black; the others are those of the sound recording."""
    given = {(i.stream, i.stamp_ns): i.load() for i in small().images()}
    found = [image for image in source.images() if image.stream == stream]
    dark = [image.stamp_ns for image in found if not image.load().any()]
    for image in found:
        if image.stamp_ns not in dark:
            np.testing.assert_array_equal(image.load(), given[stream, image.stamp_ns])
    return dark


@given(
    first=st.integers(0, _N),
    length=st.integers(0, _N),
    every=st.integers(1, 4),
    burst=st.integers(1, 4),
)
def test_k_frames_are_dropped_or_black_and_the_others_stay_in_their_order(
    first: int, length: int, every: int, burst: int
) -> None:
    which: Any = {"first": first, "end": first + length, "every": every, "burst": burst}
    gone = [n for n in range(first, min(first + length, _N)) if (n - first) % every < burst]
    dropped = FaultySource(small(), Dropped(**which))
    assert stamps(dropped) == [n for n in range(_N) if n not in gone]
    spoilt = FaultySource(small(), Black(**which))
    assert black(spoilt) == black(spoilt, 1) == gone
    assert stamps(spoilt) == list(range(_N))


def test_depth_does_not_become_black() -> None:
    source = FaultySource(small("rgbd"), Black())
    assert (black(source), black(source, 1)) == ([*range(_N)], [])


def test_faults_number_the_frames_as_in_the_recording_that_they_are_put_into() -> None:
    both = FaultySource(small(), Dropped(end=3), Dropped(first=4, end=5))
    assert stamps(both) == [3, 5, 6, 7]
    nested = FaultySource(FaultySource(small(), Dropped(end=3)), Dropped(first=1, end=2))
    assert stamps(nested) == [3, 5, 6, 7]
    assert both.info.name == "list"
    assert both.ground_truth() is None
