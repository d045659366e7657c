"""Each parameter has a control with its range; refused values go back."""

from typing import Any

import pytest
import yaml

from gvo.config import (
    Config,
    Parameter,
    describe_configuration,
    list_parameters,
    load_configuration,
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


@pytest.mark.parametrize(
    ("section", "key", "value", "words"),
    [
        ("klt", "n_corners", 2, "klt.n_corners=2"),
        ("stereo", "min_depth_m", 500.0, "must be below"),
        ("window", "kernel", "dcs", "not while it runs"),
    ],
)
def test_what_is_refused_is_told_on_one_line_and_goes_back(
    desk: Desk, section: str, key: str, value: Any, words: str
) -> None:
    if key == "kernel":  # by the player alone
        desk.refusal = ConfigurationError("not while it runs")
    desk.set(section, key, value)
    assert desk.applied == []
    assert words in desk.said[-1]
    assert "\n" not in desk.said[-1]
    assert desk.controls.handle(section, key).value == getattr(getattr(Config(), section), key)
    assert desk.controls.config == Config()
    desk.controls.flush()  # with the next press of a button the line goes
    assert desk.said[-1] == ""


def test_a_configuration_beyond_the_sliders_is_kept(view: ViewServer) -> None:
    config = load_configuration(settings=["temporal.max_distance=0.0012", "window.gate=null"])
    desk = Desk(view.viser.gui, config)
    desk.set("klt", "n_corners", 60)
    assert desk.applied[-1].temporal.max_distance == 0.0012
    assert desk.applied[-1].window.gate is None


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
    keys = sorted((section, key) for section, group in described.items() for key in group)
    assert sorted((parameter.section, parameter.key) for parameter in PARAMETERS) == keys


def test_ranges_and_hints_are_those_of_the_configuration() -> None:
    for parameter in PARAMETERS:
        schema = schema_of(parameter)
        lowest = schema.get("minimum", schema.get("exclusiveMinimum"))
        assert (parameter.minimum is None) == (lowest is None), parameter
        assert parameter.maximum == schema.get("maximum"), parameter
        if lowest is not None:
            assert lowest <= parameter.minimum <= lowest + parameter.step, parameter
        assert schema["description"] in parameter.hint
        assert schema.get("unit", "") in parameter.hint
        default = "null" if parameter.default is None else f"{parameter.default}".lower()
        assert yaml.safe_load(parameter.hint.rpartition("default ")[2]) == yaml.safe_load(default)


def test_the_ends_of_sliders_and_the_start_of_optional_numbers_are_taken() -> None:
    n_sliders = 0
    for parameter in PARAMETERS:
        cast: type = int if parameter.kind == "integer" else float
        ends = (parameter.minimum, parameter.maximum) if parameter.is_slider else ()
        n_sliders += parameter.is_slider
        for value in (*map(cast, ends), *([parameter.start] if parameter.is_optional else [])):
            setting = f"{parameter.section}.{parameter.key}={value}"
            assert load_configuration(settings=[setting]), setting
    assert n_sliders > 10
