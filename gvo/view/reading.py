"""Frames of a recording from any of them on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from gvo.config import Config
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, paired
from gvo.io.recording import Source
from gvo.types import FaultyFrame, Frame

_SECTIONS = ("sync", "images", "runtime")


def is_read_differently(former: Config, config: Config) -> bool:
    """Tell whether a recording must be opened again for another configuration to matter."""
    return former.depth.scale != config.depth.scale or any(
        getattr(former, name) != getattr(config, name) for name in _SECTIONS
    )


def read_frames(
    source: Source, config: Config, excerpt: Excerpt, *, from_ns: int | None = None
) -> Iterator[Frame | FaultyFrame]:
    """Read the frames of a recording that a run counts.

    Parameters
    ----------
    source : Source
    config : Config
    excerpt : Excerpt
        The part that is wanted.
    from_ns : int, optional
        Stamp of the frame of it to start with; the others are found, but not decoded.

    Yields
    ------
    StereoFrame, RgbdFrame or FaultyFrame
        Colour images without depth, and the reverse, are left out: those of a free-running
        sensor need not pair.

    Raises
    ------
    RecordingError
        When the recording cannot be read on.
    """
    if from_ns is not None:
        excerpt = _excerpt_from(from_ns, source, config, excerpt)
    is_stereo = source.info.sensor == "stereo"
    for item in frames(source, config, excerpt):
        if is_stereo or not isinstance(item, FaultyFrame) or not item.is_unpaired:
            yield item


def _excerpt_from(from_ns: int, source: Source, config: Config, excerpt: Excerpt) -> Excerpt:
    """Return what is left of an excerpt from a frame of it on."""
    first = next(paired(source.images(), source.info.sensor, config.sync))
    first_ns = first.stamp_ns if isinstance(first, FaultyFrame) else first[0].stamp_ns
    start_s = max(1e-9 * (from_ns - first_ns), 0.0)
    duration_s = None
    if excerpt.duration_s is not None:
        duration_s = max(excerpt.start_s + excerpt.duration_s - start_s, 1e-9)
    return replace(excerpt, start_s=start_s, duration_s=duration_s)
