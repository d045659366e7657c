"""A recording with faults is the recording with these faults, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.recording import RecordingInfo, Sensor, StampedImage
from gvo.testing import Black, Dropped, FaultySource

_N = 8
_CAMERA = PinholeCamera(fx=40.0, fy=40.0, cx=23.5, cy=15.5, width=48, height=32)


@dataclass(frozen=True)
class Small:
    """Images of noise, other ones for each stream and frame; the stamps are their numbers."""

    sensor: Sensor = "stereo"
    n_frames: int = _N
    loaded: list[tuple[int, int]] = field(default_factory=list)

    @property
    def info(self) -> RecordingInfo:
        calibrations = (Calibration.from_camera(_CAMERA),) * (2 if self.sensor == "stereo" else 1)
        return RecordingInfo(
            name="small", sensor=self.sensor, calibrations=calibrations, n_images=self.n_frames
        )

    def images(self) -> Iterator[StampedImage]:
        for frame in range(self.n_frames):
            for stream in (0, 1):
                yield StampedImage(stream=stream, stamp_ns=frame, load=self._loader(frame, stream))

    def ground_truth(self) -> None:
        return None

    def _loader(self, frame: int, stream: int) -> Callable[[], NDArray[Any]]:
        def load() -> NDArray[Any]:
            self.loaded.append((frame, stream))
            return np.random.default_rng([frame, stream]).integers(1, 256, (32, 48), dtype=np.uint8)

        return load


def stamps(source: FaultySource, stream: int = 0) -> list[int]:
    return [image.stamp_ns for image in source.images() if image.stream == stream]


def black(source: FaultySource, stream: int = 0) -> list[int]:
    """Return the frames whose image is black; the others are those of the sound recording."""
    given = {(i.stream, i.stamp_ns): i.load() for i in Small(n_frames=_N).images()}
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
    dropped = FaultySource(Small(), Dropped(**which))
    assert stamps(dropped) == [n for n in range(_N) if n not in gone]
    spoilt = FaultySource(Small(), Black(**which))
    assert black(spoilt) == black(spoilt, 1) == gone
    assert stamps(spoilt) == list(range(_N))


def test_depth_does_not_become_black() -> None:
    source = FaultySource(Small("rgbd"), Black())
    assert (black(source), black(source, 1)) == ([*range(_N)], [])


def test_faults_number_the_frames_as_in_the_recording_that_they_are_put_into() -> None:
    both = FaultySource(Small(), Dropped(end=3), Dropped(first=4, end=5))
    assert stamps(both) == [3, 5, 6, 7]
    nested = FaultySource(FaultySource(Small(), Dropped(end=3)), Dropped(first=1, end=2))
    assert stamps(nested) == [3, 5, 6, 7]
    assert both.info.name == "small"
    assert both.ground_truth() is None
