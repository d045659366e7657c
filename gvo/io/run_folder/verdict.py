"""What a summary says in plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot
from typing import Any

from gvo.io.run_folder.writer import GLOBAL

# A camera that keeps within a box of this diagonal is at rest, metres.
_REST_M = 0.05
# Sigmas that are right within this factor fit.
_FIT_FACTOR = 2.0
# A camera that looks so nearly along so long a way is driven.
_HEADING_DEG, _DRIVE_M = 15.0, 20.0
# What was learnt of a camera is told from here on, and where it is more than three sigmas.
_DISPARITY_PX, _ROW_PX = 1.0, 0.5
_READOUT_MS = 5.0
# A longer delay is corrected in part only.
_DELAY_MS = 10.0
# A scale is wrong that is off by more than this, and without which so much of the ATE is left.
_SCALE, _SCALED_SHARE = 0.02, 0.4
# A jump matters that is so large a share of the ATE.
_JUMP_SHARE = 0.25
_SCALED_BY = {"stereo": "the baseline", "rgbd": "depth.scale"}


def verdict(summary: Mapping[str, Any]) -> str:
    """Say how far a run came, how good it is, and what is likely wrong, from its `summary.json`."""
    best = _best(summary)
    offsets = summary.get("rig_offsets") or {}
    delay_ms = abs(offsets.get("delay_ms") or 0.0)
    # A fault of the camera that large explains the errors as well.
    is_told = summary.get("standstill") or offsets.get("zoom") or delay_ms > _DELAY_MS
    sensor = summary.get("sensor", "")
    causes = [] if best is None or is_told else likely_causes(best, sensor=sensor)
    looks = [*_looks_at_frames(summary), *_looks_at_camera(offsets)]
    n_carried, percent = offsets.get("carried_corners"), offsets.get("carried_percent")
    sure = _how_sure(summary)
    sentences = [
        "; ".join(filter(None, [_how_far(summary), _how_good(summary)])),
        causes and f"Likely cause: {'; '.join(causes)}",
        looks and f"Worth a look: {'; '.join(looks)}",
        _how_calibrated(offsets),
        sure and f"Covariances {sure}",
        n_carried
        and f"{percent:.0f} % of the view rides with the camera ({n_carried} corners): not used",
    ]
    return " ".join(f"{sentence}." for sentence in sentences if sentence)


def likely_causes(errors: Mapping[str, Any], *, sensor: str = "") -> list[str]:
    """Say what the errors of an estimate likely come from, the most likely cause first.

    Parameters
    ----------
    errors : mapping
        A row of `evaluations_json`.
    sensor : {"stereo", "rgbd", ""}
    """
    causes, ate_m = [], errors["ate_m"]
    scale, scaled_m = errors.get("scale"), errors.get("scaled_ate_m")
    if scale is not None and abs(scale - 1.0) > _SCALE and scaled_m < _SCALED_SHARE * ate_m:
        what = _SCALED_BY.get(sensor, "the baseline, or depth.scale,")
        causes.append(
            f"the scale, the path is {1.0 / scale:.3g} times as long as the true one (is {what} "
            f"right? times {scale:.3g}, errors fall to {scaled_m:.2g} m)"
        )
    jumps = [each for each in errors.get("jumps") or () if each[2] > _JUMP_SHARE * ate_m]
    if jumps:
        words = (f"{error_m:.3g} m at frame {n} ({1e-9 * ns:.3f} s)" for n, ns, error_m in jumps)
        kind = "jumps" if len(jumps) > 1 else "a jump"
        causes.append(f"{kind} of {', '.join(words)} in the estimate or the truth")
    return causes


def _how_far(summary: Mapping[str, Any]) -> str:
    n, n_tracked = summary.get("frames", 0), summary.get("tracked", 0)
    path_m, extent_m = summary.get("path_m"), summary.get("extent_m")
    way = f"{n} frames"
    if path_m is not None:
        way = f"{path_m:.2g} m in {n} frames" if path_m < 10.0 else f"{path_m:.0f} m in {n} frames"
    if extent_m is not None and extent_m < _REST_M and n_tracked > 1:
        way = f"at rest, within {extent_m:.2g} m, in {n} frames"
    if summary.get("state", "complete") != "complete":
        way = f"{way} so far"
    counts = summary.get("status_counts", {})
    words = {"coasting": "bridged", "lost": "lost", "skipped": "faulty"}
    others = [f"{counts[key]} {word}" for key, word in words.items() if counts.get(key)]
    tracked = "all tracked" if n_tracked == n > 0 else f"{n_tracked or 'none'} tracked"
    return ", ".join([way, tracked, *others, *_segment_words(summary.get("segments", ()))])


def _segment_words(segments: Sequence[Mapping[str, Any]]) -> list[str]:
    if len(segments) < 2:
        return []
    n_joined = sum(segment.get("joined_to") is not None for segment in segments)
    return [f"in {len(segments)} segments, {n_joined} of them joined to another"]


def _best(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the errors of the best poses: the global ones where loops were closed."""
    errors = {row["name"]: row for row in summary.get("errors", ())}
    loops = (summary.get(GLOBAL) or {}).get("loops") or {}
    is_closed = GLOBAL in errors and loops.get("counted", 0) > 0
    return errors.get(GLOBAL if is_closed else "smoothed")


