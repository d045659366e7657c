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

DELAY_S = 0.4
"""From the last change until values are applied: numbers are typed digit by digit."""

PATIENCE_S = 2.0
"""How long a refused value is shown, to be corrected, before the valid one comes back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Control:
    """The handles of a parameter; `empty` is the check box for null."""

    parameter: Parameter
    handle: Any
    empty: Any = None

    @property
    def value(self) -> Value:
        """As the page shows it."""
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
        self._refusal = ""
        self._lock = threading.RLock()
        self._due_s = math.inf  # when what is shown is applied, by the clock of `monotonic`
        self._is_typing = False
        self._is_closed = False
        self._controls: dict[tuple[str, str], _Control] = {}
        values = config.model_dump()
        for section, parameters in list_parameters().items():
            with gui.add_folder(section, expand_by_default=False):
                gui.add_markdown(f"*{sections()[section].__doc__}*")
                for parameter in parameters:
                    control = _add(gui, parameter, values[section][parameter.key])
                    self._controls[section, parameter.key] = control
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
            self._is_typing = False
            self._apply_values()

    def tick(self) -> None:
        """Apply what was changed a while ago; called again and again."""
        with self._lock:
            if time.monotonic() >= self._due_s:
                self._apply_values()

    def follow(self, config: Config) -> None:
        """Show what was changed elsewhere, and leave the fields of all else."""
        with self._lock:
            before, self.config = self.config, config
            for (section, key), control in self._controls.items():
                value = getattr(getattr(config, section), key)
                is_changed = value != getattr(getattr(before, section), key)
                if is_changed and not self._is_closed:
                    control.show(value)

    def _apply_values(self) -> None:
        self._due_s = math.inf
        values = self.config.model_dump()
        for (section, key), control in self._controls.items():
            values[section][key] = _kept(values[section][key], control.value)
        if values == self.config.model_dump():
            self._tell("")
            return
        try:
            config = validate_configuration(values)
            self._apply(config)
        except ConfigurationError as error:
            self._tell(str(error))
            if self._is_typing:
                self._wait(PATIENCE_S, is_typing=False)
                return
        else:
            self.config = config
            self._tell("")
        self._show()

    def close(self) -> None:
        """Drop changes that were not applied yet."""
        with self._lock:
            self._is_closed = True

    def _tell(self, refusal: str) -> None:
        if refusal != self._refusal:
            self._refusal = refusal
            self._say(refusal)

    def _show(self) -> None:
        values = self.config.model_dump()
        for (section, key), control in self._controls.items():
            control.show(values[section][key])

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is None:  # the program's own change
            return
        with self._lock:
            self._wait(DELAY_S, is_typing=True)

    def _wait(self, delay_s: float, *, is_typing: bool) -> None:
        self._due_s, self._is_typing = time.monotonic() + delay_s, is_typing


def _kept(old: Value, new: Value) -> Value:
    """Return the old value where the new one differs by rounding alone."""
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
    """Add a slider or a field; viser takes its type from the first value."""
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
    if cast is float:  # values finer than the step can be typed
        handle.precision = max(handle.precision, 2 - math.floor(math.log10(step)))
    return handle
