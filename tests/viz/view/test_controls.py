"""The controls change the configuration, and go back where it is refused."""

from typing import Any

import pytest

from gvo.config import Config, load_configuration
from gvo.errors import ConfigurationError
from gvo.viz.view.controls import ParameterControls, list_parameters
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
        """Do what a client does."""
        self.controls.handle(section, key).value = value
        self.controls.flush()


@pytest.fixture
def desk(view: ViewServer) -> Desk:
    """Controls of the defaults."""
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
        ("klt", "min_eigenvalue", 3e-5),
        ("window", "kernel", "cauchy"),
        ("window", "zero_motion", True),
        ("window", "min_overlap", 0.45),
        ("window", "size", 9),
    ],
)
def test_a_changed_control_changes_that_parameter_alone(
    desk: Desk, section: str, key: str, value: Any
) -> None:
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
