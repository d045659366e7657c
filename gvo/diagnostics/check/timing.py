"""Stamps: order, rate, gaps, pairing of the two streams, and drift of the clocks."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gvo.config import CheckConfig, Config
from gvo.diagnostics.check.findings import Finding, Limits, lost, measured, unknown
from gvo.diagnostics.check.sampling import StreamStamps, Survey
from gvo.io.frames import pair_limit_key
from gvo.io.recording import RecordingInfo
from gvo.types import FloatArray, IntArray

# Length of a gap, periods; shorter intervals are jitter.
_GAP_PERIODS = 2.5
# The clocks are compared by medians over stretches of the recording.
_N_STRETCHES = 40
_MIN_PER_STRETCH = 3
_MIN_STRETCHES = 4
# A drift is real beyond so many standard deviations.
_DRIFT_SIGMAS = 4.0
# Near half a period, images are paired with the partners of others; streams that have nothing to
# do with each other have differences of any size up to there.
_MAX_SHARE_OF_PERIOD = 0.4
_MIN_SHARE_OF_PERIOD = 0.1
# A period outside is mostly one in a wrong unit.
_PERIODS_MS = (0.5, 10_000.0)


def check_timing(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    """Yield the findings on all stamps of the recording."""
    names = info.stream_names
    for name, stream in zip(names, survey.streams, strict=True):
        yield from _check_stream(name, stream.stamps_ns, config)
    yield from _check_pairs(survey, info, config)
    for name, stream in zip(names, survey.streams, strict=True):
        yield from _check_clock(name, stream, config.check)


def _check_stream(name: str, stamps_ns: IntArray, config: Config) -> Iterator[Finding]:
    if len(stamps_ns) == 0:
        yield Finding(
            name=f"{name}: images",
            value="none",
            threshold=">= 1",
            verdict="fault",
            fix=f"record or choose a {name} stream",
        )
        return
    steps_ns = np.diff(stamps_ns)
    n_bad = int(np.count_nonzero(steps_ns <= 0))
    fix = "record anew, or sort by header stamp; such frames are skipped"
    if np.median(stamps_ns) == 0:
        fix = "the driver stamps nothing: --set sync.stamps=recording takes the bag's clock"
    how = " repeat or go back"
    yield lost(f"{name}: stamps", n_bad, len(stamps_ns), config.check, fix, how)
    forward = steps_ns[steps_ns > 0]
    if len(forward) < 2:
        yield unknown(f"{name}: period", f"{len(stamps_ns)} images")
        return
    yield from _check_rate(name, forward.astype(np.float64) / 1e9, len(stamps_ns), config)


def _check_rate(name: str, steps_s: FloatArray, n: int, config: Config) -> Iterator[Finding]:
    period_s = float(np.median(steps_s))
    low_ms, high_ms = _PERIODS_MS
    yield measured(
        f"{name}: period",
        1e3 * period_s,
        Limits(low=low_ms, high=high_ms),
        unit="ms",
        text=f"{1e3 * period_s:.3g} ms ({1 / period_s:.4g} Hz)"
        if period_s < 1e-3
        else f"{1e3 * period_s:.2f} ms ({1 / period_s:.2f} Hz)",
        fix="stamps are in another unit than seconds and nanoseconds: mend the driver",
    )
    regular = steps_s[steps_s < 1.5 * period_s]
    jitter_s = float(np.percentile(np.abs(regular - period_s), 95))
    yield measured(
        f"{name}: jitter",
        jitter_s / period_s,
        Limits(high=config.check.max_jitter),
        unit="%",
        text=f"{1e3 * jitter_s:.3g} ms, {jitter_s / period_s:.1%} of the period",
        fix="stamp at the exposure in the driver, not where messages arrive",
    )
    yield from _check_gaps(name, steps_s, n, config)


def _check_gaps(name: str, steps_s: FloatArray, n: int, config: Config) -> Iterator[Finding]:
    period_s = float(np.median(steps_s))
    gaps_s = steps_s[steps_s > _GAP_PERIODS * period_s]
    longest_s = float(gaps_s.max(initial=0.0))
    yield measured(
        f"{name}: gaps",
        longest_s,
        Limits(high=config.check.max_gap_s, fault_high=config.window.lost_after_s),
        unit="s",
        text=f"{len(gaps_s)}, longest {longest_s:.3g} s" if len(gaps_s) else "",
        fix="find what stalled the recording (disk, bandwidth); odometry coasts over it",
    )
    n_dropped = int(np.sum(np.maximum(np.rint(steps_s / period_s) - 1, 0)))
    fix = "record with more bandwidth or a smaller rate; every dropped frame widens the motion"
    yield lost(f"{name}: dropped frames", n_dropped, n + n_dropped, config.check, fix)


def _check_pairs(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    first, second = (stream.stamps_ns for stream in survey.streams)
    if len(first) == 0 or len(second) == 0:
        return
    # Of RGB-D streams of two rates, each image of the slower one has a partner.
    if len(second) < len(first) and info.sensor == "rgbd":
        signed_ms = -_nearest_differences(second, first) / 1e6
    else:
        signed_ms = _nearest_differences(first, second) / 1e6
    yield _check_difference(signed_ms, info, config.check)
    yield _check_partners(survey, np.abs(signed_ms), info, config)


def _check_difference(signed_ms: FloatArray, info: RecordingInfo, check: CheckConfig) -> Finding:
    sizes_ms = np.abs(signed_ms)
    typical_ms, signed = float(np.median(sizes_ms)), float(np.median(signed_ms))
    is_stereo = info.sensor == "stereo"
    limit_ms = check.max_stereo_difference_ms if is_stereo else check.max_depth_difference_ms
    return measured(
        f"{'/'.join(info.stream_names)}: stamp difference",
        typical_ms,
        Limits(high=limit_ms),
        unit="ms",
        text=f"{typical_ms:.3g} ms median ({signed:+.3g} signed), {sizes_ms.max():.3g} ms largest",
        fix="trigger both by hardware; a shared offset of the clocks is to be taken off the stamps",
    )


def _check_partners(
    survey: Survey, sizes_ms: FloatArray, info: RecordingInfo, config: Config
) -> Finding:
    name, key = "/".join(info.stream_names), pair_limit_key(info.sensor)
    first, second = (stream.stamps_ns for stream in survey.streams)
    n_frames = min(len(first), len(second)) if info.sensor == "rgbd" else len(first)
    n_alone = max(n_frames - survey.n_pairs, 0)
    limit_ms, period_ms = getattr(config.sync, key), min(_period_ms(first), _period_ms(second))
    low_ms, middle_ms, high_ms = np.percentile(sizes_ms, [25, 50, 95])
    enough_ms = math.ceil(high_ms)
    if limit_ms < enough_ms <= _MAX_SHARE_OF_PERIOD * period_ms:
        fix = f"--set sync.{key}={enough_ms} pairs 95 % of them"
    elif middle_ms > limit_ms and low_ms > _MIN_SHARE_OF_PERIOD * period_ms:
        fix = "the two are not taken together: trigger both by one signal; no tolerance pairs them"
    else:
        fix = f"images of one stream are missing: see dropped frames and gaps of {name}"
    how = f" at sync.{key}={limit_ms:g}"
    return lost(f"{name}: frames without partner", n_alone, n_frames, config.check, fix, how)


def _period_ms(stamps_ns: IntArray) -> float:
    return float(np.median(np.diff(stamps_ns))) / 1e6 if len(stamps_ns) > 1 else math.inf


def _nearest_differences(first_ns: IntArray, second_ns: IntArray) -> FloatArray:
    """Return nearest second stamp minus first stamp, nanoseconds, shape (n,)."""
    ordered = np.unique(second_ns)
    after = np.searchsorted(ordered, first_ns).clip(max=len(ordered) - 1)
    before = (after - 1).clip(min=0)
    to_after, to_before = ordered[after] - first_ns, ordered[before] - first_ns
    is_before = np.abs(to_before) < np.abs(to_after)
    return np.asarray(np.where(is_before, to_before, to_after), dtype=np.float64)


def _check_clock(name: str, stream: StreamStamps, check: CheckConfig) -> Iterator[Finding]:
    """Compare the header stamps with the times of recording.

    Messages are late at random, now and then very late. So medians over stretches of the recording
    are compared: their slope is the drift of one clock against the other, their largest step a
    jump. A constant difference is harmless.
    """
    if len(stream.log_times_ns) == 0:
        return
    elapsed_s = (stream.headers_ns - stream.headers_ns[0]) / 1e9
    offsets_ms = (stream.log_times_ns - stream.headers_ns) / 1e6
    yield Finding(
        name=f"{name}: recording clock",
        value=f"{_duration_text(float(np.median(offsets_ms)))} after the header",
    )
    yield from _check_drift(name, elapsed_s, offsets_ms, check)


def _check_drift(
    name: str, elapsed_s: FloatArray, offsets_ms: FloatArray, check: CheckConfig
) -> Iterator[Finding]:
    n_stretches = min(_N_STRETCHES, len(offsets_ms) // _MIN_PER_STRETCH)
    if n_stretches < _MIN_STRETCHES:
        yield unknown(f"{name}: clock drift", f"{len(offsets_ms)} images are too few")
        return
    middles_s = _medians(elapsed_s, n_stretches)
    levels_ms = _medians(offsets_ms, n_stretches)
    steps_ms = np.diff(levels_ms)
    jump_ms = float(np.abs(steps_ms - np.median(steps_ms)).max())
    yield measured(
        f"{name}: clock jump",
        jump_ms,
        Limits(high=check.max_clock_jump_ms),
        unit="ms",
        fix="a clock was set, or recording stalled: keep time synchronisation from stepping it",
    )
    drift = 0.0 if jump_ms > check.max_clock_jump_ms else _drift(middles_s, levels_ms)
    yield measured(
        f"{name}: clock drift",
        drift,
        Limits(low=-check.max_clock_drift_ms_per_min, high=check.max_clock_drift_ms_per_min),
        unit="ms/min",
        fix="synchronise the camera's clock with the computer's (PTP, NTP)",
    )


def _medians(values: FloatArray, n_stretches: int) -> FloatArray:
    return np.array([np.median(part) for part in np.array_split(values, n_stretches)])


def _drift(middles_s: FloatArray, levels_ms: FloatArray) -> float:
    """Return the slope in ms/min; zero if it is not significant."""
    if np.ptp(middles_s) <= 0:
        return 0.0
    slope, level = np.polyfit(middles_s, levels_ms, 1)
    scatter = np.std(levels_ms - (slope * middles_s + level))
    sigma = scatter / (np.std(middles_s) * math.sqrt(len(middles_s)))
    return 60.0 * float(slope) if abs(slope) > _DRIFT_SIGMAS * sigma else 0.0


def _duration_text(milliseconds: float) -> str:
    if abs(milliseconds) < 1e3:
        return f"{milliseconds:.3g} ms"
    if abs(milliseconds) < 1e8:
        return f"{milliseconds / 1e3:.3g} s"
    return f"{milliseconds / 86_400_000:.1f} days"
