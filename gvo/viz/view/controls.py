"""Every parameter of the configuration as a control of the page."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import viser

from gvo.config import Config, Parameter, Value, list_parameters, sections, validate_configuration
from gvo.errors import ConfigurationError

DELAY_S = 0.8
"""From the last change until values are applied: numbers are typed digit by digit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Control:
    """What the page shows for a parameter; `empty` is the check box for null."""

    parameter: Parameter
    handle: Any
    empty: Any

    def value(self, present: Value) -> Value:
        """Return the value that the page shows; the present one where it rounded that."""
        if self.empty is not None and self.empty.value:
            return None
        shown = self.handle.value
        if self.parameter.kind == "integer":
            return int(shown)
        is_rounded = isinstance(present, float) and math.isclose(present, shown, rel_tol=1e-9)
        return present if is_rounded else shown

    def show(self, value: Value) -> None:
        """Show a value."""
        if self.empty is not None:
            self.empty.value = value is None
            self.handle.disabled = value is None
        if value is not None:
            self.handle.value = value


class ParameterControls:
    """A control for every parameter, in folders by section.

    `apply` is called with each new configuration and raises `ConfigurationError` to refuse it;
    `say` with one line on what was refused, and with an empty one once values are valid.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        config: Config,
        *,
        apply: Callable[[Config], None],
        say: Callable[[str], None],
    ) -> None:
        self.config, self._apply, self._say = config, apply, say
        self._lock = threading.RLock()
        self._due_s = math.inf  # when what is shown is applied, by the clock of `monotonic`
        self._is_closed = False
        self._controls: dict[tuple[str, str], _Control] = {}
        for section, parameters in list_parameters().items():
            with gui.add_folder(section, expand_by_default=False):
                gui.add_markdown(f"*{sections()[section].__doc__}*")
                for parameter in parameters:
                    self._controls[section, parameter.key] = _add(gui, parameter)
        self._show(config)
        for control in self._controls.values():
            for handle in filter(None, (control.handle, control.empty)):
                handle.on_update(self._on_update)

    def handle(self, section: str, key: str) -> Any:  # noqa: ANN401 - one of viser's handles
        """Return the handle of a parameter's value."""
        return self._controls[section, key].handle

    def null_handle(self, section: str, key: str) -> Any:  # noqa: ANN401 - a check box or None
        """Return the handle of a parameter's null, where it may be null."""
        return self._controls[section, key].empty

    def flush(self) -> None:
        """Apply what the controls show; where it is refused, say why and show what is valid."""
        with self._lock:
            self._due_s = math.inf
            values = self.config.model_dump()
            for (section, key), control in self._controls.items():
                values[section][key] = control.value(values[section][key])
            refusal = ""
            if values != self.config.model_dump():
                try:
                    config = validate_configuration(values)
                    self._apply(config)
                    self.config = config
                except ConfigurationError as error:
                    refusal = str(error)
                self._show(self.config)
            self._say(refusal)

    def tick(self) -> None:
        """Apply what was changed a while ago; called again and again."""
        with self._lock:
            if time.monotonic() >= self._due_s:
                self.flush()

    def follow(self, config: Config) -> None:
        """Show what was changed elsewhere, and leave the fields of all else."""
        with self._lock:
            before, self.config = self.config, config
            if not self._is_closed:
                self._show(config, before)

    def close(self) -> None:
        """Drop changes that were not applied yet."""
        with self._lock:
            self._is_closed = True

    def _show(self, config: Config, before: Config | None = None) -> None:
        """Show a configuration; where there was one before, what differs."""
        values, known = config.model_dump(), before.model_dump() if before else None
        for (section, key), control in self._controls.items():
            value = values[section][key]
            if known is None or value != known[section][key]:
                control.show(value)

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:  # not the program's own change
            with self._lock:
                self._due_s = time.monotonic() + DELAY_S


def _add(gui: viser.GuiApi, parameter: Parameter) -> _Control:
    key, hint, start = parameter.key, parameter.hint, parameter.start
    empty: Any = None
    if parameter.is_optional:
        empty = gui.add_checkbox(f"{key}: null", parameter.default is None, hint=hint)
    if parameter.kind == "switch":
        handle: Any = gui.add_checkbox(key, bool(start), hint=hint)
    elif parameter.kind == "choice":
        handle = gui.add_dropdown(key, parameter.choices, initial_value=str(start), hint=hint)
    else:
        handle = _add_number(gui, parameter)
    return _Control(parameter=parameter, handle=handle, empty=empty)


def _add_number(gui: viser.GuiApi, parameter: Parameter) -> Any:  # noqa: ANN401
    """Add a slider or a field; viser takes its type from the first value."""
    cast: Any = int if parameter.kind == "integer" else float
    lower = None if parameter.minimum is None else cast(parameter.minimum)
    upper = None if parameter.maximum is None else cast(parameter.maximum)
    step, start = cast(parameter.step), cast(parameter.start)
    if parameter.is_slider:
        handle: Any = gui.add_slider(parameter.key, lower, upper, step, start, hint=parameter.hint)
    else:
        handle = gui.add_number(
            parameter.key, start, min=lower, max=upper, step=step, hint=parameter.hint
        )
    if cast is float:  # values finer than the step can be typed
        handle.precision = max(handle.precision, 2 - math.floor(math.log10(step)))
    return handle
