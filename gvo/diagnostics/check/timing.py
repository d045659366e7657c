"""Stamps: rates, gaps, partners, and the clock of the recording."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gvo.backend.motion_model import LOST_AFTER_S
from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.limits import STAMP_DIFFERENCES_MS, lost, measured, unknown
from gvo.diagnostics.check.sampling import Survey
from gvo.io.frames import pair_limit_key
from gvo.io.recording import RecordingInfo
from gvo.types import FloatArray, IntArray

# Length of a gap, periods; shorter intervals are jitter.
_GAP_PERIODS = 2.5
# The clock of the recording is compared by medians over stretches of it; limits of their spread,
# and of how it grows.
_N_STRETCHES = 20
_MAX_CLOCK_MS, _MAX_DRIFT = 100.0, 1e-3
# Near half a period, images are paired with the partners of others; streams that have nothing to
# do with each other have differences of any size up to there.
_MAX_SHARE_OF_PERIOD = 0.4
_MIN_SHARE_OF_PERIOD = 0.1


def check_timing(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    """Yield the findings on all stamps of the recording."""
    for name, stamps_ns in zip(info.stream_names, survey.stamps_ns, strict=True):
        yield from _check_stream(name, stamps_ns, config)
    if all(len(stamps_ns) for stamps_ns in survey.stamps_ns):
        yield from _check_pairs(survey, info, config)
    streams = zip(info.stream_names, survey.stamps_ns, survey.log_times_ns, strict=True)
    for name, stamps_ns, log_times_ns in streams:
        if len(stamps_ns) == len(log_times_ns) >= _N_STRETCHES:
            yield _check_clock(name, stamps_ns, log_times_ns - stamps_ns)


def _check_stream(name: str, stamps_ns: IntArray, config: Config) -> Iterator[Finding]:
    n = len(stamps_ns)
    if n == 0:
        yield Finding(
            name=f"{name}: images",
            value="none",
            threshold=">= 1",
            verdict="fault",
            fix=f"record or choose a {name} stream",
        )
        return
    steps_s = np.diff(stamps_ns) / 1e9
    n_bad = int(np.count_nonzero(steps_s <= 0))
    is_unstamped = np.median(stamps_ns) == 0
    fix = "the driver stamps nothing: --set sync.stamps=recording takes the bag's clock"
    how = " repeat or go back"
    yield lost(f"{name}: stamps", n_bad, n, how, fix if is_unstamped else "")
    forward_s = steps_s[steps_s > 0]
    if len(forward_s) < 2:
        yield unknown(f"{name}: period", f"{n} images")
        return
    period_s = float(np.median(forward_s))
    text = f"{1e3 * period_s:.4g} ms ({1 / period_s:.4g} Hz)"
    yield measured(f"{name}: period", 1e3 * period_s, text=text)
    regular_s = forward_s[forward_s < 1.5 * period_s]
    jitter_s = float(np.percentile(np.abs(regular_s - period_s), 95))
    text = f"{1e3 * jitter_s:.3g} ms, {jitter_s / period_s:.1%} of the period"
    yield measured(f"{name}: jitter", jitter_s / period_s, text=text)
    longest_s = float(forward_s.max())
    gap_s = longest_s if longest_s > _GAP_PERIODS * period_s else 0.0
    yield measured(f"{name}: gaps", gap_s, fault_high=LOST_AFTER_S)
    n_dropped = int(np.sum(np.maximum(np.rint(forward_s / period_s) - 1, 0)))
    yield lost(f"{name}: dropped frames", n_dropped, n + n_dropped)


def _check_pairs(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    first, second = survey.stamps_ns
    # Of RGB-D streams of two rates, each image of the slower one has a partner.
    if len(second) < len(first) and info.sensor == "rgbd":
        signed_ms = -_nearest_differences(second, first) / 1e6
    else:
        signed_ms = _nearest_differences(first, second) / 1e6
    sizes_ms = np.abs(signed_ms)
    typical_ms, signed = float(np.median(sizes_ms)), float(np.median(signed_ms))
    yield measured(
        f"{'/'.join(info.stream_names)}: stamp difference",
        typical_ms,
        text=f"{typical_ms:.3g} ms median ({signed:+.3g} signed), {sizes_ms.max():.3g} ms largest",
        high=STAMP_DIFFERENCES_MS[info.sensor],
    )
    yield _check_partners(survey, sizes_ms, info, config)


def _check_partners(
    survey: Survey, sizes_ms: FloatArray, info: RecordingInfo, config: Config
) -> Finding:
    name, key = "/".join(info.stream_names), pair_limit_key(info.sensor)
    first, second = survey.stamps_ns
    n_frames = min(len(first), len(second)) if info.sensor == "rgbd" else len(first)
    limit_ms, period_ms = getattr(config.sync, key), min(_period_ms(first), _period_ms(second))
    low_ms, middle_ms, high_ms = np.percentile(sizes_ms, [25, 50, 95])
    enough_ms = math.ceil(high_ms)
    if limit_ms < enough_ms <= _MAX_SHARE_OF_PERIOD * period_ms:
        fix = f"--set sync.{key}={enough_ms} pairs 95 % of them"
    elif middle_ms > limit_ms and low_ms > _MIN_SHARE_OF_PERIOD * period_ms:
        fix = "the two are not taken together: trigger both by one signal; no tolerance pairs them"
    else:
        fix = f"images of one stream are missing: see dropped frames and gaps of {name}"
    n_alone, how = max(n_frames - survey.n_pairs, 0), f" at sync.{key}={limit_ms:g}"
    return lost(f"{name}: frames without partner", n_alone, n_frames, how, fix)


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


def _check_clock(name: str, stamps_ns: IntArray, delays_ns: IntArray) -> Finding:
    """Compare the clock of the headers with that of the recording; a constant offset is harmless.

    Messages are late at random, now and then very late: medians over stretches are compared.
    """
    parts = np.array_split(delays_ns / 1e6, _N_STRETCHES)
    spread_ms = float(np.ptp([np.median(part) for part in parts]))
    return measured(
        f"{name}: recording clock",
        spread_ms,
        high=_MAX_CLOCK_MS + _MAX_DRIFT * float(np.ptp(stamps_ns)) / 1e6,
        text=f"{np.median(delays_ns) / 1e9:.3g} s after the header, varies by {spread_ms:.3g} ms",
    )
