"""One pass over a recording: all stamps, and a sample of frames with their successors."""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from gvo.config import Config
from gvo.errors import GvoError
from gvo.io.frames import frames, paired
from gvo.io.recording import ChosenImages, Source, StampedImage
from gvo.io.sync import Pair
from gvo.types import FaultyFrame, Frame, IntArray

# If no images are close enough in time for odometry, images within this limit are looked at.
_WIDE_LIMIT_MS = 200.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A frame and the one after it, None at the end; their stamps play no role.

    `stamp_ns` is that of the first in the recording.
    """

    first: Frame | FaultyFrame
    second: Frame | FaultyFrame | None
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """Result of a pass over a recording.

    Parameters
    ----------
    stamps_ns : tuple of two ndarray of int64, shape (n,)
        Of both streams, in the order of the recording.
    log_times_ns : tuple of two ndarray of int64, shape (n,)
        When these images were recorded; empty if the recording has no clock.
    n_pairs : int
        Number of frames that odometry gets.
    samples : tuple of Sample
        Spread over the recording.
    damage : str
        Why the recording could not be read to its end; empty if it could.
    """

    stamps_ns: tuple[IntArray, IntArray]
    log_times_ns: tuple[IntArray, IntArray]
    n_pairs: int
    samples: tuple[Sample, ...]
    damage: str


def survey(source: Source, config: Config, *, n_samples: int) -> Survey:
    """Read all stamps of a recording, and decode a sample of its frames as for odometry."""
    found = _Pass(source, config, n_samples)
    n_pairs = found.n_pairs
    if n_pairs == 0 and all(found.stamps_ns):
        found = _Pass(source, config, n_samples, limit_ms=_WIDE_LIMIT_MS)
    first, second = (np.array(each, dtype=np.int64) for each in found.stamps_ns)
    first_log, second_log = (np.array(each, dtype=np.int64) for each in found.log_times_ns)
    return Survey(
        stamps_ns=(first, second),
        log_times_ns=(first_log, second_log),
        n_pairs=n_pairs,
        samples=tuple(_load(source, config, found.chosen)),
        damage=found.damage,
    )


class _Pass:
    """What is found in one pass over the images of a recording."""

    def __init__(
        self, source: Source, config: Config, n_samples: int, *, limit_ms: float | None = None
    ) -> None:
        self.stamps_ns = array("q"), array("q")
        self.log_times_ns = array("q"), array("q")
        self.chosen: list[list[Pair]] = []
        self.n_pairs, self.damage = 0, ""
        last = max(source.info.n_images - 2, 0)
        due = deque(sorted({round(index) for index in np.linspace(0, last, n_samples).tolist()}))
        is_successor = False
        pairs = paired(self._noted(source), source.info.sensor, config.sync, limit_ms=limit_ms)
        try:
            for index, pair in enumerate(pairs):
                if isinstance(pair, FaultyFrame):
                    is_successor = False
                    continue
                self.n_pairs += 1
                if is_successor:
                    self.chosen[-1].append(pair)
                is_successor = bool(due) and index >= due[0]
                if is_successor:
                    self.chosen.append([pair])
                while due and index >= due[0]:
                    due.popleft()
        except GvoError as error:
            self.damage = str(error)

    def _noted(self, source: Source) -> Iterator[StampedImage]:
        for image in source.images():
            self.stamps_ns[image.stream].append(image.stamp_ns)
            if image.log_time_ns is not None:
                self.log_times_ns[image.stream].append(image.log_time_ns)
            yield image


def _images_of(chosen: list[list[Pair]]) -> Iterator[StampedImage]:
    for index, pair in enumerate(chain.from_iterable(chosen)):
        # With stamps a second apart, the pairs stay as they are.
        yield from (replace(image, stamp_ns=index * 1_000_000_000) for image in pair)


def _load(source: Source, config: Config, chosen: list[list[Pair]]) -> Iterator[Sample]:
    # The check for frozen images needs images that repeat the one before.
    sync = config.sync.model_copy(update={"repeated_images": "keep"})
    config = config.model_copy(update={"sync": sync})
    # As a recording, so that they become frames as all others.
    images = ChosenImages(info=source.info, images=partial(_images_of, chosen))
    loaded = frames(images, config)
    for run in chosen:
        first = next(loaded)
        second = next(loaded) if len(run) > 1 else None
        yield Sample(first=first, second=second, stamp_ns=run[0][0].stamp_ns)
