"""One pass over a recording: all stamps, and a sample of frames with their successors."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from gvo.config import Config, SyncConfig
from gvo.errors import GvoError
from gvo.io.frames import frames, paired
from gvo.io.recording import ChosenImages, RecordingInfo, Source, StampedImage
from gvo.io.sync import Pair
from gvo.types import FaultyFrame, Frame, IntArray

# For images to look at, if none are close enough in time for odometry.
_WIDE_LIMIT_MS = 200.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamStamps:
    """The stamps of one stream, in the order of the recording.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Stamps of the headers.
    log_times_ns : ndarray of int64, shape (m,)
        Times of recording, for the images that have both; empty if the recording has no clock.
    headers_ns : ndarray of int64, shape (m,)
        Stamps of the headers of these images.
    """

    stamps_ns: IntArray
    log_times_ns: IntArray
    headers_ns: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A frame and the one after it.

    Parameters
    ----------
    first, second : StereoFrame, RgbdFrame or FaultyFrame
        `second` is None at the end of the recording. Their stamps play no role.
    stamp_ns : int
        Of the first in the recording, nanoseconds.
    """

    first: Frame | FaultyFrame
    second: Frame | FaultyFrame | None
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """Result of a pass over a recording.

    Parameters
    ----------
    streams : tuple of two StreamStamps
    n_pairs : int
        Number of frames that odometry gets.
    samples : tuple of Sample
        Spread over the recording.
    damage : str
        Why the recording could not be read to its end; empty if it could.
    """

    streams: tuple[StreamStamps, StreamStamps]
    n_pairs: int
    samples: tuple[Sample, ...]
    damage: str


def survey(source: Source, config: Config, *, n_samples: int) -> Survey:
    """Read all stamps of a recording, and decode a sample of its frames as for odometry."""
    pass_ = _Pass(source, config.sync, n_samples)
    pass_.run()
    n_pairs = pass_.n_pairs
    if n_pairs == 0 and all(len(stamps) for stamps in pass_.stamps):
        pass_ = _Pass(source, config.sync, n_samples)
        pass_.run(_WIDE_LIMIT_MS)
    streams = pass_.stream(0), pass_.stream(1)
    samples = _load(source.info, config, pass_.chosen)
    return Survey(streams=streams, n_pairs=n_pairs, samples=samples, damage=pass_.damage)


class _Pass:
    """Goes once over the images of a recording."""

    def __init__(self, source: Source, sync: SyncConfig, n_samples: int) -> None:
        self._source, self._sync = source, sync
        last = max(source.info.n_images - 2, 0)
        self._due = sorted({round(index) for index in np.linspace(0, last, n_samples).tolist()})
        self.stamps = (array("q"), array("q"))
        self._logs = (array("q"), array("q"))
        self._headers = (array("q"), array("q"))
        self.n_pairs = 0
        self.damage = ""
        self.chosen: list[list[Pair]] = []

    def run(self, limit_ms: float | None = None) -> None:
        due = iter(self._due)
        next_due = next(due, None)
        is_successor = False
        pairs = paired(self._noted(), self._source.info.sensor, self._sync, limit_ms=limit_ms)
        for index, item in enumerate(self._until_damage(pairs)):
            if isinstance(item, FaultyFrame):
                is_successor = False
                continue
            self.n_pairs += 1
            if is_successor:
                self.chosen[-1].append(item)
            is_successor = next_due is not None and index >= next_due
            if is_successor:
                self.chosen.append([item])
                while next_due is not None and index >= next_due:
                    next_due = next(due, None)

    def stream(self, number: int) -> StreamStamps:
        """Return the stamps of one stream."""
        return StreamStamps(
            stamps_ns=np.array(self.stamps[number], dtype=np.int64),
            log_times_ns=np.array(self._logs[number], dtype=np.int64),
            headers_ns=np.array(self._headers[number], dtype=np.int64),
        )

    def _noted(self) -> Iterator[StampedImage]:
        for image in self._source.images():
            self.stamps[image.stream].append(image.stamp_ns)
            if image.log_time_ns is not None:
                self._logs[image.stream].append(image.log_time_ns)
                self._headers[image.stream].append(image.stamp_ns)
            yield image

    def _until_damage(self, pairs: Iterable[Pair | FaultyFrame]) -> Iterator[Pair | FaultyFrame]:
        try:
            yield from pairs
        except GvoError as error:
            self.damage = str(error)


def _images_of(chosen: list[list[Pair]]) -> Iterator[StampedImage]:
    for index, pair in enumerate(chain.from_iterable(chosen)):
        # With stamps a second apart, the pairs stay as they are.
        yield from (replace(image, stamp_ns=index * 1_000_000_000) for image in pair)


def _load(info: RecordingInfo, config: Config, chosen: list[list[Pair]]) -> tuple[Sample, ...]:
    # Frozen images are found by a check of their own, which needs them.
    sync = config.sync.model_copy(update={"repeated_images": "keep"})
    config = config.model_copy(update={"sync": sync})
    # As a recording, so that they become frames as all others.
    loaded = frames(ChosenImages(info=info, images=partial(_images_of, chosen)), config)
    return tuple(
        Sample(
            first=next(loaded),
            second=next(loaded) if len(run) > 1 else None,
            stamp_ns=run[0][0].stamp_ns,
        )
        for run in chosen
    )