def _how_good(summary: Mapping[str, Any]) -> str:
    best = _best(summary)
    if best is not None:
        n, n_true = summary["frames"], best["n"]
        where = "" if n_true >= 0.9 * n else f", known of {n_true} frames"
        how = " with loops closed" if best["name"] == GLOBAL else ""
        return f"{best['ate_m']:.2g} m from the truth{how}{where}"
    if any(str(each).startswith("not compared") for each in summary.get("warnings", ())):
        return "not compared with the truth"
    is_over = summary.get("state", "complete") == "complete"
    return "no truth to compare with" if is_over else ""


def loop_words(summary: Mapping[str, Any]) -> str:
    """Say how many loops were closed, and why others were not; empty without global poses."""
    loops = (summary.get(GLOBAL) or {}).get("loops")
    if loops is None:
        return ""
    n, refused = loops["counted"], loops["refused"]
    words = f"{n or 'no'} loop{'s' if n > 1 else ''} {'closed' if loops['found'] else 'found'}"
    if refused:
        reasons = ", ".join(f"{count}: {reason}" for reason, count in refused.items())
        words += f", {sum(refused.values())} refused ({reasons})"
    return words if n else f"{words}; global is smoothed"


def imu_words(summary: Mapping[str, Any]) -> str:
    """Say how often and how long an IMU carried the camera, or why not; empty without one."""
    imu = summary.get("imu")
    if imu is None:
        return ""
    if not imu["has_started"]:
        return f"the IMU {imu['name']} was not used: {imu['reason']}"
    n, n_restarts, sum_s = imu["n_gaps"], imu["n_restarts"], f"{imu['carried_s']:.2g} s"
    words = ["the IMU had nothing to carry"]
    if n:
        longest_s = f" in all, {imu['longest_s']:.2g} s at the longest" if n > 1 else ""
        words = [f"the IMU carried the camera {_times(n)}, {sum_s}{longest_s}"]
    if n_restarts:
        words.append(f"it was interrupted {_times(n_restarts)}: {imu['reason']}")
    if imu["is_delay_learnt"]:
        words.append(f"its delay of {imu['delay_ms']:.2g} ms was learnt")
    return "; ".join(words)


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"


def _how_calibrated(offsets: Mapping[str, Any]) -> str:
    if not (px := offsets.get("calibration_px")):
        return ""
    left_px = offsets.get("calibration_left_px")
    after = f", after correction to {left_px:.2g} px" if left_px else ""
    return f"The calibration is good to {px:.2g} px{after}"


