"""Every parameter becomes a control that knows its range."""

from functools import cache
from typing import Any

import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import (
    Config,
    describe_configuration,
    load_configuration,
    validate_configuration,
)
from gvo.viz.view.controls import Parameter, list_parameters

PARAMETERS = [parameter for group in list_parameters().values() for parameter in group]


@cache
def whole_schema() -> dict[str, Any]:
    """What pydantic tells of the configuration."""
    return Config.model_json_schema()


def schema_of(parameter: Parameter) -> dict[str, Any]:
    """The range of a parameter as pydantic states it in its JSON schema."""
    schema = whole_schema()
    section = schema["$defs"][schema["properties"][parameter.section]["$ref"].split("/")[-1]]
    described = section["properties"][parameter.key]
    plain = [option for option in described.get("anyOf", []) if option.get("type") != "null"]
    return {**described, **(plain[0] if plain else {})}


def test_every_key_of_the_configuration_is_listed_once() -> None:
    described = yaml.safe_load(describe_configuration(Config()))
    keys = {(section, key) for section, group in described.items() for key in group}
    assert {(parameter.section, parameter.key) for parameter in PARAMETERS} == keys
    assert len(PARAMETERS) == len(keys)


def test_bounds_lie_within_those_of_the_configuration() -> None:
    for parameter in PARAMETERS:
        schema = schema_of(parameter)
        lowest = schema.get("minimum", schema.get("exclusiveMinimum"))
        assert (parameter.minimum is None) == (lowest is None), parameter
        assert parameter.maximum == schema.get("maximum"), parameter
        if lowest is not None:
            assert lowest <= parameter.minimum <= lowest + parameter.step, parameter


def test_the_ends_of_every_slider_are_taken() -> None:
    sliders = [parameter for parameter in PARAMETERS if parameter.is_slider]
    assert len(sliders) > 10
    for parameter in sliders:
        cast: type = int if parameter.kind == "integer" else float
        for end in (parameter.minimum, parameter.maximum):
            setting = f"{parameter.section}.{parameter.key}={cast(end)}"
            assert load_configuration(settings=[setting]), setting


def test_hints_hold_meaning_unit_and_default() -> None:
    for parameter in PARAMETERS:
        schema = schema_of(parameter)
        assert schema["description"] in parameter.hint
        assert schema.get("unit", "") in parameter.hint
        default = "null" if parameter.default is None else f"{parameter.default}".lower()
        assert yaml.safe_load(parameter.hint.rpartition("default ")[2]) == yaml.safe_load(default)


def test_optional_numbers_start_from_a_value_that_is_taken() -> None:
    optional = [parameter for parameter in PARAMETERS if parameter.is_optional]
    assert {parameter.key for parameter in optional} >= {"size", "gate", "kernel_threshold"}
    for parameter in optional:
        values = Config().model_dump()
        values[parameter.section][parameter.key] = parameter.start
        assert validate_configuration(values)


@settings(max_examples=20)
@given(
    min_eigenvalue=st.floats(1e-12, 1e3),
    size=st.none() | st.integers(2, 1000),
    kernel=st.sampled_from(["none", "huber", "dcs"]),
    upright=st.booleans(),
)
def test_values_come_back_as_the_same_configuration(
    min_eigenvalue: float, size: Any, kernel: str, upright: bool
) -> None:
    values = Config().model_dump()
    values["klt"]["min_eigenvalue"] = min_eigenvalue
    values["window"] |= {"size": size, "kernel": kernel}
    values["features"]["upright"] = upright
    config = validate_configuration(values)
    assert config == Config.model_validate(values)
