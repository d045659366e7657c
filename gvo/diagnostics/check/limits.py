"""All limits of `gvo check` in one table, each with the reason for it and with what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from gvo.diagnostics.check.findings import Finding, Verdict, number_text
from gvo.geometry.imu import HOLE_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """Range of a value without a warning, range without a fault, and what to do outside."""

    low: float = -math.inf
    high: float = math.inf
    fault_low: float = -math.inf
    fault_high: float = math.inf
    unit: str = ""
    fix: str = ""

    @property
    def factor(self) -> float:
        """By which values are multiplied to be shown: shares are in percent."""
        return 100.0 if self.unit == "%" else 1.0

    @property
    def threshold(self) -> str:
        """The range as text, the tighter limit on each side."""
        low = max(self.low, self.fault_low)
        high = min(self.high, self.fault_high)
        lowest, highest = (number_text(self.factor * limit) for limit in (low, high))
        if math.isinf(low):
            text = f"<= {highest}"
        else:
            text = f">= {lowest}" if math.isinf(high) else f"{lowest} .. {highest}"
        return f"{text} {self.unit}".strip()

    def judge(self, value: float) -> Verdict:
        """Return the verdict on a number; NaN is unknown."""
        if math.isnan(value):
            return "unknown"
        if not self.fault_low <= value <= self.fault_high:
            return "fault"
        return "ok" if self.low <= value <= self.high else "warning"


MAX_BLUR_PX = 1.6
MIN_STEREO_MATCHES = 60
MAX_DEPTH_MEDIAN_M = 50.0
# Streams of one trigger differ by less than 2 ms. A depth camera that runs freely is half a period
# off at worst; 10 ms are half a pixel of a camera in the hand.
STAMP_DIFFERENCES_MS = {"stereo": 2.0, "rgbd": 10.0}

# Of frames lost for one reason: from `high` on they cost accuracy, from `fault_high` most poses.
_LOST = Rule(high=0.05, fault_high=0.2, unit="%")
_RECTIFIED = "calibrate the pair anew, or check R and P: the topic must be as rectified as they say"

RULES: Mapping[str, Rule] = {
    "stamps": replace(_LOST, fix="record anew, or sort by header stamp; such frames are skipped"),
    "dropped frames": replace(
        _LOST, fix="record with more bandwidth or a smaller rate; each one widens the motion"
    ),
    "frames without partner": _LOST,
    "frames that cannot be used": _LOST,
    "frozen images": replace(_LOST, fix="the driver repeats images: record at its own rate"),
    "torn images": replace(
        _LOST, fix="transfers break off: lower rate or size, another cable or port"
    ),
    # A period outside is mostly one in another unit.
    "period": Rule(
        low=0.5, high=10_000.0, unit="ms", fix="stamps are in a wrong unit: mend the driver"
    ),
    # The velocity that predicts the next frame is wrong by as much.
    "jitter": Rule(high=0.3, unit="%", fix="stamp at the exposure, not where messages arrive"),
    # Odometry coasts over shorter gaps with little harm; after `LOST_AFTER_S` it is lost: a fault.
    "gaps": Rule(high=0.5, unit="s", fix="find what stalled the recording: disk, bandwidth"),
    # `STAMP_DIFFERENCES_MS` has the limit of each sensor.
    "stamp difference": Rule(
        unit="ms", fix="trigger both by hardware, or take a shared offset off the stamps"
    ),
    # Messages are late at random by some ten milliseconds; a thousandth more for the drift of the
    # clocks, of which those of quartz have a hundredth.
    "recording clock": Rule(
        unit="ms", fix="a clock was set or drifts (PTP and NTP hold it), or recording stalled"
    ),
    # A baseline outside is mostly one in a wrong unit.
    "baseline": Rule(
        low=0.01,
        high=3.0,
        fault_low=0.001,
        fault_high=30.0,
        unit="m",
        fix="P[3] of the right CameraInfo is -fx * baseline in metres",
    ),
    # Mean grey value, 0 to 255; images outside have too little contrast for corners.
    "brightness": Rule(
        low=25.0, high=230.0, unit="grey", fix="set exposure and gain, or light the scene"
    ),
    "clipped pixels": Rule(
        high=0.3, unit="%", fix="longer exposure where they are black, shorter where white"
    ),
    # Sharp images have 0.3 to 1.3 px.
    "blur": Rule(
        high=MAX_BLUR_PX, unit="px", fix="focus the lens; shorter exposure in fast motion"
    ),
    # A third of `klt.n_corners`; `ransac.min_inliers` is the fault.
    "corners": Rule(low=80.0, fix="more light, texture or contrast in view"),
    "corners found again": Rule(
        low=0.3, unit="%", fix="higher frame rate or slower motion; are the frames in order?"
    ),
    # Patches are compared without their means, but not without their contrast.
    "brightness ratio": Rule(
        low=1.0 / 1.3, high=1.3, fix="let both cameras share exposure and gain"
    ),
    # A quarter of `klt.n_corners`; `ransac.min_inliers` is the fault.
    "matches": Rule(
        low=MIN_STEREO_MATCHES, fix="check that both topics are of one pair, in focus and lit"
    ),
    # Rows are searched within 1.5 px (`stereo.row_tolerance_px`): half of that.
    "row offset": Rule(fault_low=-0.75, fault_high=0.75, unit="px", fix=_RECTIFIED),
    # Beyond, 5 % of the matches and more are not found on their rows.
    "row spread": Rule(fault_high=2.0, unit="px", fix=_RECTIFIED),
    # What changes over the image is learnt and corrected by a run.
    "row field": Rule(high=0.5, unit="px", fix="a run learns and corrects it; calibrate anew"),
    # Lenses of raw images have 0.2 to 0.4; what rectification leaves is a tenth of that.
    "lens distortion": Rule(
        fault_low=-0.15,
        fault_high=0.15,
        fix="raw or wrongly calibrated images: give the raw topics or a --calibration with D",
    ),
    # Wrong matches alone make a few percent; of exchanged cameras nearly all are negative.
    "order": Rule(
        high=0.1, fault_high=0.5, unit="%", fix="the rectification turns the cameras apart"
    ),
    # Outside is a wrong factor: no camera sees half of a scene so near or so far.
    "scale": Rule(
        fault_low=0.2,
        fault_high=MAX_DEPTH_MEDIAN_M,
        unit="m",
        fix="set depth.scale to the counts per metre: 1000 for millimetres, 5000 for TUM",
    ),
    "within limits": Rule(
        low=0.5, fault_low=0.05, unit="%", fix="check depth.scale, depth.min_depth_m, max_depth_m"
    ),
    "unknown": Rule(
        high=0.5, fault_high=0.75, unit="%", fix="sunlight, dark, shiny or near surfaces give none"
    ),
    "corners with depth": Rule(
        low=MIN_STEREO_MATCHES, fix="more light or texture, nearer things; see the depth's faults"
    ),
    # Depth of 8 bits has 256 levels over its whole range, a sound image thousands.
    "levels": Rule(
        low=64.0, fault_low=16.0, fix="record 16UC1 or 32FC1: depth of 8 bits is of no use"
    ),
    # Good drivers register depth within two or three pixels.
    "misregistration": Rule(
        high=3.0,
        fault_high=6.0,
        unit="px",
        fix="register depth to colour in the driver, or record the depth camera's CameraInfo and "
        "tf; late stamps look alike",
    ),
    "images outside": Rule(
        high=0.25, unit="%", fix="transforms start late, end early, or are of another clock"
    ),
    # Below, an IMU tells little of what happens between its samples; 200 Hz are customary.
    "rate": Rule(low=90.0, fault_low=20.0, unit="Hz", fix="let the IMU send at 200 Hz"),
    # What was measured in a longer gap is lost, and the IMU begins anew.
    "imu gaps": Rule(high=HOLE_S, unit="s", fix="samples were lost: record with a larger queue"),
    "images without imu": Rule(
        high=0.05,
        fault_high=0.9,
        unit="%",
        fix="the IMU begins late, ends early, or has a clock of its own",
    ),
    "gravity": Rule(fault_low=8.5, fault_high=11.5, low=9.4, high=10.3, unit="m/s^2"),
    "saturation": Rule(
        high=0.0, unit="%", fix="choose a wider range of the IMU, or mount it softly"
    ),
    "turns": Rule(fault_low=0.8, fault_high=1.25, low=0.95, high=1.05),
    # As long as the gaps of images.
    "transform gaps": Rule(high=0.5, unit="s", fix="transforms were lost: poses are interpolated"),
}
"""By what is checked, without the name of the stream."""


def measured(
    name: str, value: float, *, rule: str = "", text: str = "", fix: str = "", **limits: float
) -> Finding:
    """Compare a number with the limits of its rule.

    Parameters
    ----------
    name : str
        What is checked, after the name of its stream and a colon.
    value : float
        Shares are in [0, 1]; NaN: unknown.
    rule : str
        Key of `RULES`, where it is not what is checked.
    text : str
        Shown in place of the number, if not empty.
    fix : str
        In place of that of the rule.
    **limits
        Of the rule, as the configuration gives them.
    """
    known = replace(RULES[rule or name.rpartition(": ")[2]], **limits)  # type: ignore[arg-type]
    verdict = known.judge(value)
    return Finding(
        name=name,
        value=known.factor * float(value),
        unit=known.unit,
        text=text,
        threshold=known.threshold,
        verdict=verdict,
        fix=(fix or known.fix) if verdict in ("warning", "fault") else "",
    )


def lost(name: str, n: int, n_frames: int, how: str = "", fix: str = "") -> Finding:
    """Compare the share of frames that are lost with its limits."""
    return measured(name, n / n_frames, text=f"{n} of {n_frames}{how}", fix=fix)


def judged(
    name: str, value: str, *, is_ok: bool, threshold: str, fix: str, otherwise: Verdict = "warning"
) -> Finding:
    """Return a finding that is ok or not."""
    return Finding(
        name=name,
        value=value,
        threshold=threshold,
        verdict="ok" if is_ok else otherwise,
        fix="" if is_ok else fix,
    )


def unknown(name: str, reason: str) -> Finding:
    """Return a finding without a verdict, since the recording lacks what the check needs."""
    return Finding(name=name, value=reason, verdict="unknown")