def _how_sure(summary: Mapping[str, Any]) -> str:
    found = [spans["1s"] for spans in (summary.get("nees") or {}).values() if spans.get("1s")]
    if not found:
        return ""
    ways = found[-1]  # of the window, else of the raw chain
    row = ways.get("fitted") or ways["bare"]
    if summary.get("heading_deg", 90.0) <= _HEADING_DEG and summary["path_m"] > _DRIVE_M:
        nees = 0.75 * row["rotation"] + 0.25 * row["along"]
        rest = "; across the way the reference cannot tell"
    else:
        nees, rest = 0.5 * (row["rotation"] + row["translation"]), ""
    factor, jump_m = nees**0.5, summary.get("truth_jump_m") or 0.0
    if factor < 1.0 / _FIT_FACTOR and nees < row["low"]:
        return f"are too large, {1.0 / factor:.2g} times in sigma{rest}"
    if factor <= _FIT_FACTOR or nees <= row["high"]:
        return f"fit{rest}"
    # Noise of the true poses is as large from frame to frame; errors of a motion add up.
    if jump_m > 0.5 * row["error_m"]:
        return f"cannot be judged, the truth jumps by {jump_m:.2g} m between frames"
    off = f"{row['error_m']:.2g} m and {row['error_deg']:.2g} deg over 1 s"
    unless = "" if "fitted" in ways else f", unless the truth itself is off by {off}"
    return f"are too small, {factor:.2g} times in sigma{unless}{rest}"


def nees_table(nees: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the NEES of a summary as a table of text, the header first."""
    rows: list[tuple[str, ...]] = [
        ("NEES of motions", "n", "rotation", "translation", "along", "by chance")
    ]
    for name, spans in nees.items():
        for span, ways in spans.items():
            for way, row in ways.items():
                first = f"{name} over {span.removesuffix('s')} s, {way}", str(row["n"])
                errors = (f"{row[key]:.2f}" for key in ("rotation", "translation", "along"))
                rows.append((*first, *errors, f"{row['low']:.2f} to {row['high']:.2f}"))
    return rows


def reference_words(reference: Mapping[str, Any] | str | None) -> str:
    """Say in a sentence what was fitted of the reference of a summary; empty without one."""
    if not isinstance(reference, Mapping):
        return f"The run is {reference} where the reference lies." if reference else ""
    sigmas, delay_ms = reference["sigmas"], reference["delay_ms"]
    turned, off = (
        f"{factor * hypot(*reference[key]):.2g} \u00b1 {factor * max(sigmas[key]):.2g}"
        for key, factor in (("rotation_deg", 1.0), ("lever_m", 1e3))
    )
    when = "late" if delay_ms > 0.0 else "early"
    return (
        f"Fitted: the reference is turned by {turned} deg and lies {off} mm off, and it is "
        f"{abs(delay_ms):.2g} \u00b1 {sigmas['delay_ms']:.2g} ms {when}."
    )


def _looks_at_frames(summary: Mapping[str, Any]) -> list[str]:
    counts = summary.get("status_counts", {})
    is_bad = any(counts.get(key) for key in ("coasting", "lost", "skipped"))
    found = ["frames.csv, which says why frames are not tracked"] if is_bad else []
    if still := summary.get("standstill"):
        found.append(
            f"the camera's driver, images stand still from frame {still['frame']} on, at "
            f"{still['speed_mps']:.2g} m/s the frame before"
        )
    return found


def _looks_at_camera(offsets: Mapping[str, Any]) -> list[str]:
    if zoom := offsets.get("zoom"):  # what else was learnt is of two cameras
        return [
            f"zoom and focus, which have to be fixed: the view is {zoom:.3g} times as large from "
            f"{1e-9 * offsets['zoom_ns']:.3f} s on"
        ]
    found = []
    names = "disparity_px", "row_px", "pixel_px", "readout_ms", "delay_ms"
    disparity, row, pixel, readout, delay = (offsets.get(name) or 0.0 for name in names)
    if delay:
        disparity = row = 0.0  # which it bends
        when = "after" if delay > 0.0 else "before"
        found.append(f"the trigger, right images are exposed {abs(delay):.2g} ms {when} left ones")
    if disparity > _DISPARITY_PX:
        found.append(
            f"the calibration, disparities are off by up to {disparity:.2g} px, pixels by "
            f"{pixel:.2g}: calibrate anew"
        )
    if row > _ROW_PX:
        found.append(
            f"the rectification, rows of the right image are off by up to {row:.2g} px: "
            "calibrate anew"
        )
    sigma = offsets.get("readout_sigma_ms") or 0.0
    if sigma and abs(readout) > max(_READOUT_MS, 3.0 * sigma):
        found.append(f"a rolling shutter, rows are read out over {readout:.2g} ms")
    part = ", and corrected in part" if abs(delay) > _DELAY_MS else " and corrected"
    return [f"{each} (learnt{part})" for each in found]
