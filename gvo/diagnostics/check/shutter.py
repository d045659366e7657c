"""When pixels are exposed, by what odometry learns: a rolling shutter, and a right image late."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.sampling import Sample, Survey
from gvo.errors import GvoError
from gvo.frontend.klt import image_of
from gvo.frontend.tracking import N_WIDE_LEVELS, detect_corners, track_pixels
from gvo.geometry.rig import DELAY, READOUT
from gvo.io.frames import frames
from gvo.io.recording import ChosenImages, Source, StampedImage
from gvo.odometry.odometry import Odometry
from gvo.types import Edge, FaultyFrame, Frame, FrameResult

# The parts that are looked at, and frames in each.
_N_PARTS = 3
_N_FRAMES = 30
# Images of a stream may come so much later than those of the other.
_DELAY_NS = 1_000_000_000
# A time of a larger sigma is not told.
_MAX_SIGMA_MS = 4.0
# A time is not as it should be if it differs by more sigmas, and milliseconds, than these.
_N_SIGMAS = 3.0
_MIN_DIFFERENCE_MS = 2.0
# Lower than in a run: more links measure the readout better, even if poses gain little by them.
_LINK_GAIN = 0.5


class Looked(NamedTuple):
    """What odometry over parts of a recording tells.

    Parameters
    ----------
    constants : list of mapping
        What was learnt of the camera in each part, with sigmas.
    steps : list of (int, Edge)
        From frame to frame, with the stamps that they lead to.
    """

    constants: list[Mapping[str, tuple[float, float]]]
    steps: list[tuple[int, Edge]]


def look_closely(source: Source, found: Survey, config: Config) -> Looked:
    """Run odometry over three parts of 30 frames, around the samples that move most."""
    parts = _choose_parts(found, config)
    return _learn(source, parts, config) if parts else Looked([], [])


def check_shutter(looked: Looked, config: Config) -> Iterator[Finding]:
    """Yield the readout time of the camera and the delay of right images, those that are told."""
    delay, readout = _mean_ms(looked.constants, DELAY), _mean_ms(looked.constants, READOUT)
    if delay is not None:
        limit_ms = max(_N_SIGMAS * delay[1], _MIN_DIFFERENCE_MS)
        is_late = abs(delay[0]) > limit_ms
        yield Finding(
            name="left/right: trigger",
            value=delay[0],
            unit="ms",
            text=f"right images {delay[0]:+z.1f} ms later, sigma {delay[1]:.1f}",
            threshold=f"+/- {limit_ms:.1f} ms",
            verdict="warning" if is_late else "ok",
            fix="trigger both at once: odometry corrects most of it, not all" if is_late else "",
        )
    if readout is not None:
        limit_ms = max(_N_SIGMAS * readout[1], _MIN_DIFFERENCE_MS)
        given_ms = config.camera.readout_ms
        is_wrong = given_ms is not None and abs(readout[0] - given_ms) > limit_ms
        yield Finding(
            name="rolling shutter",
            value=readout[0],
            unit="ms",
            text=f"readout {readout[0]:z.1f} ms, sigma {readout[1]:.1f}",
            threshold="" if given_ms is None else f"{given_ms:g} +/- {limit_ms:.1f} ms",
            verdict="warning" if is_wrong else "info" if given_ms is None else "ok",
            fix="--set camera.readout_ms=null learns it" if is_wrong else "",
        )


def _mean_ms(
    learnt: Sequence[Mapping[str, tuple[float, float]]], name: str
) -> tuple[float, float] | None:
    """Return what parts learnt of a time, and its sigma, milliseconds; None: too little."""
    told = [constants[name] for constants in learnt if name in constants]
    if not told:
        return None
    values_ms, sigmas_ms = 1e3 * np.transpose(told)
    weights = sigmas_ms**-2.0
    mean_ms = float(np.average(values_ms, weights=weights))
    # The sigma of the mean is not below what the scatter of the parts says.
    chi2 = float(np.sum(weights * (values_ms - mean_ms) ** 2)) / max(len(told) - 1, 1)
    sigma_ms = math.sqrt(max(chi2, 1.0) / weights.sum())
    return (mean_ms, sigma_ms) if sigma_ms <= _MAX_SIGMA_MS else None


def _choose_parts(found: Survey, config: Config) -> list[tuple[int, int]]:
    """Return when parts begin and end, nanoseconds, in order and apart."""
    stamps_ns = np.unique(found.stamps_ns[0])
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
    corners = detect_corners(images[0], config.klt.n_corners, mask=first.mask)
    ends, is_found = track_pixels(images, corners, corners, n_levels=N_WIDE_LEVELS, is_checked=True)
    lengths = np.linalg.norm(ends - corners, axis=1)[is_found]
    return float(np.median(lengths)) if len(lengths) >= config.ransac.min_inliers else 0.0


def _learn(source: Source, parts: Sequence[tuple[int, int]], config: Config) -> Looked:
    unknown = config.camera.model_copy(update={"readout_ms": None})
    config = config.model_copy(update={"camera": unknown})
    runs = [Odometry(source.info.camera, config) for _ in parts]
    steps: list[tuple[int, Edge]] = []
    last_ns: dict[int, int] = {}
    for run in runs:
        run.link_gain = _LINK_GAIN
    chosen = ChosenImages(info=source.info, images=partial(_images_of, source, parts))
    for frame in _usable(chosen, config):
        part = _part_of(frame.stamp_ns, parts)
        if part is not None:
            step = _step(runs[part].track(frame), last_ns.get(part))
            last_ns[part] = frame.stamp_ns
            steps += [] if step is None else [(frame.stamp_ns, step)]
    offsets = [run.rig_offsets for run in runs]
    constants = [each.learnt.constants for each in offsets if each is not None and each.learnt]
    return Looked(constants, steps)


def _step(result: FrameResult, last_ns: int | None) -> Edge | None:
    """Return how a frame that was registered moved since the one before."""
    T, found = result.T_previous_frame, result.registration
    if T is None or found is None or last_ns is None:
        return None
    return Edge(reference_id=last_ns, T_reference_frame=T, covariance=found.covariance)


def _part_of(stamp_ns: int, parts: Sequence[tuple[int, int]]) -> int | None:
    return next((n for n, (start, end) in enumerate(parts) if start <= stamp_ns <= end), None)


def _images_of(source: Source, parts: Sequence[tuple[int, int]]) -> Iterator[StampedImage]:
    """Yield the images of some parts of a recording."""
    last_ns = parts[-1][1] + _DELAY_NS
    for image in takewhile(lambda image: image.stamp_ns < last_ns, source.images()):
        if _part_of(image.stamp_ns, parts) is not None:
            yield image


def _usable(source: Source, config: Config) -> Iterator[Frame]:
    """Yield frames up to where a recording is damaged, which is a finding of its own."""
    try:
        for frame in frames(source, config, with_unpaired=False):
            if not isinstance(frame, FaultyFrame):
                yield frame
    except GvoError:
        return
