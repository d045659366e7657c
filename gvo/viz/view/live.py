"""A run that goes on elsewhere, shown as it goes: the newest frame wins."""

from __future__ import annotations

import time
from collections.abc import Callable

from gvo.backend.window import SlidingWindow
from gvo.config import Config, Parameters, values_by_name
from gvo.io.recording import Source
from gvo.types import FaultyFrame, Frame, FrameResult
from gvo.viz.view.newest import Newest

# Of the time that tracking leaves, the page draws so much; of all time at least so much, and it
# rests no longer than would look dead.
_SHARE, _LEAST_SHARE = 0.5, 0.02
_LONGEST_REST_S = 3.0


class LivePlayer:
    """What a page shows of a run, and what it changes.

    The thread of the run calls `begin` and `add`, which only note; pictures are drawn in the
    thread of the page, and not at all where nobody looks.

    Parameters
    ----------
    source : Source
        The camera.
    parameters : Parameters

    Attributes
    ----------
    newest : Newest
        Of the present run.
    is_playing : bool
        Whether the page shows the frames that come.
    is_watched : callable
        Whether anybody looks at the page.
    waited_s : callable
        How long tracking has waited for frames so far, seconds.
    """

    fault = ""
    is_busy = is_finished = False

    def __init__(self, source: Source, parameters: Parameters) -> None:
        self.source, self.parameters = source, parameters
        self.newest = Newest(source.info.camera)
        self.is_watched: Callable[[], bool] = lambda: True
        self.waited_s: Callable[[], float] = time.monotonic
        self._asked_s = self._had_waited_s = 0.0
        self.is_playing = True
        self._window: SlidingWindow | None = None

    def begin(self, window: SlidingWindow) -> None:
        """Forget what was shown: a new run begins, with its own window."""
        self.newest = Newest(self.source.info.camera, self.newest.n_done)
        self._window = window

    def add(self, frame: Frame | FaultyFrame, result: FrameResult | None) -> None:
        """Note a frame, and what it gave: poses of the camera; None of a faulty frame."""
        is_shown = self.is_playing and self.is_watched()
        self.newest.add(frame, result, self._window if is_shown else None, self.config.depth)

    def rest_s(self, spent_s: float) -> float:
        """Return how long the page shall rest after drawing for `spent_s`.

        It takes half of the time that tracking has waited for frames since the last call.
        """
        now_s, waited_s = time.monotonic(), self.waited_s()
        elapsed_s, idle_s = now_s - self._asked_s, waited_s - self._had_waited_s
        self._asked_s, self._had_waited_s = now_s, waited_s
        share = min(max(_SHARE * idle_s / elapsed_s, _LEAST_SHARE), _SHARE)
        return min(spent_s / share - spent_s, _LONGEST_REST_S)

    @property
    def n_frames(self) -> int:
        """Frames that came so far."""
        return self.newest.n_done

    def play(self) -> None:
        """Show the newest frames as they come."""
        self.is_playing = True

    def pause(self) -> None:
        """Stay at the frame that is shown; the run goes on."""
        self.is_playing = False

    @property
    def config(self) -> Config:
        """Of the next frame."""
        return self.parameters.config

    def reconfigure(self, config: Config) -> None:
        """Change what differs from the present configuration, or raise `ConfigurationError`."""
        now, wanted = values_by_name(self.config), values_by_name(config)
        self.parameters.set({name: value for name, value in wanted.items() if value != now[name]})
