"""Each parameter has a control with its range; refused values go back."""

from collections.abc import Iterator
from typing import Any

import pytest
import viser

from gvo.config import (
    Config,
    list_parameters,
    load_configuration,
)
from gvo.errors import ConfigurationError
from gvo.viz.view.controls import ParameterControls
from gvo.viz.view.server import open_server, silence

PARAMETERS = [parameter for group in list_parameters().values() for parameter in group]


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    opened = open_server("127.0.0.1", 0, title="gvo")
    yield opened
    with silence():
        opened.stop()


class Desk:
    """Controls with what they say and apply."""

    def __init__(self, gui: Any, config: Config | None = None) -> None:
        self.applied: list[Config] = []
        self.said: list[str] = []
        self.refusal: ConfigurationError | None = None
        self.controls = ParameterControls(
            gui, config or Config(), apply=self.apply, say=self.said.append
        )

    def apply(self, config: Config) -> None:
        """Take a configuration, or refuse it."""
        if self.refusal is not None:
            raise self.refusal
        self.applied.append(config)

    def set(self, section: str, key: str, value: Any) -> None:
        self.controls.handle(section, key).value = value
        self.controls.flush()


@pytest.fixture
def desk(server: viser.ViserServer) -> Desk:
    server.gui.reset()
    return Desk(server.gui)


def test_every_parameter_shows_its_value_and_untouched_ones_change_nothing(desk: Desk) -> None:
    for parameter in PARAMETERS:
        section, key = parameter.section, parameter.key
        handle = desk.controls.handle(section, key)
        empty = desk.controls.null_handle(section, key)
        assert (empty is not None) == parameter.is_optional
        assert (handle.label, handle.hint) == (key, parameter.hint)
        value = getattr(getattr(Config(), section), key)
        assert (empty.value if value is None else handle.value == value) is True
    desk.controls.flush()
    assert desk.applied == []


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("klt", "n_corners", 300),
        ("ransac", "min_disparity_px", 3e-5),
        ("window", "kernel", "cauchy"),
        ("stereo", "estimate_offset", False),
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


@pytest.mark.parametrize(
    ("section", "key", "value", "words"),
    [
        ("klt", "n_corners", 2, "klt.n_corners=2"),
        ("stereo", "min_depth_m", 500.0, "must be below"),
        ("window", "kernel", "dcs", "not while it runs"),  # by the player alone
    ],
)
def test_what_is_refused_is_told_on_one_line_and_goes_back(
    desk: Desk, section: str, key: str, value: Any, words: str
) -> None:
    desk.refusal = ConfigurationError("not while it runs")
    desk.set(section, key, value)
    assert desk.applied == []
    assert words in desk.said[-1]
    assert "\n" not in desk.said[-1]
    assert desk.controls.handle(section, key).value == getattr(getattr(Config(), section), key)
    assert desk.controls.config == Config()
    desk.controls.flush()  # with the next press of a button the line goes
    assert desk.said[-1] == ""


def test_the_ends_of_sliders_and_the_start_of_optional_numbers_are_taken() -> None:
    for parameter in PARAMETERS:
        cast: type = int if parameter.kind == "integer" else float
        ends = (parameter.minimum, parameter.maximum) if parameter.is_slider else ()
        for value in (*map(cast, ends), *([parameter.start] if parameter.is_optional else [])):
            setting = f"{parameter.section}.{parameter.key}={value}"
            assert load_configuration(settings=[setting]), setting
