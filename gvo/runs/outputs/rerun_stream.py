"""An open Rerun file."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Thread
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

_N_BYTES: Final = 2**20


class FilePipe:
    """A pipe into a file that never fails: what does not fit on the disk is dropped.

    rerun's writer may wait for ever where a write fails, as on a full disk.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    OSError
        When it cannot be made.

    Attributes
    ----------
    error : OSError or None
        Why the file could not be written, once it could not.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._file = path.open("wb", buffering=0)
        self._reader, self._writer = os.pipe()
        self._thread = Thread(target=self._copy, name="gvo-file-pipe", daemon=True)
        self._thread.start()

    @property
    def entrance(self) -> Path:
        """The path to open for writing, once."""
        return Path(f"/dev/fd/{self._writer}")

    def leave(self) -> None:
        """Close this end: the file ends when the writer closes its own."""
        os.close(self._writer)

    def join(self) -> None:
        """Wait for the end of the file."""
        self._thread.join()

    def _copy(self) -> None:
        with self._file, os.fdopen(self._reader, "rb", buffering=0) as pipe:
            while data := pipe.read(_N_BYTES):
                self._keep(data)

    def _keep(self, data: bytes) -> None:
        if self.error is not None:
            return
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self.error = error


CLOUD: Final = "world/cloud"
LOOPS: Final = "world/loops"
OVERLAY: Final = "overlay"
COUNTS: Final = "counts"
MILLISECONDS: Final = "milliseconds"
CHI2: Final = "chi2"
STATUS: Final = "status"
CONFIGURATION: Final = "configuration"

STAMP: Final = "stamp"
FRAME: Final = "frame"


def make_layout() -> rrb.Blueprint:
    """Return the scene, and beside it the overlay, the numbers and the log."""
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin=OVERLAY, name="Matches"),
        rrb.TextDocumentView(origin=CONFIGURATION, name="Configuration"),
    )
    beside = rrb.Vertical(
        pictures,
        rrb.TimeSeriesView(origin=COUNTS, name="Counts"),
        rrb.Tabs(
            rrb.TimeSeriesView(origin=MILLISECONDS, name="Milliseconds"),
            rrb.TimeSeriesView(origin=CHI2, name="Chi-square of the edges"),
        ),
        rrb.TextLogView(origin=STATUS, name="Status"),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(_scene(), beside, column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene() -> rrb.Spatial3DView:
    """Return the view of the world; points of keyframes and loops are those that came so far."""
    so_far = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (STAMP, FRAME)
        ]
    )
    return rrb.Spatial3DView(origin="world", name="Scene", overrides={CLOUD: so_far, LOOPS: so_far})


APPLICATION: Final = "gvo"
EARLIEST_DATE_NS: Final = 946_684_800 * 10**9
"""1 January 2000: stamps before that are no dates but durations since a start."""

_N_BATCHED_BYTES: Final = 2**23
_TICK_S: Final = 3600.0


class RerunStream:
    """Archetypes at the stamps of frames, on the timelines `stamp` and `frame`.

    Nothing is written by the clock: what belongs together is cut into chunks by `flush` alone,
    or where it grows large.

    Parameters
    ----------
    path : Path
        Must end in `.rrd`.
    name : str
        Of the recording in the viewer.

    Raises
    ------
    OSError, RuntimeError
        When the file cannot be made.

    Attributes
    ----------
    is_enabled : bool
        False where the environment variable RERUN switches rerun off.
    """

    def __init__(self, path: Path, name: str) -> None:
        batches = rr.ChunkBatcherConfig(flush_tick=_TICK_S, flush_num_bytes=_N_BATCHED_BYTES)
        self._recording = rr.RecordingStream(
            APPLICATION, send_properties=False, batcher_config=batches
        )
        self._is_dated: bool | None = None
        self.is_enabled = rr.is_enabled(self._recording)
        if not self.is_enabled:
            return
        self._recording.set_log_time_enabled(False)
        self._pipe = FilePipe(path)
        try:
            self._recording.save(self._pipe.entrance, default_blueprint=make_layout())
        finally:
            self._pipe.leave()
        self._recording.send_recording_name(name)

    def set_frame(self, stamp_ns: int, index: int) -> None:
        """Set the frame of what is logged next.

        The first stamp decides whether the timeline shows dates or durations.

        Parameters
        ----------
        stamp_ns : int
            Nanoseconds.
        index : int
            Of the frame, from 0.
        """
        if self._is_dated is None:
            self._is_dated = stamp_ns >= EARLIEST_DATE_NS
        self._recording.set_time(FRAME, sequence=index)
        if self._is_dated:
            self._recording.set_time(STAMP, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._recording.set_time(STAMP, duration=np.timedelta64(stamp_ns, "ns"))

    def log(self, path: str, *archetypes: rr.AsComponents, is_static: bool = False) -> None:
        """Log to an entity, at the frame that was set or for all frames."""
        self._recording.log(path, *archetypes, static=is_static, strict=True)

    def flush(self) -> None:
        """Flush what was logged, so that it is not held in memory.

        Raises
        ------
        OSError
            When some of what was handed over before could not be written.
        """
        self._recording.flush()
        self._check()

    def close(self) -> None:
        """Finish the file.

        Raises
        ------
        OSError
            When it could not be written.
        """
        self._recording.flush()
        self._recording.disconnect()
        self._pipe.join()
        self._check()

    def _check(self) -> None:
        if self._pipe.error is not None:
            raise self._pipe.error
