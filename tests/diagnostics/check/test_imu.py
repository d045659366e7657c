"""What `gvo check` says of an IMU, on samples of a hand whose motion is known by formula."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gvo.backend.imu_alignment import Turns
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.imu import check_imu
from gvo.geometry.imu import Imu, ImuSamples, ImuStream
from gvo.types import Edge
from tests.backend.imus import EXACT, HAND, STILL, Hand, Sensor, ns, transform

END_S, RATE_HZ = 5.0, 20


def turns(hand: Hand) -> Turns:
    """Return the true rotations of a camera that sits in the IMU, from frame to frame."""
    times_s, steps = np.arange(1, END_S * RATE_HZ) / RATE_HZ, []
    for start_s, end_s in pairwise(times_s.tolist()):
        R = hand.rotations(start_s).inv() * hand.rotations(end_s)
        T = transform(R.as_rotvec(), np.zeros(3))
        edge = Edge(reference_id=ns(start_s), T_reference_frame=T, covariance=1e-8 * np.eye(6))
        steps.append((ns(end_s), edge))
    return Turns.of(steps)


def check(
    change: Callable[[ImuSamples], ImuSamples] = lambda samples: samples,
    imu: Imu = EXACT,
    hand: Hand = HAND,
) -> dict[str, Finding]:
    samples = change(Sensor().measure(hand, END_S + 0.3))
    stream = ImuStream(name="/imu", imu=imu, samples=lambda _: iter([samples]))
    images_ns = np.array([ns(time_s) for time_s in np.arange(0.0, END_S, 1.0 / RATE_HZ)])
    return {found.name: found for found in check_imu(stream, images_ns, turns(hand))}


def complaints(found: dict[str, Finding]) -> dict[str, str]:
    return {
        name: each.verdict for name, each in found.items() if each.verdict in ("warning", "fault")
    }


def scaled(**factors: float) -> Callable[[ImuSamples], ImuSamples]:
    return lambda samples: replace(
        samples, **{name: factor * getattr(samples, name) for name, factor in factors.items()}
    )


def kept(is_kept: Callable[[Any], Any]) -> Callable[[ImuSamples], ImuSamples]:
    def change(samples: ImuSamples) -> ImuSamples:
        chosen = is_kept(1e-9 * (samples.stamps_ns - ns(0.0)))
        return ImuSamples(
            stamps_ns=samples.stamps_ns[chosen],
            gyro=samples.gyro[chosen],
            acceleration=samples.acceleration[chosen],
        )

    return change


def test_a_sound_imu_gives_no_complaint() -> None:
    found = check()
    assert not complaints(found)
    assert found["imu: gravity"].value == pytest.approx(9.81, abs=0.3)
    assert found["imu: turns"].value == pytest.approx(1.0, abs=0.01)
    assert abs(float(found["imu: delay"].value)) < 1.0
    assert float(found["imu: rotation"].value) < 0.3


@pytest.mark.parametrize(
    ("change", "name", "words"),
    [
        (scaled(acceleration=1.0 / 9.81), "imu: gravity", "in g"),
        (scaled(acceleration=0.05), "imu: gravity", "gravity was taken off"),
        (scaled(acceleration=2.0), "imu: gravity", "wrong unit"),
        (scaled(gyro=180.0 / np.pi), "imu: turns", "degrees per second"),
        (kept(lambda t: (t < 2.0) | (t > 2.5)), "imu: gaps", "lost"),
        (kept(lambda t: t < 4.0), "imu: images outside", "ends early"),
        (kept(lambda t: np.arange(len(t)) % 4 == 0), "imu: rate", "200 Hz"),
    ],
)
def test_what_is_wrong_is_named_with_what_to_do(
    change: Callable[[ImuSamples], ImuSamples], name: str, words: str
) -> None:
    found = check(change)
    assert name in complaints(found)
    assert words in found[name].fix


def test_stamps_that_repeat_are_counted() -> None:
    def repeated(samples: ImuSamples) -> ImuSamples:
        stamps_ns = samples.stamps_ns.copy()
        stamps_ns[1::4] = stamps_ns[::4][: len(stamps_ns[1::4])]
        return replace(samples, stamps_ns=stamps_ns)

    assert "imu: stamps" in complaints(check(repeated))


def test_a_delay_and_a_rotation_that_the_recording_does_not_tell_are_named() -> None:
    late = check(lambda samples: replace(samples, stamps_ns=samples.stamps_ns - 20_000_000))
    assert late["imu: delay"].value == pytest.approx(20.0, abs=1.0)
    assert late["imu: delay"].fix == f"--set imu.delay_ms={late['imu: delay'].value:.1f}"
    turned = check(imu=replace(EXACT, T_camera_imu=transform([0.0, 0.0, 0.2], np.zeros(3))))
    assert turned["imu: rotation"].value == pytest.approx(np.degrees(0.2), abs=0.5)
    assert complaints(turned) == {"imu: rotation": "warning"}
    unknown = check(imu=Imu())
    assert not complaints(unknown)
    assert "learnt" in str(unknown["imu: rotation"].value)


def test_samples_that_are_no_numbers_are_counted_and_left_out() -> None:
    def spoilt(samples: ImuSamples) -> ImuSamples:
        gyro = samples.gyro.copy()
        gyro[len(gyro) // 2 :: 2, 1] = np.nan
        return replace(samples, gyro=gyro)

    found = check(spoilt)
    assert complaints(found) == {"imu: values": "warning"}
    assert found["imu: gravity"].verdict == "ok"
    empty = check(lambda samples: replace(samples, acceleration=np.nan * samples.acceleration))
    assert complaints(empty) == {"imu: values": "warning"}


def test_a_clipped_axis_is_saturated() -> None:
    def clipped(samples: ImuSamples) -> ImuSamples:
        largest = float(np.abs(samples.acceleration).max())
        wide = samples.acceleration * (40.0 / largest)
        return replace(samples, acceleration=wide.clip(-20.0, 20.0))

    assert check(clipped)["imu: saturation"].verdict == "warning"
    assert check()["imu: saturation"].verdict == "ok"


def test_a_camera_that_does_not_turn_tells_nothing_of_the_gyro() -> None:
    found = check(hand=STILL)
    assert found["imu: turns"].verdict == "unknown"
    assert "imu: delay" not in found
    assert not complaints(found)


def test_an_imu_without_samples_is_a_warning() -> None:
    found = check(kept(lambda t: t < -9.0))
    assert [*complaints(found)] == ["imu: samples"]
