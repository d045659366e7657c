"""What makes a run this run and no other: the recording, the configuration, the frame asked for."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import fields
from itertools import islice
from typing import Any, cast

import numpy as np

from gvo.config import Config
from gvo.errors import GvoError
from gvo.geometry.camera import Calibration
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import OutputFrame
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.trajectory.trajectory import Trajectory
from gvo.version import __version__

# In which the first images of both streams are looked for.
_N_FIRST = 20


def describe_run(
    source: Source,
    config: Config,
    frame: OutputFrame,
    excerpt: Excerpt | None,
    *,
    start: Trajectory | None = None,
) -> dict[str, Any]:
    """Return what an interrupted run must have in common with the one that goes on.

    Parameters
    ----------
    source : Source
        Of its images the first one of either stream is read.
    config : Config
    frame : OutputFrame
        Before the first frame.
    excerpt : Excerpt or None
    start : Trajectory, optional
        The true poses, where the run starts at one of them.

    Returns
    -------
    dict
        Plain values, for `find_difference`.
    """
    excerpt = excerpt or Excerpt()
    described = {
        "version of gvo": __version__,
        "recording": _describe_recording(source),
        "configuration": config.model_dump(mode="json"),
        "excerpt": {name: getattr(excerpt, name) for name in ("start_s", "duration_s", "every")},
        "output": {
            "frame": frame.name,
            "mount": _digest_of(frame.fixed_mount),
            "initial pose": _digest_of(frame.T_initial),
            "true start": "" if start is None else _digest_of(start.T_world_cam),
        },
    }
    # As a file gives it back.
    return cast("dict[str, Any]", json.loads(json.dumps(described)))


def find_difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Return the first thing in which two runs differ, in a few words; empty where in none."""
    for name, value in asked.items():
        other = there.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            if inner := find_difference(other, value):
                return f"{name}.{inner}" if name != "configuration" else inner
        elif value != other:
            return f"{name} was {_short(other)}, is {_short(value)}"
    return ""


def _describe_recording(source: Source) -> dict[str, Any]:
    info = source.info
    return {
        "sensor": info.sensor,
        "number of images": info.n_images,
        "frame_id": info.frame_id,
        "calibration": _digest(_calibration_parts(info)),
        "first images": dict(_first_images(source)),
    }


def _calibration_parts(info: RecordingInfo) -> Iterator[bytes]:
    view = info.depth_view
    calibrations = [*info.calibrations, *([] if view is None else [view.calibration])]
    for calibration in calibrations:
        for field in fields(Calibration):
            value = getattr(calibration, field.name)
            yield value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
    if view is not None:
        yield view.T_color_depth.tobytes()


def _first_images(source: Source) -> Iterator[tuple[str, str]]:
    """Yield the stream of the first image of each, its stamp and a digest of its pixels."""
    streams: set[int] = set()
    try:
        with closing(_as_generator(source)) as images:
            for image in islice(images, _N_FIRST):
                if image.stream not in streams:
                    streams.add(image.stream)
                    yield source.info.stream_names[image.stream], _describe_image(image)
                if len(streams) == 2:
                    return
    except GvoError:
        return  # whoever reads on is told


def _as_generator(source: Source) -> Any:  # noqa: ANN401 - what can be closed before its end
    yield from source.images()


def _describe_image(image: StampedImage) -> str:
    try:
        pixels = image.load()
    except GvoError:
        return f"{image.stamp_ns} faulty"
    parts = f"{pixels.dtype}{pixels.shape}".encode(), np.ascontiguousarray(pixels).tobytes()
    return f"{image.stamp_ns} {_digest(parts)}"


def _digest_of(array: np.ndarray[Any, Any] | None) -> str:
    return "" if array is None else _digest([np.ascontiguousarray(array).tobytes()])


def _digest(parts: Any) -> str:  # noqa: ANN401 - bytes, one after another
    digest = hashlib.blake2b(digest_size=8)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 50 else f"{text[:47]}..."
