"""Each parameter has a control with its range; refused values go back."""

from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import (
    Config,
    Parameter,
    describe_configuration,
    list_parameters,
    load_configuration,
    validate_configuration,
)
from gvo.errors import ConfigurationError
from gvo.viz.view.controls import ParameterControls
from gvo.viz.view.server import ViewServer


class Desk:
    """Controls with what they say and apply."""

    def __init__(self, gui: Any, config: Config | None = None) -> None:
        self.applied: list[Config] = []
        self.said: list[str] = []
        self.controls = ParameterControls(
            gui, config or Config(), apply=self.apply, say=self.said.append
        )
        self.refusal: ConfigurationError | None = None

    def apply(self, config: Config) -> None:
        """Take a configuration, or refuse it."""
        if self.refusal is not None:
            raise self.refusal
        self.applied.append(config)

    def set(self, section: str, key: str, value: Any) -> None:
        self.controls.handle(section, key).value = value
        self.controls.flush()


@pytest.fixture
def desk(view: ViewServer) -> Desk:
    return Desk(view.viser.gui)


def test_every_parameter_shows_its_value_and_has_a_hint(desk: Desk) -> None:
    for section, parameters in list_parameters().items():
        for parameter in parameters:
            handle = desk.controls.handle(section, parameter.key)
            empty = desk.controls.null_handle(section, parameter.key)
            assert (empty is not None) == parameter.is_optional
            assert handle.label == parameter.key
            assert handle.hint == parameter.hint
            value = getattr(getattr(Config(), section), parameter.key)
            assert (empty.value if value is None else handle.value == value) is True


def test_controls_that_nobody_touched_change_nothing(desk: Desk) -> None:
    desk.controls.flush()
    assert desk.applied == []
    assert desk.said == []


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("klt", "n_corners", 300),
        ("ransac", "min_disparity_px", 3e-5),
        ("window", "kernel", "cauchy"),
        ("stereo", "estimate_offset", False),
        ("window", "min_overlap", 0.45),
        ("window", "size", 9),
    ],
)
def test_a_control_changes_one_parameter(desk: Desk, section: str, key: str, value: Any) -> None:
    desk.set(section, key, value)
    (config,) = desk.applied
    assert config == load_configuration(settings=[f"{section}.{key}={value}"])
    assert desk.controls.config == config


def test_null_is_a_check_box_of_its_own(desk: Desk) -> None:
    desk.controls.null_handle("window", "size").value = True
    desk.controls.flush()
    assert desk.applied[-1].window.size is None
    assert desk.controls.handle("window", "size").disabled
    desk.controls.null_handle("window", "size").value = False
    desk.controls.flush()
    assert desk.applied[-1] == Config()
    assert not desk.controls.handle("window", "size").disabled


def test_a_value_out_of_range_is_told_on_one_line_and_goes_back(desk: Desk) -> None:
    desk.set("klt", "n_corners", 2)
    assert desk.applied == []
    assert "klt.n_corners=2" in desk.said[-1]
    assert "\n" not in desk.said[-1]
    assert desk.controls.handle("klt", "n_corners").value == Config().klt.n_corners


def test_values_that_do_not_go_together_go_back(desk: Desk) -> None:
    desk.set("stereo", "min_depth_m", 500.0)
    assert desk.applied == []
    assert "must be below" in desk.said[-1]
    assert desk.controls.handle("stereo", "min_depth_m").value == Config().stereo.min_depth_m


def test_what_the_player_refuses_goes_back(desk: Desk) -> None:
    desk.refusal = ConfigurationError("not while it runs")
    desk.set("window", "kernel", "dcs")
    assert desk.said[-1] == "not while it runs"
    assert desk.controls.handle("window", "kernel").value == "huber"
    assert desk.controls.config == Config()


def test_the_line_goes_with_the_next_good_value(desk: Desk) -> None:
    desk.set("klt", "n_corners", 2)
    desk.set("klt", "n_corners", 60)
    assert desk.said[-1] == ""


def test_a_configuration_beyond_the_sliders_is_kept(view: ViewServer) -> None:
    config = load_configuration(settings=["temporal.max_distance=0.0012", "window.gate=null"])
    desk = Desk(view.viser.gui, config)
    desk.set("klt", "n_corners", 60)
    assert desk.applied[-1].temporal.max_distance == 0.0012
    assert desk.applied[-1].window.gate is None


def test_the_line_goes_with_the_next_press_of_a_button(desk: Desk) -> None:
    desk.set("klt", "n_corners", 2)
    desk.controls.flush()
    assert desk.said[-1] == ""


PARAMETERS = [parameter for group in list_parameters().values() for parameter in group]


SCHEMA = Config.model_json_schema()


def schema_of(parameter: Parameter) -> dict[str, Any]:
    """The range of a parameter as pydantic states it in its JSON schema."""
    section = SCHEMA["$defs"][SCHEMA["properties"][parameter.section]["$ref"].split("/")[-1]]
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
    assert {parameter.key for parameter in optional} >= {"size", "gate"}
    for parameter in optional:
        values = Config().model_dump()
        values[parameter.section][parameter.key] = parameter.start
        assert validate_configuration(values)


@settings(max_examples=20)
@given(
    min_disparity_px=st.floats(1e-12, 1e3),
    size=st.none() | st.integers(2, 1000),
    kernel=st.sampled_from(["none", "huber", "dcs"]),
    upright=st.booleans(),
)
def test_values_come_back_as_the_same_configuration(
    min_disparity_px: float, size: Any, kernel: str, upright: bool
) -> None:
    values = Config().model_dump()
    values["ransac"]["min_disparity_px"] = min_disparity_px
    values["window"] |= {"size": size, "kernel": kernel}
    values["features"]["upright"] = upright
    assert validate_configuration(values) == Config.model_validate(values)
