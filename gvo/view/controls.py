"""The controls of the parameters: they change the configuration of the next frame."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import viser

from gvo.config import Config
from gvo.errors import ConfigurationError
from gvo.view.parameters import (
    Parameter,
    Value,
    configuration_of,
    list_parameters,
    section_meaning,
    values_of,
)

DELAY_S = 0.4
"""A value is taken so long after the last change: a number is typed digit by digit."""
PATIENCE_S = 2.0
"""How long a value that was refused may be mended before the one that holds is shown again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Control:
    """The handles of one parameter; `empty` is the check box of null."""

    parameter: Parameter
    handle: Any
    empty: Any = None

    @property
    def value(self) -> Value:
        """What the page shows."""
        if self.empty is not None and self.empty.value:
            return None
        value = self.handle.value
        return int(value) if self.parameter.kind == "integer" else value

    def show(self, value: Value) -> None:
        """Show a value."""
        if self.empty is not None:
            self.empty.value = value is None
            self.handle.disabled = value is None
        if value is not None:
            self.handle.value = value


class ParameterControls:
    """A control for every parameter, in folders by section.

    Parameters
    ----------
    gui : viser.GuiApi
        Where they are added.
    config : Config
        Shown at first.
    apply : callable
        Is given each new configuration; raises `ConfigurationError` to refuse it.
    say : callable
        Is given one line on what was refused; an empty one where all is well again.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        config: Config,
        *,
        apply: Callable[[Config], None],
        say: Callable[[str], None],
    ) -> None:
        self._config = config
        self._apply = apply
        self._say = say
        self._refusal = ""
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._is_closed = False
        self._controls: dict[tuple[str, str], _Control] = {}
        values = values_of(config)
        for section, parameters in list_parameters().items():
            with gui.add_folder(section, expand_by_default=False):
                gui.add_markdown(f"*{section_meaning(section)}*")
                for parameter in parameters:
                    control = _add(gui, parameter, values[section][parameter.key])
                    self._controls[section, parameter.key] = control
        for control in self._controls.values():
            for handle in filter(None, (control.handle, control.empty)):
                handle.on_update(self._on_update)

    @property
    def config(self) -> Config:
        """The configuration that was taken last."""
        return self._config

    def handle(self, section: str, key: str) -> Any:  # noqa: ANN401 - one of viser's handles
        """Return the handle of a parameter's value."""
        return self._controls[section, key].handle

    def null_handle(self, section: str, key: str) -> Any:  # noqa: ANN401 - a check box or None
        """Return the handle of a parameter's null, where it may be null."""
        return self._controls[section, key].empty

    def flush(self) -> None:
        """Take what the controls show; where it is refused, say why and show what holds."""
        self._take(is_typing=False)

    def _take(self, *, is_typing: bool) -> None:
        """Take what the controls show; nothing moves under the hand of who still types."""
        with self._lock:
            self._stop_timer()
            values = values_of(self._config)
            for (section, key), control in self._controls.items():
                values[section][key] = _kept(values[section][key], control.value)
            if values == values_of(self._config):
                self._tell("")
                return
            try:
                config = configuration_of(values)
                self._apply(config)
            except ConfigurationError as error:
                self._tell(str(error))
                if is_typing:
                    self._start_timer(PATIENCE_S, is_typing=False)
                    return
            else:
                self._config = config
                self._tell("")
            self._show()

    def close(self) -> None:
        """Forget changes that were not taken yet."""
        with self._lock:
            self._is_closed = True
            self._stop_timer()

    def _tell(self, refusal: str) -> None:
        if refusal != self._refusal:
            self._refusal = refusal
            self._say(refusal)

    def _show(self) -> None:
        values = values_of(self._config)
        for (section, key), control in self._controls.items():
            control.show(values[section][key])

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is None:  # the program's own change
            return
        with self._lock:
            self._stop_timer()
            if self._is_closed:
                return
            self._start_timer(DELAY_S, is_typing=True)

    def _start_timer(self, delay_s: float, *, is_typing: bool) -> None:
        self._timer = threading.Timer(delay_s, self._take, kwargs={"is_typing": is_typing})
        self._timer.daemon = True
        self._timer.start()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _kept(old: Value, new: Value) -> Value:
    """Return the old value where the new one is the same number, seen through rounding."""
    if isinstance(old, float) and isinstance(new, float) and math.isclose(old, new, rel_tol=1e-9):
        return old
    return new


def _add(gui: viser.GuiApi, parameter: Parameter, value: Value) -> _Control:
    empty = None
    if parameter.is_optional:
        empty = gui.add_checkbox(f"{parameter.key}: null", value is None, hint=parameter.hint)
    shown = parameter.start if value is None else value
    handle = _add_value(gui, parameter, shown)
    if empty is not None:
        handle.disabled = value is None
    return _Control(parameter=parameter, handle=handle, empty=empty)


def _add_value(gui: viser.GuiApi, parameter: Parameter, value: Value) -> Any:  # noqa: ANN401
    key, hint = parameter.key, parameter.hint
    if parameter.kind == "switch":
        return gui.add_checkbox(key, bool(value), hint=hint)
    if parameter.kind == "choice":
        return gui.add_dropdown(key, parameter.choices, initial_value=str(value), hint=hint)
    return _add_number(gui, parameter, value)


def _add_number(gui: viser.GuiApi, parameter: Parameter, value: Any) -> Any:  # noqa: ANN401
    """Add a slider or a field; their type is that of the value that they start with."""
    cast: type[int] | type[float] = int if parameter.kind == "integer" else float
    lower = None if parameter.minimum is None else cast(parameter.minimum)
    upper = None if parameter.maximum is None else cast(parameter.maximum)
    step, hint = cast(parameter.step), parameter.hint
    if parameter.is_slider and lower is not None and upper is not None:
        lower, upper = min(lower, cast(value)), max(upper, cast(value))
        handle: Any = gui.add_slider(parameter.key, lower, upper, step, cast(value), hint=hint)
    else:
        handle = gui.add_number(
            parameter.key, cast(value), min=lower, max=upper, step=step, hint=hint
        )
    if cast is float:  # finer values than the step can be typed
        handle.precision = max(handle.precision, 2 - math.floor(math.log10(step)))
    return handle
