"""Poses of a running camera sent to networks and viewers, and the state of its images."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Final

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.convert.bag_messages import Header
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.live.transport import NetworkWriter
from gvo.runs.outputs.bag import RunMessages
from gvo.runs.outputs.bag_messages import write_diagnostics
from gvo.runs.outputs.frames import RunFrames
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult, Optimum, Status

_EVERY_S: Final = 1.0
# Without images for so long a stream is said to have stopped.
SILENT_S: Final = 3.0
# Images and poses over which rates and latencies are computed.
_N_RECENT: Final = 50
# Pairs whose arrival is remembered until their pose is sent.
_N_WAITING: Final = 1000


class LiveMessages:
    """Sends the results of a run, in the world chosen by the last `set_pose`.

    Parameters
    ----------
    writers : sequence of NetworkWriter
    frames : RunFrames
    on_sent : callable
        Called with the stamp of a frame when its pose was sent.
    say : callable
        Gets a line of text when something cannot be sent.
    """

    def __init__(
        self,
        writers: Sequence[NetworkWriter],
        frames: RunFrames,
        on_sent: Callable[[int], None] = lambda _: None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._outputs = [RunMessages(writer, frames) for writer in writers]
        self._on_sent, self._say = on_sent, say
        self._T_set_world = np.eye(4)
        self._T_world_base = np.eye(4)

    def set_pose(self, T_world_base: FloatArray) -> None:
        """Move the world so that the newest pose becomes this one, shape (4, 4), metres.

        The paths begin anew. Poses in `odom` do not jump.
        """
        self._T_set_world = T_world_base @ se3.invert(self._T_world_base)
        for output in self._outputs:
            output.restart_paths()

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Send the result of a frame."""
        self._T_world_base = result.T_map_world @ result.causal.T_world_frame
        placed = self._placed_result(result)
        self._give(lambda output: output.add_frame(frame, placed))
        self._on_sent(frame.stamp_ns)

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Send the reason why a frame has no pose."""
        self._give(lambda output: output.add_faulty(frame))

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Send smoothed poses that will not change any more."""
        placed = self._placed(estimates)
        self._give(lambda output: output.add_smoothed(placed))

    def add_optimum(self, optimum: Optimum) -> None:
        """Send the global poses and the whole paths, at the end of a run."""
        placed = replace(optimum, estimates=self._placed(optimum.estimates))
        self._give(lambda output: output.add_optimum(placed))
        self._give(lambda output: output.write_paths())

    def _give(self, write: Callable[[RunMessages], None]) -> None:
        """Send to all networks; what cannot be sent does not silence what follows."""
        for output in self._outputs:
            try:
                write(output)
            except RecordingError as error:
                self._say(str(error))

    def _placed_result(self, result: FrameResult) -> FrameResult:
        T = self._T_set_world
        T_map_world = T @ result.T_map_world @ se3.invert(T)
        raw, causal, *rest = self._placed([result.raw, result.causal, *result.finished])
        return replace(
            result, raw=raw, causal=causal, finished=tuple(rest), T_map_world=T_map_world
        )

    def _placed(self, estimates: Iterable[Estimate]) -> tuple[Estimate, ...]:
        T = self._T_set_world
        return tuple(replace(each, T_world_frame=T @ each.T_world_frame) for each in estimates)


class Arrivals(AbstractContextManager["Arrivals"]):
    """Measures rates of images and latencies of poses, and says when images stop coming.

    Parameters
    ----------
    info : RecordingInfo
        Of the camera.
    topics : sequence of str
        Names of both image streams, for messages.
    writers : sequence of NetworkWriter
        Get the state each second, on `/diagnostics`.
    say : callable
        Gets a line of text when the state changes.
    n_dropped : callable
        Returns how many frames were dropped.

    Attributes
    ----------
    latencies_ms : deque of float
        Times from the second image of a pair to its pose, for the newest frames, milliseconds.
    """

    def __init__(
        self,
        info: RecordingInfo,
        topics: Sequence[str],
        writers: Sequence[NetworkWriter],
        say: Callable[[str], None],
        n_dropped: Callable[[], int] = lambda: 0,
    ) -> None:
        self._info, self._topics, self._writers, self._say = info, topics, writers, say
        self._n_dropped = n_dropped
        self._times_s: list[deque[float]] = [deque(maxlen=_N_RECENT) for _ in (0, 1)]
        self._waiting_s: deque[tuple[int, float]] = deque(maxlen=_N_WAITING)
        self._newest_ns = 0
        self._text = ""
        self.latencies_ms: deque[float] = deque(maxlen=_N_RECENT)
        self._started_s = time.monotonic()
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="arrivals", daemon=True)

    def __enter__(self) -> Arrivals:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop watching."""
        self._is_ended.set()
        self._thread.join()

    def watch(self, images: Iterable[StampedImage]) -> Iterator[StampedImage]:
        """Yield the images and note when each arrived."""
        for image in images:
            self._times_s[image.stream].append(time.monotonic())
            self._newest_ns = max(image.stamp_ns, 0)
            yield image

    def note_pair(self, stamp_ns: int) -> None:
        """Note that a pair is complete."""
        self._waiting_s.append((stamp_ns, time.monotonic()))

    def note_sent(self, stamp_ns: int) -> None:
        """Note that the pose of a pair was sent; earlier pairs were dropped."""
        while self._waiting_s:
            pair_ns, came_s = self._waiting_s.popleft()
            if pair_ns == stamp_ns:
                self.latencies_ms.append(1e3 * (time.monotonic() - came_s))
                return

    def state(self) -> str:
        """Return a line that says which images are missing; empty if both streams arrive."""
        now_s = time.monotonic()
        silent_s = [now_s - (times[-1] if times else self._started_s) for times in self._times_s]
        silent = int(silent_s[1] > silent_s[0])
        other = 1 - silent
        if silent_s[silent] <= SILENT_S:
            return ""
        names, lasting = self._info.stream_names, f"for {silent_s[silent]:.0f} s"
        if silent_s[other] > 0.5 * SILENT_S:
            return f"no images {lasting} on {self._topics[0]} and {self._topics[1]}"
        rate = _rate_hz(self._times_s[other])
        return (
            f"no {names[silent]} image {lasting} on {self._topics[silent]}; {names[other]} comes "
            f"at {rate:.3g} Hz"
        )

    def _work(self) -> None:
        while not self._is_ended.wait(_EVERY_S):
            text = self.state()
            sign = text.partition(" for ")[0]
            if sign != self._text:
                self._say(text or "images come")
            self._text = sign
            self._send(text)

    def _send(self, text: str) -> None:
        names = self._info.stream_names
        values: dict[str, object] = {
            f"{names[stream]} [Hz]": f"{_rate_hz(self._times_s[stream]):.3g}" for stream in (0, 1)
        }
        values["dropped"] = self._n_dropped()
        if self.latencies_ms:
            values["latency [ms]"] = f"{float(np.median([*self.latencies_ms])):.1f}"
        header = Header(self._newest_ns, self._info.frame_id)
        status = Status.LOST if text else Status.OK
        for writer in self._writers:
            try:
                write_diagnostics(writer, header, status, text or "images come", values, of="input")
            except RecordingError as error:
                self._say(str(error))


def _rate_hz(times_s: deque[float]) -> float:
    recent = [*times_s]
    return 0.0 if len(recent) < 2 else (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)
