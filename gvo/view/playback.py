"""Play, pause, step, seek, speed: the same for a recording and for a finished run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

import viser

SPEEDS: dict[str, float | None] = {
    "0.25 x": 0.25,
    "0.5 x": 0.5,
    "1 x": 1.0,
    "2 x": 2.0,
    "4 x": 4.0,
    "fastest": None,
}

_IDLE_S = 0.25


class Playable(Protocol):
    """What can be played."""

    @property
    def n_frames(self) -> int:
        """Number of frames."""

    @property
    def is_playing(self) -> bool:
        """Whether frames follow by themselves."""

    def play(self) -> None:
        """Go on."""

    def pause(self) -> None:
        """Stay."""

    def step(self) -> None:
        """Go to the next frame."""

    def seek(self, index: int) -> None:
        """Go to a frame."""

    def set_speed(self, factor: float | None) -> None:
        """Play as recorded (1), faster, slower, or as fast as it goes (None)."""


class Playback:
    """The controls of what can be played.

    Parameters
    ----------
    gui : viser.GuiApi
        Where they are added.
    playable : Playable
    before : callable
        Called before anything is started, so that changes made until then hold.
    """

    def __init__(
        self, gui: viser.GuiApi, playable: Playable, *, before: Callable[[], None]
    ) -> None:
        self._playable = playable
        self._before = before
        buttons = gui.add_button_group("recording", ("play", "pause", "step"))
        last = max(1, playable.n_frames - 1)
        self.frame: Any = gui.add_slider("frame", 0, last, 1, 0, hint="Frame that is shown")
        self.speed: Any = gui.add_dropdown(
            "speed", tuple(SPEEDS), initial_value="1 x", hint="1 x: as fast as it was recorded"
        )
        buttons.on_click(self._on_click)
        self.frame.on_update(self.on_seek)
        self.speed.on_update(self.on_speed)
        gui.add_command("play or pause", hotkey="P").on_trigger(lambda _: self.toggle())
        gui.add_command("step", hotkey="N").on_trigger(lambda _: self.press("step"))

    def press(self, name: str) -> None:
        """Do what a button does: play, pause or step."""
        self._before()
        actions = {
            "play": self._playable.play,
            "pause": self._playable.pause,
            "step": self._playable.step,
        }
        actions[name]()

    def toggle(self) -> None:
        """Play, or pause where it plays."""
        self.press("pause" if self._playable.is_playing else "play")

    def show(self, index: int) -> None:
        """Show which frame is shown."""
        last = max(1, self._playable.n_frames - 1, index)
        if self.frame.max != last:
            self.frame.max = last
        self.frame.value = max(0, index)

    def _on_click(self, event: viser.GuiEvent[Any]) -> None:
        self.press(event.target.value)

    def on_seek(self, event: viser.GuiEvent[Any]) -> None:
        """Go where a client moved the slider."""
        if event.client_id is not None:  # not the program's own change
            self._before()
            self._playable.seek(int(self.frame.value))

    def on_speed(self, event: viser.GuiEvent[Any]) -> None:
        """Play as fast as a client chose."""
        if event.client_id is not None:
            self._playable.set_speed(SPEEDS[self.speed.value])


class Painter:
    """Draws the newest of what is offered, in a thread of its own, at a limited rate.

    Parameters
    ----------
    draw : callable
        Is called without arguments; looks up itself what there is to draw.
    rate_hz : float
        At most so often.
    idle : callable, optional
        Is called now and then while there is nothing to draw.
    """

    def __init__(
        self, draw: Callable[[], None], *, rate_hz: float, idle: Callable[[], None] | None = None
    ) -> None:
        self._draw = draw
        self._period_s = 1.0 / rate_hz
        self._idle = idle
        self._state = threading.Condition()
        self._n_offered = self._n_drawn = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="gvo view", daemon=True)
        self._thread.start()

    def offer(self) -> None:
        """Tell that there is something new."""
        with self._state:
            self._n_offered += 1
            self._state.notify_all()

    def settle(self) -> None:
        """Wait until what was offered last is drawn."""
        with self._state:
            wanted = self._n_offered
            self._state.wait_for(lambda: self._n_drawn >= wanted or self._is_closed)

    def close(self) -> None:
        """End the thread; what was offered last may stay undrawn."""
        with self._state:
            self._is_closed = True
            self._state.notify_all()
        self._thread.join()

    def _is_due(self) -> bool:
        return self._is_closed or self._n_offered > self._n_drawn

    def _run(self) -> None:
        try:
            self._draw_until_closed()
        finally:  # also where drawing failed: nobody may wait for it any longer
            with self._state:
                self._is_closed = True
                self._state.notify_all()

    def _draw_until_closed(self) -> None:
        while True:
            with self._state:
                self._state.wait_for(self._is_due, timeout=None if self._idle is None else _IDLE_S)
                if self._is_closed:
                    return
                is_new, wanted = self._is_due(), self._n_offered
            if not is_new and self._idle is not None:
                self._idle()
                continue
            start = time.monotonic()
            self._draw()
            with self._state:
                self._n_drawn = wanted
                self._state.notify_all()
                rest_s = self._period_s - (time.monotonic() - start)
                self._state.wait_for(lambda: self._is_closed, timeout=max(0.0, rest_s))
