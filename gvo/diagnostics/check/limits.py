"""All limits of `gvo check` in one table, each with the reason for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from gvo.diagnostics.check.findings import Finding, Limits


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """Limits of a value, its unit, and what to do where it lies outside."""

    limits: Limits
    unit: str = ""
    fix: str = ""


MAX_BLUR_PX = 1.6
MAX_CLOCK_JUMP_MS = 100.0
MIN_STEREO_MATCHES = 60
MAX_DEPTH_MEDIAN_M = 50.0
# A share of lost frames, for whatever reason, that costs accuracy, and one that costs most poses.
LOST = Rule(limits=Limits(high=0.05, fault_high=0.2), unit="%")
# Streams of one trigger differ by less than 2 ms. A depth camera that runs freely is half a period
# off at worst; 10 ms are half a pixel of a camera in the hand.
STAMP_DIFFERENCES_MS = {"stereo": 2.0, "rgbd": 10.0}

RULES: Mapping[str, Rule] = {
    # A period outside is mostly one in another unit.
    "period": Rule(
        limits=Limits(low=0.5, high=10_000.0),
        unit="ms",
        fix="stamps are in another unit than seconds and nanoseconds: mend the driver",
    ),
    # Velocities, which predict the next frame, are off by as much.
    "jitter": Rule(
        limits=Limits(high=0.3),
        unit="%",
        fix="stamp at the exposure in the driver, not where messages arrive",
    ),
    # So long a camera is coasted over with little harm; `window.lost_after_s` is the fault.
    "gaps": Rule(
        limits=Limits(high=0.5),
        unit="s",
        fix="find what stalled the recording (disk, bandwidth); odometry coasts over it",
    ),
    "stamp difference": Rule(
        limits=Limits(high=STAMP_DIFFERENCES_MS["stereo"]),
        unit="ms",
        fix="trigger both by hardware; a shared offset of the clocks is to be taken off the stamps",
    ),
    # Messages are late at random by some ten milliseconds; clocks that are set jump by more.
    "clock jump": Rule(
        limits=Limits(high=MAX_CLOCK_JUMP_MS),
        unit="ms",
        fix="a clock was set, or recording stalled: keep time synchronisation from stepping it",
    ),
    # A thousandth: quartz is a hundred times better.
    "clock drift": Rule(
        limits=Limits(low=-60.0, high=60.0),
        unit="ms/min",
        fix="synchronise the camera's clock with the computer's (PTP, NTP)",
    ),
    # A baseline outside is mostly one in a wrong unit.
    "baseline": Rule(
        limits=Limits(low=0.01, high=3.0, fault_low=0.001, fault_high=30.0),
        unit="m",
        fix="P[3] of the right CameraInfo is -fx * baseline in metres",
    ),
    # Of 0 to 255: corners outside have no contrast against the noise.
    "brightness": Rule(
        limits=Limits(low=25.0, high=230.0),
        unit="grey",
        fix="set exposure and gain of the camera, or light the scene",
    ),
    "clipped pixels": Rule(limits=Limits(high=0.3), unit="%"),
    # Sharp cameras have 0.3 to 1.3.
    "blur": Rule(
        limits=Limits(high=MAX_BLUR_PX),
        unit="px",
        fix="focus the lens; shorter exposure where the camera moves fast",
    ),
    # A third of `klt.n_corners`; `ransac.min_inliers` is the fault.
    "corners": Rule(
        limits=Limits(low=80.0),
        fix="more light, texture or contrast in view",
    ),
    "corners found again": Rule(
        limits=Limits(low=0.3),
        unit="%",
        fix="higher frame rate or slower motion; check that frames are in order",
    ),
    # Patches are compared without their means, but not without their contrast.
    "brightness ratio": Rule(
        limits=Limits(low=1.0 / 1.3, high=1.3),
        fix="let both cameras share exposure and gain",
    ),
    # A quarter of `klt.n_corners`; `ransac.min_inliers` is the fault.
    "matches": Rule(
        limits=Limits(low=MIN_STEREO_MATCHES),
        fix="make sure that the topics are of one pair, in focus, lit and textured",
    ),
    # Rows are searched within 1.5 px (`stereo.row_tolerance_px`): half of that.
    "row offset": Rule(limits=Limits(fault_low=-0.75, fault_high=0.75), unit="px"),
    # Beyond, 5 % of the matches and more are not found on their rows.
    "row spread": Rule(limits=Limits(fault_high=2.0), unit="px"),
    # Lenses of raw images have 0.2 to 0.4; what rectification leaves is a tenth of that.
    "lens distortion": Rule(
        limits=Limits(fault_low=-0.15, fault_high=0.15),
        fix="the images are raw or wrongly calibrated: choose the raw topics with their D, or give "
        "a --calibration FILE with D",
    ),
    # Wrong matches alone make a few percent; of exchanged cameras nearly all are negative.
    "order": Rule(limits=Limits(high=0.1, fault_high=0.5), unit="%"),
    # Outside is a wrong factor: no camera sees half of a scene so near or so far.
    "scale": Rule(limits=Limits(fault_low=0.2, fault_high=MAX_DEPTH_MEDIAN_M), unit="m"),
    "within limits": Rule(
        limits=Limits(low=0.5, fault_low=0.05),
        unit="%",
        fix="check depth.scale, then depth.min_depth_m and depth.max_depth_m",
    ),
    "unknown": Rule(
        limits=Limits(high=0.5, fault_high=0.75),
        unit="%",
        fix="sunlight, dark or shiny surfaces, or too near: depth is missing there",
    ),
    "corners with depth": Rule(
        limits=Limits(low=MIN_STEREO_MATCHES),
        fix="more light or texture, nearer things; depth that is noisy, full of holes, out of "
        "range or not registered to colour is of no use at corners",
    ),
    # Depth of 8 bits has 256 levels over its whole range, a sound image thousands.
    "levels": Rule(
        limits=Limits(low=64.0, fault_low=16.0),
        fix="record 16UC1 or 32FC1: depth of 8 bits, or constant, is of no use",
    ),
    # Drivers register to two or three pixels.
    "misregistration": Rule(
        limits=Limits(high=3.0, fault_high=6.0),
        unit="px",
        fix="register depth to colour: record the depth camera's CameraInfo and tf, or switch on "
        "the driver's registration; late stamps look alike",
    ),
    "images outside": Rule(
        limits=Limits(high=LOST.limits.high + LOST.limits.fault_high),
        unit="%",
        fix="transforms start late or end early, or are stamped by another clock",
    ),
    # As long as the gaps of images.
    "transform gaps": Rule(
        limits=Limits(high=0.5),
        unit="s",
        fix="transforms were lost: poses are interpolated over the gap",
    ),
}
"""By what is checked, without the name of the stream."""


def measured(
    what: str,
    value: float,
    *,
    stream: str = "",
    rule: str = "",
    text: str = "",
    fix: str = "",
    **others: float,
) -> Finding:
    """Compare a number with the limits of its rule; shares are in [0, 1], shown in percent.

    Parameters
    ----------
    what : str
        Key of `RULES`, and name of the finding after that of its stream.
    value : float
        NaN: unknown.
    stream : str
    rule : str
        Key of `RULES`, where it is another.
    text : str
        Shown in place of the number, if not empty.
    fix : str
        In place of that of the rule.
    **others
        Fields of `Limits` that the configuration gives.
    """
    known = RULES[rule or what]
    name = f"{stream}: {what}" if stream else what
    limits = replace(known.limits, **others)
    return _judge(name, value, limits, known.unit, text=text, fix=fix or known.fix)


def lost(name: str, n: int, n_frames: int, fix: str, how: str = "") -> Finding:
    """Compare the share of frames that are lost, for whatever reason, with its limits."""
    text = f"{n} of {n_frames}{how}"
    return _judge(name, n / n_frames, LOST.limits, LOST.unit, text=text, fix=fix)


def _judge(name: str, value: float, limits: Limits, unit: str, *, text: str, fix: str) -> Finding:
    verdict = limits.judge(value)
    return Finding(
        name=name,
        value=float(value) * (100.0 if unit == "%" else 1.0),
        unit=unit,
        text=text,
        threshold=limits.describe(unit),
        verdict=verdict,
        fix=fix if verdict in ("warning", "fault") else "",
    )
