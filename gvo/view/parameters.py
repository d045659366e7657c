"""Every parameter of the configuration as a control: kind, range, step, help; without drawing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import NoneType
from typing import Any, Literal, TypeAlias, get_args

import yaml

from gvo.config import Config, Section, load_configuration

Value: TypeAlias = bool | int | float | str | None
Kind = Literal["switch", "choice", "integer", "number"]

_WIDEST_SLIDER = 1000.0
_N_STEPS = 200
# what a number starts from where its default is null
_STARTS: Mapping[tuple[str, str], float] = {
    ("depth", "scale"): 1000.0,
    ("window", "kernel_threshold"): 3.55,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """How a parameter is shown and changed.

    Parameters
    ----------
    section, key : str
        Its name is `section.key`.
    kind : {"switch", "choice", "integer", "number"}
    is_optional : bool
        Whether null is a value, too.
    choices : tuple of str
        Of a choice.
    minimum, maximum : float or None
        Smallest and largest value that the control offers, where there is one.
    step : float
        Between two values that the control offers.
    is_slider : bool
        Whether both bounds are near enough for a slider.
    default, start : bool, int, float, str or None
        The default; what a number starts from that was null.
    hint : str
        Meaning, unit, range and default, on one line.
    """

    section: str
    key: str
    kind: Kind
    is_optional: bool
    choices: tuple[str, ...]
    minimum: float | None
    maximum: float | None
    step: float
    is_slider: bool
    default: Value
    start: Value
    hint: str


def list_parameters() -> dict[str, list[Parameter]]:
    """Return the parameters by section, in the order of the configuration."""
    sections = {
        name: field.annotation
        for name, field in Config.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
    }
    return {
        section: [_parameter(section, key, field) for key, field in model.model_fields.items()]
        for section, model in sections.items()
    }


def section_meaning(section: str) -> str:
    """Return one line on a section."""
    model = Config.model_fields[section].annotation
    return (getattr(model, "__doc__", None) or "").strip().splitlines()[0]


def values_of(config: Config) -> dict[str, dict[str, Value]]:
    """Return the values by section and key."""
    return config.model_dump()


def configuration_of(values: Mapping[str, Mapping[str, Value]]) -> Config:
    """Return the configuration of values by section and key.

    Raises
    ------
    ConfigurationError
        Where a value is out of its range or does not go with another.
    """
    return load_configuration(
        settings=[
            f"{section}.{key}={_yaml(value)}"
            for section, group in values.items()
            for key, value in group.items()
        ]
    )


def _yaml(value: Value) -> str:
    return str(yaml.safe_dump(value)).splitlines()[0]


def _parameter(section: str, key: str, field: Any) -> Parameter:  # noqa: ANN401
    options = get_args(field.annotation)
    limits = {type(limit).__name__: limit for limit in field.metadata}
    kind = _kind(field.annotation)
    lower, upper = _bound(limits, "Ge", "Gt"), _bound(limits, "Le")
    start = field.default
    if start is None:
        start = _STARTS.get((section, key), 1.0)
    is_slider = kind in ("integer", "number") and _is_near(lower, upper)
    step = _step(kind, float(start) if is_number(start) else 0.0, lower, upper, is_slider)
    if lower is not None and "Gt" in limits and (is_slider or kind == "integer"):
        lower += step
    return Parameter(
        section=section,
        key=key,
        kind=kind,
        is_optional=NoneType in options,
        choices=tuple(options) if kind == "choice" else (),
        minimum=lower,
        maximum=upper,
        step=step,
        is_slider=is_slider,
        default=field.default,
        start=start,
        hint=_hint(field, limits),
    )


def is_number(value: object) -> bool:
    """Tell whether a value is a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _kind(annotation: Any) -> Kind:  # noqa: ANN401
    options = [option for option in get_args(annotation) if option is not NoneType]
    if options and all(isinstance(option, str) for option in options):
        return "choice"
    plain = options[0] if options else annotation
    kinds: dict[type, Kind] = {bool: "switch", int: "integer", float: "number"}
    return kinds[plain]


def _bound(limits: Mapping[str, Any], *names: str) -> float | None:
    found = [getattr(limits[name], name.lower()) for name in names if name in limits]
    return float(found[0]) if found else None


def _is_near(lower: float | None, upper: float | None) -> bool:
    return lower is not None and upper is not None and upper - lower <= _WIDEST_SLIDER


def _step(
    kind: Kind, start: float, lower: float | None, upper: float | None, is_slider: bool
) -> float:
    """Return a step of one digit, fine enough for the range, or for the start value."""
    if kind == "integer":
        return 1.0
    if is_slider and lower is not None and upper is not None:
        return _one_digit((upper - lower) / _N_STEPS)
    return 10.0 ** (math.floor(math.log10(start)) - 1) if start > 0 else 0.1


def _one_digit(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= value * 1.001))


def _hint(field: Any, limits: Mapping[str, Any]) -> str:  # noqa: ANN401
    unit = str((field.json_schema_extra or {}).get("unit", ""))
    signs = {"Ge": ">=", "Gt": ">", "Le": "<="}
    ranges = [
        f"{sign} {getattr(limits[name], name.lower()):g}"
        for name, sign in signs.items()
        if name in limits
    ]
    shape = ", ".join([*ranges, *([f"in {unit}"] if unit else [])])
    return (
        f"{field.description}"
        + (f"; {shape}" if shape else "")
        + (f"; default {_yaml(field.default)}")
    )
