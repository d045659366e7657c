"""The IMU of recordings that are converted."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from gvo.errors import RecordingError
from gvo.geometry.imu import ImuSamples, ImuStream
from gvo.io.convert.convert import convert
from gvo.io.opening import RecordingOptions, open_recording
from gvo.io.recording import Sensor, Source
from gvo.io.synthetic import SyntheticRecording
from gvo.io.synthetic.imu import rendered_imu
from tests.make.recordings import Held, hold

_KINDS = pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])


def _rendered(sensor: Sensor = "stereo", **known: Any) -> Held:
    """Return a rendered recording with an IMU, of which some is said otherwise."""
    imu = rendered_imu("cheap")
    imu = replace(imu, imu=replace(imu.imu, **known))
    return hold(SyntheticRecording("handheld", sensor, n_frames=3, scale=0.1, imu=imu))


def _imu(source: Source) -> ImuStream:
    assert source.info.imu is not None
    return source.info.imu


def _samples(source: Source) -> list[Any]:
    """Return all samples, a row each."""
    return [
        row
        for part in _imu(source).samples(0)
        for row in zip(
            part.stamps_ns.tolist(), part.gyro.tolist(), part.acceleration.tolist(), strict=True
        )
    ]


def _assert_same_place(copy: Source, source: Source) -> None:
    mine, theirs = _imu(copy).imu.T_camera_imu, _imu(source).imu.T_camera_imu
    assert mine is not None
    assert theirs is not None
    np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)


@_KINDS
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_a_bag_holds_all_samples_and_the_place_of_the_imu(
    tmp_path: Path, name: str, sensor: Sensor
) -> None:
    source = _rendered(sensor)
    conversion = convert(source, tmp_path / name, layout="bag" if "." not in name else None)
    copy = open_recording(tmp_path / name)
    assert conversion.skipped == ()
    assert len(_samples(source)) > 50
    assert _samples(copy) == _samples(source)
    _assert_same_place(copy, source)
    assert _imu(copy).imu.delay_s is None
    again = tmp_path / "again.mcap"
    convert(copy, again)
    assert _samples(open_recording(again)) == _samples(source)
    _assert_same_place(open_recording(again), source)


@_KINDS
def test_another_reader_finds_the_samples_in_order(tmp_path: Path, name: str) -> None:
    source = _rendered()
    convert(source, tmp_path / name, layout="bag" if "." not in name else None)
    with AnyReader([tmp_path / name]) as reader:
        log_times, found = [], []
        for connection, log_time_ns, data in reader.messages():
            log_times.append(log_time_ns)
            message: Any = reader.deserialize(data, connection.msgtype)
            if connection.topic.startswith("/tf"):
                continue
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert log_time_ns == stamp_ns
            if connection.topic != "/imu":
                continue
            found.append((stamp_ns, message.angular_velocity.x, message.linear_acceleration.z))
            assert (connection.msgtype, message.header.frame_id) == ("sensor_msgs/msg/Imu", "imu")
            assert message.orientation_covariance[0] == -1.0
    assert log_times == sorted(log_times)
    assert found == [(stamp_ns, gyro[0], force[2]) for stamp_ns, gyro, force in _samples(source)]


@pytest.mark.parametrize("delay_s", [0.0, 0.0125, None])
def test_a_folder_holds_all_that_is_known_of_the_imu(tmp_path: Path, delay_s: float | None) -> None:
    source = _rendered(delay_s=delay_s)
    known = _imu(source).imu
    convert(source, tmp_path / "euroc", layout="euroc")
    copy = open_recording(tmp_path / "euroc")
    assert _samples(copy) == _samples(source)
    _assert_same_place(copy, source)
    for name in ("delay_s", "gyro_noise", "gyro_walk", "acceleration_noise", "acceleration_walk"):
        assert getattr(_imu(copy).imu, name) == getattr(known, name)
    # and by way of a bag, which the folder's file tells what it does not hold
    convert(copy, tmp_path / "a.bag")
    file = tmp_path / "euroc" / "mav0" / "imu0" / "sensor.yaml"
    again = open_recording(tmp_path / "a.bag", options=RecordingOptions(calibration=file))
    for name in ("delay_s", "gyro_noise", "acceleration_walk"):
        assert getattr(_imu(again).imu, name) == getattr(known, name)
    assert _samples(again) == _samples(source)
    _assert_same_place(again, source)


@pytest.mark.parametrize("name", ["a.bag", "euroc"])
def test_a_place_that_is_not_known_stays_so(tmp_path: Path, name: str) -> None:
    source = _rendered(T_camera_imu=None, delay_s=None)
    convert(source, tmp_path / name, layout=None if name == "a.bag" else "euroc")
    copy = open_recording(tmp_path / name)
    assert _imu(copy).imu.T_camera_imu is None
    assert _imu(copy).imu.delay_s is None


def _spoilt(source: Held, *, reason: str = "") -> Held:
    """Return a recording whose IMU repeats two samples, then cannot be read on for a reason."""
    own = _imu(source)

    def samples(start_ns: int) -> Iterator[ImuSamples]:
        first = next(own.samples(start_ns))
        order = [0, 2, 1, 3]
        yield ImuSamples.of(first.stamps_ns[order], first.gyro[order], first.acceleration[order])
        if reason:
            raise RecordingError(reason)

    source.info = replace(source.info, imu=replace(own, samples=samples))
    return source


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "euroc"])
def test_what_can_be_read_is_kept_as_it_came(tmp_path: Path, name: str) -> None:
    layout: Any = "euroc" if name == "euroc" else None
    conversion = convert(
        _spoilt(_rendered(), reason="row 5 is none"), tmp_path / name, layout=layout
    )
    assert conversion.skipped == ("row 5 is none",)
    assert _samples(open_recording(tmp_path / name)) == _samples(_spoilt(_rendered()))


@pytest.mark.parametrize(("sensor", "layout"), [("stereo", "kitti"), ("rgbd", "tum")])
def test_what_a_layout_does_not_hold_is_told(tmp_path: Path, sensor: Any, layout: Any) -> None:
    conversion = convert(_rendered(sensor), tmp_path / "folder", layout=layout)
    assert conversion.skipped == ("IMU: rendered is left out, such a folder holds none",)
    assert open_recording(tmp_path / "folder").info.imu is None
