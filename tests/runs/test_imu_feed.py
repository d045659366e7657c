"""Samples of an IMU reach odometry in step with the frames that they lead to."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gvo.config import Config
from gvo.geometry.imu import ImuSamples
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import StampedImage
from gvo.io.synthetic import SyntheticRecording, rendered_imu
from gvo.odometry.odometry import Odometry
from gvo.runs.loop import ImuFeed, RunLoop
from gvo.types import FaultyFrame, Frame, FrameResult
from tests.make.recordings import Held, frames_of, hold

AHEAD_NS = 200_000_000
DARK = range(25, 35)


def batch(stamps_ns: list[int]) -> ImuSamples:
    n = len(stamps_ns)
    return ImuSamples.of(np.array(stamps_ns, dtype=np.int64), np.zeros((n, 3)), np.zeros((n, 3)))


def batches_of(sizes: list[int], every_ns: int) -> list[list[int]]:
    """Return stamps that follow each other, some at a time; some batches are empty."""
    ends = np.cumsum(sizes)
    stamps_ns = np.arange(sum(sizes)) * every_ns
    return [part.tolist() for part in np.split(stamps_ns, ends[:-1])]


@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=40),
    st.integers(1_000_000, 60_000_000),
    st.integers(10_000_000, 400_000_000),
    st.integers(-500_000_000, 500_000_000),
)
def test_samples_come_once_in_order_until_some_are_later_than_the_frame(
    sizes: list[int], every_ns: int, frame_ns: int, delay_ns: int
) -> None:
    n_read, first_ns, batches = 0, 0, batches_of(sizes, every_ns)

    def read(since_ns: int) -> Iterator[ImuSamples]:
        nonlocal n_read
        assert since_ns <= first_ns - 1_000_000_000  # there are samples to begin with
        for stamps_ns in batches:
            n_read += 1
            yield batch(stamps_ns)

    feed, taken = ImuFeed(read, delay_ns=delay_ns), []
    for stamp_ns in range(first_ns, 3_000_000_000, frame_ns):
        for samples in feed.until(stamp_ns + delay_ns):
            assert len(samples) > 0
            taken += samples.stamps_ns.tolist()
        read_ns = [each for stamps_ns in batches[:n_read] for each in stamps_ns]
        assert taken == read_ns
        is_all = n_read == len(batches)
        assert is_all or taken[-1] >= stamp_ns + AHEAD_NS
        # No batch is read before it is needed.
        before = [each for stamps_ns in batches[: n_read - 1] for each in stamps_ns]
        assert not before or is_all or before[-2:][0] < stamp_ns + AHEAD_NS
    assert not [*ImuFeed(lambda _: iter([])).until(0)]


def dark_walk() -> Held:
    """Return a recording with an IMU, of which some frames are black."""
    source = hold(
        SyntheticRecording("handheld", "stereo", n_frames=40, scale=0.3, imu=rendered_imu())
    )

    def change(image: StampedImage, number: int) -> StampedImage:
        if number not in DARK:
            return image
        return replace(image, load=lambda: np.zeros_like(image.load()))

    return source.mapped(change)


def followed(source: Held, config: Config) -> list[FrameResult]:
    """Return what a run gives for each frame."""
    results: list[FrameResult] = []

    def take(_: Frame | FaultyFrame, result: FrameResult | None) -> None:
        assert result is not None
        results.append(result)

    loop = RunLoop(source, config, BaseFrame("camera"))
    loop.on_tracked = take
    loop.run([], None)
    return results


def test_a_run_is_carried_as_odometry_that_has_all_samples_at_once() -> None:
    source = dark_walk()
    assert source.info.imu is not None
    odometry = Odometry(source.info.camera, imu=source.info.imu.imu)
    for samples in source.info.imu.samples(0):
        odometry.add_imu(samples.stamps_ns, samples.gyro, samples.acceleration)
    expected = [odometry.track(frame) for frame in frames_of(source)]
    found = followed(source, Config())
    assert [k for k, result in enumerate(found) if result.is_carried] == [*DARK]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.causal.T_world_frame, other.causal.T_world_frame)
        np.testing.assert_array_equal(one.causal.covariance, other.causal.covariance)


def test_a_run_whose_imu_is_not_enabled_reads_none_of_its_samples() -> None:
    source, config = dark_walk(), Config.model_validate({"imu": {"enabled": False}})
    assert source.info.imu is not None

    def fail(_: int) -> Iterator[ImuSamples]:
        raise AssertionError("samples were read")

    info = replace(source.info, imu=replace(source.info.imu, samples=fail))
    results = followed(replace(source, info=info), config)
    assert len(results) == 40
    assert not any(result.is_carried for result in results)
    assert all(result.inertial is None for result in results)
