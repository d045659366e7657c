"""A rolling shutter, as odometry learns it where the camera moves fastest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, takewhile

import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.sampling import Sample, Survey
from gvo.errors import GvoError
from gvo.frontend.klt import image_of
from gvo.frontend.tracking import detect_corners, track_pixels
from gvo.io.frames import frames
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.odometry.odometry import Odometry
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame, FloatArray, Frame

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
        text=f"readout {found_ms:.1f} ms, sigma {sigma_ms:.1f}",
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
    images, klt = (image_of(first), image_of(second)), config.klt
    corners = detect_corners(images[0], klt)
    ends, is_tracked = track_pixels(
        images, corners, corners, klt, n_levels=klt.n_wide_levels, is_checked=True
    )
    lengths = np.linalg.norm(ends - corners, axis=1)[is_tracked]
    return float(np.median(lengths)) if len(lengths) >= config.ransac.min_inliers else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Parts:
    """Some parts of a recording, as a recording."""

    source: Source
    parts: Sequence[tuple[int, int]]

    @property
    def info(self) -> RecordingInfo:
        return self.source.info

    def images(self) -> Iterator[StampedImage]:
        last_ns = self.parts[-1][1] + _DELAY_NS
        for image in takewhile(lambda image: image.stamp_ns < last_ns, self.source.images()):
            if self.part_of(image.stamp_ns) is not None:
                yield image

    def part_of(self, stamp_ns: int) -> int | None:
        within = [n for n, (start, end) in enumerate(self.parts) if start <= stamp_ns <= end]
        return within[0] if within else None

    def ground_truth(self) -> Trajectory | None:
        return None


def _read(
    source: Source, parts: Sequence[tuple[int, int]], config: Config
) -> Iterator[Iterator[Frame]]:
    """Yield the frames of each part."""
    if parts:
        chosen = _Parts(source=source, parts=parts)
        usable = _usable(chosen, config)
        for _, part in groupby(usable, key=lambda frame: chosen.part_of(frame.stamp_ns)):
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
