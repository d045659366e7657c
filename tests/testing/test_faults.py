"""Each injector does what it says, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import gvo
from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.recording import RecordingInfo, Sensor, StampedImage
from gvo.testing import faults as made
from gvo.testing.faults import Fault, FaultySource, PixelFault
from tests.testing.catalogue import FAULTS, MADE, parameters

_N = 8
_START_NS, _PERIOD_NS = 5_000_000_000, 100_000_000
_CAMERA = PinholeCamera(fx=40.0, fy=40.0, cx=23.5, cy=15.5, width=48, height=32)


@dataclass(frozen=True)
class Small:
    """Images of noise, other ones for each seed, stream and frame."""

    sensor: Sensor = "stereo"
    seed: int = 0
    n_frames: int = _N
    loaded: list[tuple[int, int]] = field(default_factory=list)

    @property
    def info(self) -> RecordingInfo:
        left = Calibration.from_camera(_CAMERA)
        right = Calibration.from_camera(_CAMERA, baseline=0.2)
        calibrations = (left, right) if self.sensor == "stereo" else (left,)
        return RecordingInfo(
            name="small", sensor=self.sensor, calibrations=calibrations, n_images=self.n_frames
        )

    def pixels(self, frame: int, stream: int) -> NDArray[Any]:
        rng = np.random.default_rng([self.seed, frame, stream])
        if self.sensor == "rgbd" and stream == 1:
            return rng.uniform(0.5, 6.0, (32, 48)).astype(np.float32)
        return rng.integers(40, 120, (32, 48)).astype(np.uint8)

    def images(self) -> Iterator[StampedImage]:
        for frame in range(self.n_frames):
            for stream in (0, 1):
                stamp_ns = _START_NS + frame * _PERIOD_NS
                yield StampedImage(
                    stream=stream, stamp_ns=stamp_ns, load=self._loader(frame, stream)
                )

    def ground_truth(self) -> None:
        return None

    def _loader(self, frame: int, stream: int) -> Callable[[], NDArray[Any]]:
        def load() -> NDArray[Any]:
            self.loaded.append((frame, stream))
            return self.pixels(frame, stream)

        return load


def stamps(source: FaultySource, stream: int = 0) -> list[int]:
    """Return the stamps of a stream in periods since the start of the sound recording."""
    found = [image.stamp_ns for image in source.images() if image.stream == stream]
    return [(stamp_ns - _START_NS) // _PERIOD_NS for stamp_ns in found]


def load(source: FaultySource, frame: int, stream: int = 0) -> NDArray[Any]:
    (found,) = [
        i.given for i in source.faulty_images() if (i.frame, i.given.stream) == (frame, stream)
    ]
    return found.load()


_PIXEL_FAULTS = [
    fault
    for faults in MADE.values()
    for fault in (faults if isinstance(faults, list) else [])
    if isinstance(fault, PixelFault)
]


def _is_of_depth(fault: Fault) -> bool:
    return type(fault).__name__.startswith("Depth")


@given(
    first=st.integers(0, _N),
    length=st.integers(0, _N),
    every=st.integers(1, 4),
    burst=st.integers(1, 4),
)
def test_dropping_k_frames_leaves_the_others_in_their_order(
    first: int, length: int, every: int, burst: int
) -> None:
    fault = made.Dropped(first=first, end=first + length, every=every, burst=burst)
    gone = [n for n in range(first, min(first + length, _N)) if (n - first) % every < burst]
    assert stamps(FaultySource(Small(), fault)) == [n for n in range(_N) if n not in gone]


def test_a_share_of_the_frames_is_dropped_from_both_streams_alike() -> None:
    source = FaultySource(Small(n_frames=2000), made.Dropped(share=0.3, seed=4))
    left, right = stamps(source, 0), stamps(source, 1)
    assert left == right
    assert 1400 - 100 < len(left) < 1400 + 100  # 5 sigma
    other = FaultySource(Small(n_frames=2000), made.Dropped(share=0.3, seed=5))
    assert stamps(other) != left


def test_one_stream_alone_can_be_affected() -> None:
    source = FaultySource(Small(), made.Dropped(streams=(1,)), made.Black(streams=(1,)))
    assert (len(stamps(source, 0)), len(stamps(source, 1))) == (_N, 0)
    assert load(source, 3).any()


@pytest.mark.parametrize("name", [parameters(name, fault=FAULTS[name]) for name in FAULTS])
def test_the_same_seed_gives_the_same_bytes_in_any_order(name: str) -> None:
    sensor = FAULTS[name].sensors[-1]
    sources = [FAULTS[name].wrap(Small(sensor, n_frames=16)) for _ in range(2)]
    forth, back = ([*_until_error(source)] for source in sources)
    bytes_forth = [_bytes(image) for image in forth]
    bytes_back = [_bytes(image) for image in reversed(back)]
    assert bytes_forth == bytes_back[::-1]
    assert [image.stamp_ns for image in forth] == [image.stamp_ns for image in back]


@pytest.mark.parametrize(
    "fault", [each for each in _PIXEL_FAULTS if not _is_of_depth(each)], ids=repr
)
def test_pixels_of_affected_images_change_and_of_no_others(fault: Fault) -> None:
    sound = Small()
    source = FaultySource(sound, replace(fault, first=2, end=4, every=1, streams=(0,)))
    for frame in range(_N):
        for stream in (0, 1):
            now, before = load(source, frame, stream), sound.pixels(frame, stream)
            is_affected = frame in (2, 3) and stream == 0
            assert (now.dtype != before.dtype or not np.array_equal(now, before)) == is_affected
    assert stamps(source) == list(range(_N))


@pytest.mark.parametrize(
    "fault",
    [*filter(_is_of_depth, _PIXEL_FAULTS), made.Shifted(columns=3), made.Resized()],
    ids=repr,
)
def test_faults_of_depth_leave_colour_alone_and_those_of_light_depth(fault: Fault) -> None:
    sound = Small("rgbd")
    source = FaultySource(
        sound, replace(fault, first=0, end=None, every=1, streams=(1,)), made.Black()
    )
    now, before = load(source, 3, 1), sound.pixels(3, 1)
    assert now.dtype != before.dtype or not np.array_equal(now, before, equal_nan=True)
    assert not load(source, 3, 0).any()


def test_images_are_spoilt_as_they_are_loaded_and_not_before() -> None:
    sound = Small()
    images = list(FaultySource(sound, made.Noisy(), made.Frozen(first=3), made.Lagging()).images())
    assert sound.loaded == []
    images[0].load()
    assert len(sound.loaded) == 1


def test_faults_add_up_in_their_order() -> None:
    sound = Small()
    inner = FaultySource(sound, made.White(part=0.5))
    darker = made.Exposed(factor=0.5)
    for source in (FaultySource(inner, darker), FaultySource(sound, *inner.faults, darker)):
        pixels = load(source, 1)
        assert (pixels[:, :24] == 128).all()
        assert pixels[:, 24:].max() <= 60
    dropped = FaultySource(sound, made.Dropped(end=3), made.Dropped(first=4, end=5))
    assert stamps(dropped) == [3, 5, 6, 7]  # numbered as in the sound recording
    assert (load(FaultySource(sound, darker, *inner.faults), 1)[:, :24] == 255).all()


def test_delivery() -> None:
    for fault, expected in (
        (made.Repeated(first=1, end=2), [0, 1, 1, 2, 3, 4, 5, 6, 7]),
        (made.Late(first=1, end=2, by=3), [0, 2, 3, 4, 1, 5, 6, 7]),
        (made.Late(first=6, by=3), [*range(_N)]),
    ):
        assert stamps(FaultySource(Small(), fault)) == expected
    late_right = FaultySource(Small(), made.Late(by=2, streams=(1,)))
    assert [image.stream for image in late_right.images()].index(1) > 1
    shuffled = stamps(FaultySource(Small(), made.Shuffled(within=8)))
    assert shuffled != list(range(_N))
    assert sorted(shuffled) == list(range(_N))


@pytest.mark.parametrize(
    ("fault", "left", "right"),
    [
        (made.Frozen(first=3, end=6, streams=(0,)), [0, 1, 2, 2, 2, 2, 6, 7], range(_N)),
        (made.Lagging(by=2, streams=(1,)), range(_N), [0, 0, 0, 1, 2, 3, 4, 5]),
    ],
)
def test_an_earlier_frame_is_shown_with_the_stamp_of_its_own(
    fault: Fault, left: Sequence[int], right: Sequence[int]
) -> None:
    sound = Small()
    source = FaultySource(sound, fault)
    assert stamps(source) == stamps(source, 1) == list(range(_N))
    for frame, shown in enumerate(zip(left, right, strict=True)):
        for stream, origin in enumerate(shown):
            pixels = sound.pixels(origin, stream)
            np.testing.assert_array_equal(load(source, frame, stream), pixels)


def test_left_and_right_are_exchanged_and_their_stamps_stay() -> None:
    sound = Small()
    source = FaultySource(sound, made.Exchanged(first=2, end=3))
    for frame, stream, origin in ((2, 0, 1), (2, 1, 0), (3, 0, 0)):
        np.testing.assert_array_equal(load(source, frame, stream), sound.pixels(frame, origin))
    assert stamps(source) == stamps(source, 1) == list(range(_N))


def test_another_place_is_shown_where_the_other_recording_has_the_frame() -> None:
    sound, other = Small(), Small(seed=1, n_frames=6)
    source = FaultySource(sound, made.Dropped(end=2), made.Elsewhere(other=other, first=4))
    for frame in range(2, _N):
        shown = other if 4 <= frame < 6 else sound
        np.testing.assert_array_equal(load(source, frame), shown.pixels(frame, 0))


def test_a_recording_breaks_off_with_the_error_asked_for() -> None:
    images = FaultySource(Small(), made.BrokenOff(first=2, error=OSError, message="gone")).images()
    assert [next(images).stamp_ns for _ in range(4)][-1] == _START_NS + _PERIOD_NS
    with pytest.raises(OSError, match="gone"):
        next(images)
    source = FaultySource(Small(), made.Unloadable(first=2, end=3, error=cv2.error, message="bad"))
    with pytest.raises(cv2.error, match="bad"):
        load(source, 2)
    assert load(source, 3).any()


@given(frame=st.integers(0, 20))
def test_stamps_are_those_of_the_faulty_clock(frame: int) -> None:
    elapsed_ns, sound = frame * _PERIOD_NS, Small(n_frames=frame + 1)
    right_ns = _START_NS + elapsed_ns
    expected: list[tuple[Fault, int]] = [
        (made.StampShift(by_s=-7.5), right_ns - 7_500_000_000),
        (made.StampConstant(), 0),
        (made.StampConstant(stamp_ns=None), _START_NS),
        (made.StampFromZero(), elapsed_ns),
        (made.StampBackwards(), _START_NS - elapsed_ns),
        (made.StampRate(rate=1.25), _START_NS + 5 * elapsed_ns // 4),
        (made.StampUnit(), 5 + frame // 10),
    ]
    for fault, stamp_ns in expected:
        *_, last = FaultySource(sound, fault).images()
        assert last.stamp_ns == stamp_ns


def test_jitter_is_shared_by_a_pair_or_not() -> None:
    def errors_s(fault: Fault, stream: int) -> NDArray[Any]:
        images = FaultySource(Small(n_frames=400), fault).faulty_images()
        found = [image for image in images if image.given.stream == stream]
        return np.array([(image.given.stamp_ns - image.stamp_ns) / 1e9 for image in found])

    shared, own = made.StampJitter(sigma_s=0.01), made.StampJitter(sigma_s=0.01, is_shared=False)
    assert np.std(errors_s(shared, 0)) == pytest.approx(0.01, rel=0.2)
    assert np.abs(errors_s(shared, 0)).max() <= 0.03
    np.testing.assert_array_equal(errors_s(shared, 0), errors_s(shared, 1))
    assert not np.array_equal(errors_s(own, 0), errors_s(own, 1))


def test_light_and_lens() -> None:
    sound = Small()
    before = sound.pixels(3, 0).astype(float)
    assert not load(FaultySource(sound, made.Black()), 3).any()
    assert (load(FaultySource(sound, made.White(part=0.5)), 3)[:, :24] == 255).all()
    assert load(FaultySource(sound, made.Blurred(sigma_px=3.0)), 3).std() < 0.3 * before.std()
    noise = load(FaultySource(sound, made.Noisy(sigma=10.0)), 3) - before
    assert noise.std() == pytest.approx(10.0, rel=0.1)
    peppered = load(FaultySource(sound, made.SaltAndPepper(density=0.2)), 3)
    assert np.mean(np.isin(peppered, (0, 255))) == pytest.approx(0.2, abs=0.05)
    assert load(FaultySource(sound, made.Exposed(factor=2.0)), 3).mean() == pytest.approx(
        2.0 * before.mean(), rel=0.01
    )
    along_rows = load(FaultySource(sound, made.MotionBlurred(length_px=9)), 3)
    assert along_rows[:, 8:-8].std(axis=1).mean() < 0.5 * before.std(axis=1).mean()


def test_what_covers_the_lens_stays_where_it_is() -> None:
    source, sound = FaultySource(Small(), made.Covered(part=0.3)), Small()
    covered = [load(source, frame) != sound.pixels(frame, 0) for frame in (1, 5)]
    assert 0.1 < np.mean(covered[0]) < 0.35
    assert np.mean(covered[0] != covered[1]) < 0.02  # where the dirt is as grey as the scene
    both = covered[0] & covered[1]
    np.testing.assert_array_equal(load(source, 1)[both], load(source, 5)[both])


def test_torn_and_turned_images() -> None:
    sound = Small()
    before = sound.pixels(3, 0)
    torn = load(FaultySource(sound, made.HalfWritten(part=0.25)), 3)
    np.testing.assert_array_equal(torn[:8], before[:8])
    assert (torn[8:] == 128).all()
    former = load(FaultySource(sound, made.HalfWritten(fill="former")), 3)
    np.testing.assert_array_equal(former[16:], before[:16])
    rolled = load(FaultySource(sound, made.RowsShifted()), 3)
    np.testing.assert_array_equal(np.sort(rolled, axis=1), np.sort(before, axis=1))
    turned = load(FaultySource(sound, made.Turned(how="half turn")), 3)
    np.testing.assert_array_equal(turned, np.rot90(before, 2))
    assert load(FaultySource(sound, made.Turned(how="transposed")), 3).shape == (48, 32)
    assert load(FaultySource(sound, made.Resized(factor=0.5)), 3).shape == (16, 24)
    shifted = load(FaultySource(sound, made.Shifted(rows=3, columns=-2)), 3)
    np.testing.assert_array_equal(shifted[3:, :-2], before[:-3, 2:])


@pytest.mark.parametrize("pixel_type", ["float64", "float32", "uint16", "int32", "bool"])
def test_pixels_of_another_type_have_the_same_values(pixel_type: Any) -> None:
    sound = Small()
    now = load(FaultySource(sound, made.OfType(pixel_type=pixel_type)), 3)
    assert now.dtype == np.dtype(pixel_type)
    np.testing.assert_array_equal(now, sound.pixels(3, 0).astype(pixel_type))


def test_depth() -> None:
    sound = Small("rgbd")
    before = sound.pixels(3, 1)

    def depth(fault: Fault) -> NDArray[Any]:
        found = load(FaultySource(sound, fault), 3, 1)
        assert found.dtype == np.float32
        return found

    np.testing.assert_allclose(depth(made.DepthScaled(factor=1000.0)), 1000.0 * before)
    assert np.isnan(depth(made.DepthConstant())).all()
    assert np.abs(depth(made.DepthQuantized(step_m=0.25)) - before).max() <= 0.1251
    assert set(np.unique(np.mod(depth(made.DepthQuantized(step_m=0.25)), 0.25))) == {0.0}
    holes = np.isnan(depth(made.DepthHoles(part=0.5, size_px=2)))
    assert np.mean(holes) == pytest.approx(0.5, abs=0.12)
    assert depth(made.DepthSaturated(depth_m=2.0)).max() == 2.0
    noise = (depth(made.DepthNoisy(sigma_m=0.05)) - before) / before**2
    assert noise.std() == pytest.approx(0.05, rel=0.1)
    moved = depth(made.Shifted(columns=5))
    np.testing.assert_array_equal(moved[:, 5:], before[:, :-5])
    assert np.isnan(moved[:, :5]).all()


def test_calibrations() -> None:
    def camera(*faults: Fault) -> Any:
        return FaultySource(Small(), *faults).info.camera

    assert camera(made.WrongBaseline(factor=2.0)).baseline == pytest.approx(0.4)
    longer = camera(made.WrongFocalLength(factor=1.5))
    assert (longer.fx, longer.fy, longer.cx) == pytest.approx((60.0, 60.0, 23.5))
    assert longer.baseline == pytest.approx(0.2)
    moved = camera(made.WrongPrincipalPoint(by=(0.25, 0.125)))
    assert (moved.cx, moved.cy) == pytest.approx((35.5, 19.5))
    assert moved.baseline == pytest.approx(0.2)
    with pytest.raises(gvo.GvoError, match="left and right"):
        camera(made.WrongFocalLength(streams=(1,)))


@pytest.mark.parametrize(
    "values",
    [{"first": -1}, {"every": 0}, {"burst": 0}, {"seed": -1}, {"share": 1.5}, {"streams": (2,)}],
    ids=str,
)
def test_parameters_out_of_range_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        made.Dropped(**values)


def test_what_is_no_fault_is_refused() -> None:
    with pytest.raises(ValueError, match="expected faults, got str"):
        FaultySource(Small(), "black")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="by must be 1 or more"):
        made.Late(by=0)


def test_without_faults_a_recording_is_what_it_was() -> None:
    sound = Small()
    source = FaultySource(sound, Fault())
    assert [_bytes(image) for image in source.images()] == [_bytes(i) for i in sound.images()]
    assert source.info.name == "small"
    assert source.ground_truth() is None


def _until_error(source: FaultySource) -> Iterator[StampedImage]:
    try:
        yield from source.images()
    except (RecordingError, OSError):
        return


def _bytes(image: StampedImage) -> bytes:
    try:
        return image.load().tobytes()
    except (RecordingError, OSError, MemoryError, cv2.error) as error:
        return str(error).encode()
