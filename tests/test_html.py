"""What notebooks show: well-formed whatever the numbers, and the right numbers."""

import math
import warnings
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from gvo._html import card
from gvo._text import visible
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate, FloatArray

_any_number = st.floats(allow_nan=True, allow_infinity=True)
_finite = st.floats(-1e307, 1e307)


def parsed(html: str) -> ElementTree.Element:
    """Return the element; fail where it is not well-formed, or asks for something elsewhere."""
    root = ElementTree.fromstring(html)
    HTMLParser().feed(html)
    for element in root.iter():
        assert not {"href", "src", "onload"} & set(element.attrib)
    return root


def cells(html: str) -> dict[str, str]:
    found = {}
    for row in parsed(html).iter("tr"):
        name, value = ("".join(cell.itertext()) for cell in row)
        found[name] = value
    return found


def moving(positions: FloatArray, *, rate_hz: float = 10.0) -> Trajectory:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    stamps_ns = np.round(1e9 / rate_hz * np.arange(len(positions))).astype(np.int64)
    return Trajectory(stamps_ns=stamps_ns, T_world_frame=poses)


@given(
    positions=st.integers(0, 12).flatmap(lambda n: arrays(np.float64, (n, 3), elements=_finite)),
    is_of_positions=st.booleans(),
)
def test_any_trajectory_is_well_formed(positions: FloatArray, is_of_positions: bool) -> None:
    trajectory = moving(positions)
    if is_of_positions:
        trajectory = Trajectory.of_positions(trajectory.stamps_ns, positions)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cells(trajectory._repr_html_())["poses"].startswith(str(len(positions)))


@given(
    pose=arrays(np.float64, (4, 4), elements=_any_number),
    covariance=arrays(np.float64, (6, 6), elements=_any_number),
    is_rigid=st.booleans(),
)
def test_estimates_are_sound_xml(pose: FloatArray, covariance: FloatArray, is_rigid: bool) -> None:
    estimate = Estimate(
        stamp_ns=5, T_world_frame=np.eye(4) if is_rigid else pose, covariance=covariance
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cells(estimate._repr_html_())["stamp"] == "0.000000005 s"


@pytest.mark.parametrize("shape", [(), (3, 3)])
def test_there_is_no_estimate_of_the_wrong_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"T_world_frame must have shape \(4, 4\)"):
        Estimate(stamp_ns=0, T_world_frame=np.zeros(shape), covariance=np.eye(6))


def test_the_numbers_are_those_of_the_trajectory() -> None:
    turns = np.linspace(0.0, 2.0 * np.pi, 1001)
    circle = np.column_stack([50.0 * np.cos(turns) - 50.0, 0.0 * turns, 50.0 * np.sin(turns)])
    shown = cells(moving(circle, rate_hz=20.0)._repr_html_())
    assert shown["path length"] == f"{100.0 * math.pi:.2f} m"
    assert shown["extent x, y, z"] == "100.00 m, 0 mm, 100.00 m"
    assert (shown["duration"], shown["mean rate"]) == ("50.000 s", "20 Hz")
    assert shown["covariances"] == "none"


def test_an_estimate_shows_its_position_along_the_axes_of_the_world() -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, np.pi / 2, 0.0]).as_matrix()
    pose[:3, 3] = [1.0, 2.0, 3.0]
    # uncertain ahead of the camera, which looks along x of the world
    covariance = np.diag(np.square([0.01, 0.02, 0.03, 0.1, 0.1, 0.5]))
    shown = cells(Estimate(stamp_ns=0, T_world_frame=pose, covariance=covariance)._repr_html_())
    assert shown["position x, y, z [m]"] == "1.00 ± 0.50, 2.00 ± 0.10, 3.00 ± 0.10"
    assert shown["rotation vector [deg]"].startswith("0.00 ± 0.57, 90.0 ± 1.1, 0.0 ± 1.7")


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"])))
def test_text_is_escaped(text: str) -> None:
    assert "".join(parsed(card(text, [(text, text)])).itertext()) == 3 * visible(text)
