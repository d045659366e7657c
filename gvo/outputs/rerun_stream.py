"""A file of the Rerun viewer, open for writing.

`rerun` is imported with this module: import it where a file is written, no earlier. Nothing here
touches rerun's global state, starts a viewer or opens a connection.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from gvo.outputs.rerun_layout import FRAME, STAMP, make_layout
from gvo.outputs.rerun_pipe import FilePipe

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
        """Say which frame what is logged next belongs to.

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
        """Hand over what was logged, so that it need not be held in memory.

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
