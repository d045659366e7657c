"""Stamps and frame rates; a rolling shutter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import groupby, takewhile

import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding, unknown
from gvo.diagnostics.check.limits import (
    MAX_CLOCK_JUMP_MS,
    STAMP_DIFFERENCES_MS,
    lost,
    measured,
)
from gvo.diagnostics.check.sampling import Sample, StreamStamps, Survey
from gvo.errors import GvoError
from gvo.frontend.klt import image_of
from gvo.frontend.tracking import N_WIDE_LEVELS, detect_corners, track_pixels
from gvo.io.frames import frames, pair_limit_key
from gvo.io.recording import ChosenImages, RecordingInfo, Source, StampedImage
from gvo.odometry.odometry import Odometry
from gvo.types import FaultyFrame, FloatArray, Frame, IntArray

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
_N_PARTS = 3
_N_FRAMES = 30
# Images of a stream may come so much later than those of the other.
_DELAY_NS = 1_000_000_000
# Largest sigma that is of use, and the difference that is one, in sigmas and at least.
_MAX_SIGMA_MS = 2.5
_N_SIGMAS = 3.0
# Links tell the readout best, also those that would add little to the poses.
_LINK_GAIN = 0.5
_MIN_DIFFERENCE_MS = 2.0


def check_timing(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    """Yield the findings on all stamps of the recording."""
    names = info.stream_names
    for name, stream in zip(names, survey.streams, strict=True):
        yield from _check_stream(name, stream.stamps_ns, config)
    yield from _check_pairs(survey, info, config)
    for name, stream in zip(names, survey.streams, strict=True):
        yield from _check_clock(name, stream)


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
    yield lost(f"{name}: stamps", n_bad, len(stamps_ns), fix, how)
    forward = steps_ns[steps_ns > 0]
    if len(forward) < 2:
        yield unknown(f"{name}: period", f"{len(stamps_ns)} images")
        return
    yield from _check_rate(name, forward.astype(np.float64) / 1e9, len(stamps_ns), config)


def _check_rate(name: str, steps_s: FloatArray, n: int, config: Config) -> Iterator[Finding]:
    period_s = float(np.median(steps_s))
    yield measured(
        "period",
        1e3 * period_s,
        stream=name,
        text=f"{1e3 * period_s:.3g} ms ({1 / period_s:.4g} Hz)"
        if period_s < 1e-3
        else f"{1e3 * period_s:.2f} ms ({1 / period_s:.2f} Hz)",
    )
    regular = steps_s[steps_s < 1.5 * period_s]
    jitter_s = float(np.percentile(np.abs(regular - period_s), 95))
    yield measured(
        "jitter",
        jitter_s / period_s,
        stream=name,
        text=f"{1e3 * jitter_s:.3g} ms, {jitter_s / period_s:.1%} of the period",
    )
    yield from _check_gaps(name, steps_s, n, config)


def _check_gaps(name: str, steps_s: FloatArray, n: int, config: Config) -> Iterator[Finding]:
    period_s = float(np.median(steps_s))
    gaps_s = steps_s[steps_s > _GAP_PERIODS * period_s]
    longest_s = float(gaps_s.max(initial=0.0))
    yield measured(
        "gaps",
        longest_s,
        stream=name,
        fault_high=config.window.lost_after_s,
        text=f"{len(gaps_s)}, longest {longest_s:.3g} s" if len(gaps_s) else "",
    )
    n_dropped = int(np.sum(np.maximum(np.rint(steps_s / period_s) - 1, 0)))
    fix = "record with more bandwidth or a smaller rate; every dropped frame widens the motion"
    yield lost(f"{name}: dropped frames", n_dropped, n + n_dropped, fix)


def _check_pairs(survey: Survey, info: RecordingInfo, config: Config) -> Iterator[Finding]:
    first, second = (stream.stamps_ns for stream in survey.streams)
    if len(first) == 0 or len(second) == 0:
        return
    # Of RGB-D streams of two rates, each image of the slower one has a partner.
    if len(second) < len(first) and info.sensor == "rgbd":
        signed_ms = -_nearest_differences(second, first) / 1e6
    else:
        signed_ms = _nearest_differences(first, second) / 1e6
    yield _check_difference(signed_ms, info)
    yield _check_partners(survey, np.abs(signed_ms), info, config)


def _check_difference(signed_ms: FloatArray, info: RecordingInfo) -> Finding:
    sizes_ms = np.abs(signed_ms)
    typical_ms, signed = float(np.median(sizes_ms)), float(np.median(signed_ms))
    return measured(
        "stamp difference",
        typical_ms,
        stream="/".join(info.stream_names),
        text=f"{typical_ms:.3g} ms median ({signed:+.3g} signed), {sizes_ms.max():.3g} ms largest",
        high=STAMP_DIFFERENCES_MS[info.sensor],
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
    return lost(f"{name}: frames without partner", n_alone, n_frames, fix, how)


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


def _check_clock(name: str, stream: StreamStamps) -> Iterator[Finding]:
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
    yield from _check_drift(name, elapsed_s, offsets_ms)


def _check_drift(name: str, elapsed_s: FloatArray, offsets_ms: FloatArray) -> Iterator[Finding]:
    n_stretches = min(_N_STRETCHES, len(offsets_ms) // _MIN_PER_STRETCH)
    if n_stretches < _MIN_STRETCHES:
        yield unknown(f"{name}: clock drift", f"{len(offsets_ms)} images are too few")
        return
    middles_s = _medians(elapsed_s, n_stretches)
    levels_ms = _medians(offsets_ms, n_stretches)
    steps_ms = np.diff(levels_ms)
    jump_ms = float(np.abs(steps_ms - np.median(steps_ms)).max())
    yield measured("clock jump", jump_ms, stream=name)
    drift = 0.0 if jump_ms > MAX_CLOCK_JUMP_MS else _drift(middles_s, levels_ms)
    yield measured("clock drift", drift, stream=name)


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


def check_shutter(source: Source, found: Survey, config: Config) -> Iterator[Finding]:
    """Yield the readout time of the camera; nothing where the recording does not tell it.

    Odometry runs over three parts of 30 frames, around the samples that move most.
    """
    parts = _choose_parts(found, config)
    learnt = np.array([_learn(part, source, config) for part in _read(source, parts, config)])
    if len(learnt) == 0:
        return
    found_ms, sigma_ms = _mean(learnt)
    if sigma_ms > _MAX_SIGMA_MS:
        return
    given_ms = config.camera.readout_ms
    limit_ms = max(_N_SIGMAS * sigma_ms, _MIN_DIFFERENCE_MS)
    is_wrong = given_ms is not None and abs(found_ms - given_ms) > limit_ms
    yield Finding(
        name="rolling shutter",
        value=found_ms,
        unit="ms",
        text=f"readout {found_ms:z.1f} ms, sigma {sigma_ms:.1f}",
        threshold="" if given_ms is None else f"{given_ms:g} +/- {limit_ms:.1f} ms",
        verdict="warning" if is_wrong else "info" if given_ms is None else "ok",
        fix="--set camera.readout_ms=null learns it" if is_wrong else "",
    )


def _choose_parts(found: Survey, config: Config) -> list[tuple[int, int]]:
    """Return when parts begin and end, nanoseconds, in order and apart."""
    stamps_ns = np.unique(found.streams[0].stamps_ns)
    if len(stamps_ns) < 2:
        return []
    half_ns = int(np.median(np.diff(stamps_ns))) * _N_FRAMES // 2
    moving = [(_flow_px(sample, config), sample.stamp_ns) for sample in found.samples]
    chosen: list[int] = []
    for flow_px, stamp_ns in sorted(moving, reverse=True):
        is_apart = all(abs(stamp_ns - other) > 2 * half_ns for other in chosen)
        if flow_px > 0.0 and is_apart and len(chosen) < _N_PARTS:
            chosen.append(stamp_ns)
    return [(stamp_ns - half_ns, stamp_ns + half_ns) for stamp_ns in sorted(chosen)]


def _flow_px(sample: Sample, config: Config) -> float:
    """Return the median displacement of corners between a frame and the next."""
    first, second = sample.first, sample.second
    if second is None or isinstance(first, FaultyFrame) or isinstance(second, FaultyFrame):
        return 0.0
    images = image_of(first), image_of(second)
    corners = detect_corners(images[0], config.klt.n_corners)
    ends, is_tracked = track_pixels(
        images, corners, corners, n_levels=N_WIDE_LEVELS, is_checked=True
    )
    lengths = np.linalg.norm(ends - corners, axis=1)[is_tracked]
    return float(np.median(lengths)) if len(lengths) >= config.ransac.min_inliers else 0.0


def _part_of(stamp_ns: int, parts: Sequence[tuple[int, int]]) -> int | None:
    return next((n for n, (start, end) in enumerate(parts) if start <= stamp_ns <= end), None)


def _images_of(source: Source, parts: Sequence[tuple[int, int]]) -> Iterator[StampedImage]:
    """Yield the images of some parts of a recording."""
    last_ns = parts[-1][1] + _DELAY_NS
    for image in takewhile(lambda image: image.stamp_ns < last_ns, source.images()):
        if _part_of(image.stamp_ns, parts) is not None:
            yield image


def _read(
    source: Source, parts: Sequence[tuple[int, int]], config: Config
) -> Iterator[Iterator[Frame]]:
    """Yield the frames of each part."""
    if parts:
        chosen = ChosenImages(info=source.info, images=partial(_images_of, source, parts))
        usable = _usable(chosen, config)
        for _, part in groupby(usable, key=lambda frame: _part_of(frame.stamp_ns, parts)):
            yield part


def _usable(source: Source, config: Config) -> Iterator[Frame]:
    """Yield frames up to where a recording is damaged, which is a finding of its own."""
    try:
        for frame in frames(source, config, with_unpaired=False):
            if not isinstance(frame, FaultyFrame):
                yield frame
    except GvoError:
        return


def _learn(part: Iterator[Frame], source: Source, config: Config) -> tuple[float, float]:
    """Return what odometry learns of the readout time and its sigma, milliseconds."""
    learning = {
        "camera": config.camera.model_copy(update={"readout_ms": None}),
        "window": config.window.model_copy(update={"link_gain": _LINK_GAIN}),
    }
    odometry = Odometry(source.info.camera, config.model_copy(update=learning))
    for frame in part:
        odometry.track(frame)
    offsets = odometry.rig_offsets
    if offsets is None:
        return 0.0, np.inf
    return 1e3 * offsets.readout.value, 1e3 * offsets.readout.sigma


def _mean(learnt: FloatArray) -> tuple[float, float]:
    """Return the mean of values and sigmas, shape (n, 2), its sigma not below their scatter."""
    values, weights = learnt[:, 0], learnt[:, 1] ** -2
    mean = float(np.average(values, weights=weights))
    chi2 = float(np.sum(weights * (values - mean) ** 2)) / max(len(values) - 1, 1)
    return mean, float(np.sqrt(max(chi2, 1.0) / weights.sum()))
