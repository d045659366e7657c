"""The IMU: stamps, units, and whether it turns as the images do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gvo.backend.imu_alignment import Aligned, Turns, align
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.limits import judged, lost, measured, unknown
from gvo.errors import GvoError
from gvo.geometry import se3
from gvo.geometry.imu import GRAVITY, HOLE_S, ImuSamples, ImuStream
from gvo.types import FloatArray, IntArray

# An axis is saturated where so many samples in a row have its extreme value, and that is so large
# (m/s^2, rad/s) that an IMU may measure no more.
_IN_A_ROW = 4
_LARGE_ACCELERATION, _LARGE_TURN = 15.0, 2.0
# What differs by more sigmas, and more than so much besides, is wrong.
_N_SIGMAS = 3.0
_MIN_DELAY_S, _MIN_TURN = 0.003, np.radians(2.0)
# What is less sure than this is not told: s and rad.
_MAX_DELAY_SIGMA_S, _MAX_TURN_SIGMA = 0.01, np.radians(5.0)
_DEGREES = 180.0 / np.pi


def check_imu(stream: ImuStream, images_ns: IntArray, seen: Turns) -> Iterator[Finding]:
    """Yield the findings on the samples of an IMU.

    Parameters
    ----------
    stream : ImuStream
    images_ns : ndarray of int64, shape (n,)
        Stamps of the images.
    seen : Turns
        Rotations of the camera between some of them.
    """
    try:
        parts = [*stream.samples(0)]
    except GvoError as error:
        yield judged("imu: reading", str(error), is_ok=False, threshold="complete", fix="")
        return
    stamps_ns = np.concatenate([part.stamps_ns for part in parts]) if parts else np.zeros(0, int)
    if len(stamps_ns) < 2:
        n = f"{len(stamps_ns)} samples in {stream.name}"
        yield judged("imu: samples", n, is_ok=False, threshold=">= 2", fix="record the IMU")
        return
    values = np.concatenate([np.hstack([part.gyro, part.acceleration]) for part in parts])
    is_number = np.isfinite(values).all(axis=1)
    yield Finding(name="imu", value=f"{stream.name}, {len(stamps_ns)} samples")
    if not is_number.all():
        n, fix = f"{np.sum(~is_number)} are no numbers", "they are skipped: mend the driver"
        yield judged("imu: values", n, is_ok=False, threshold="numbers", fix=fix)
    yield from _check_stamps(stamps_ns, images_ns)
    if not is_number.any():
        return
    order, kept = np.unique(stamps_ns[is_number], return_index=True)
    gyro, acceleration = np.hsplit(values[is_number][kept], 2)
    samples = ImuSamples(stamps_ns=order, gyro=gyro, acceleration=acceleration)
    yield _check_gravity(samples)
    yield _check_saturation(samples)
    yield from _check_alignment(stream, samples, seen)


def _check_stamps(stamps_ns: IntArray, images_ns: IntArray) -> Iterator[Finding]:
    steps_s = 1e-9 * np.diff(stamps_ns)
    n_bad = int(np.count_nonzero(steps_s <= 0))
    fix = "the driver sends batches: stamp each sample when it is taken; such samples are skipped"
    yield lost("imu: stamps", n_bad, len(stamps_ns), " repeat or go back", fix)
    period_s = float(np.median(steps_s[steps_s > 0])) if n_bad < len(steps_s) else np.nan
    yield measured("imu: rate", 1.0 / period_s)
    yield measured("imu: gaps", float(steps_s.max()), rule="imu gaps", fault_high=np.inf)
    margin_ns = round(1e9 * HOLE_S)
    first_ns, last_ns = stamps_ns.min() - margin_ns, stamps_ns.max() + margin_ns
    if len(images_ns) > 0:
        outside = np.mean((images_ns < first_ns) | (images_ns > last_ns))
        yield measured("imu: images outside", float(outside), rule="images without imu")


def _check_gravity(samples: ImuSamples) -> Finding:
    """Compare accelerations with gravity: in the mean, whatever moves on Earth feels it."""
    felt = float(np.median(np.linalg.norm(samples.acceleration, axis=1)))
    fix = "accelerations are in a wrong unit: mend the driver"
    if abs(felt - 1.0) < 0.2:
        fix = f"accelerations are in g: multiply by {GRAVITY} in the driver"
    elif felt < 2.0:
        fix = "gravity was taken off: record the raw accelerations"
    return measured("imu: gravity", felt, fix=fix)


def _check_saturation(samples: ImuSamples) -> Finding:
    shares = [
        _saturated(values, large)
        for measured_by, large in (
            (samples.acceleration, _LARGE_ACCELERATION),
            (samples.gyro, _LARGE_TURN),
        )
        for values in measured_by.T
    ]
    return measured("imu: saturation", max(shares))


def _saturated(values: FloatArray, large: float) -> float:
    """Return the share of samples that stay at the extreme value of an axis."""
    is_extreme = np.abs(values) >= max(float(np.abs(values).max()) * (1.0 - 1e-6), large)
    rows = np.convolve(is_extreme, np.ones(_IN_A_ROW), "valid") >= _IN_A_ROW
    return float(np.mean(is_extreme)) if rows.any() else 0.0


def _check_alignment(stream: ImuStream, samples: ImuSamples, seen: Turns) -> Iterator[Finding]:
    found = align(seen, samples.stamps_ns, samples.gyro)
    if found is None or found.sigma_turn > _MAX_TURN_SIGMA:
        yield unknown("imu: turns", "the camera turns too little to compare the gyro with it")
        return
    yield _check_scale(found)
    if not found.is_sound:
        return
    if found.sigma_delay_s <= _MAX_DELAY_SIGMA_S:
        yield _check_delay(found, stream.imu.delay_s)
    yield _check_rotation(found, stream.imu.T_camera_imu)


def _check_scale(found: Aligned) -> Finding:
    fix = "gyro and images turn by other angles: is it the IMU of this camera?"
    if abs(found.scale / _DEGREES - 1.0) < 0.3:
        fix = "the gyro is in degrees per second: convert it to rad/s in the driver"
    return measured("imu: turns", found.scale, text=f"{found.scale:.3g} of the camera's", fix=fix)


def _check_delay(found: Aligned, given_s: float | None) -> Finding:
    limit_s = max(_N_SIGMAS * found.sigma_delay_s, _MIN_DELAY_S)
    text = f"stamps {1e3 * found.delay_s:+z.1f} ms, sigma {1e3 * found.sigma_delay_s:.1f}"
    is_wrong = given_s is not None and abs(found.delay_s - given_s) > limit_s
    return Finding(
        name="imu: delay",
        value=1e3 * found.delay_s,
        unit="ms",
        text=text,
        threshold="" if given_s is None else f"{1e3 * given_s:g} +/- {1e3 * limit_s:.1f} ms",
        verdict="info" if given_s is None else "warning" if is_wrong else "ok",
        fix=f"--set imu.delay_ms={1e3 * found.delay_s:.1f}" if is_wrong else "",
    )


def _check_rotation(found: Aligned, T_camera_imu: FloatArray | None) -> Finding:
    sigma_deg = np.degrees(found.sigma_turn)
    if T_camera_imu is None:
        turn = se3.log(se3.make_transform(found.R_camera_imu, np.zeros(3)))[:3]
        x, y, z = np.degrees(turn)
        text = f"rotation vector ({x:.1f}, {y:.1f}, {z:.1f}) deg, sigma {sigma_deg:.1f}: learnt"
        return Finding(name="imu: rotation", value=text)
    off = found.R_camera_imu.T @ T_camera_imu[:3, :3]
    off_deg = np.degrees(float(se3.rotation_angle(off)))
    limit_deg = np.degrees(max(_N_SIGMAS * found.sigma_turn, _MIN_TURN))
    is_wrong = off_deg > limit_deg
    return Finding(
        name="imu: rotation",
        value=off_deg,
        unit="deg",
        text=f"{off_deg:.1f} deg off what images and gyro say, sigma {sigma_deg:.1f}",
        threshold=f"<= {limit_deg:.1f} deg",
        verdict="warning" if is_wrong else "ok",
        fix="T_cam_imu or tf is wrong, or turned round: leave it out, and it is learnt"
        if is_wrong
        else "",
    )
