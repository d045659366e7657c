"""ROS 1: what `gvo.live.ros1` and rospy say to each other; `gvo live ros1` as a whole."""

import ast
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gvo.config import list_parameters
from tests.live.ros1 import Program, Ros, ros  # noqa: F401 - the fixture

FOLDER = Path(__file__).parent
PEER = FOLDER / "ros1_peer.py"
STAMP_NS = 1_700_000_000_123_456_789
CLOCK_NS = 5_000_000_006


def events(node: Program, name: str) -> list[dict[str, Any]]:
    found = map(json.loads, node.lines)
    return [event for event in found if event["event"] == name]


@pytest.fixture
def node(ros: Ros) -> Iterator[Program]:  # noqa: F811
    program = ros.start(FOLDER / "ros1_node.py")
    program.wait_for('"ready"')
    yield program
    assert program.end() == 0
    assert events(program, "left") == [{"event": "left", "threads": ["MainThread"]}]
    assert not any("Traceback" in line for line in program.errors), program.errors


@pytest.mark.acceptance
def test_messages_travel_both_ways_as_rospy_has_them(ros: Ros, node: Program) -> None:  # noqa: F811
    peer = ros.ask(PEER, "messages")
    node.end()
    *_, image = events(node, "image")
    (info,) = events(node, "info")
    assert (image["digest"], info["digest"]) == (peer["image"], peer["info"])
    assert (image["stamp_ns"], image["clock_ns"]) == (STAMP_NS, CLOCK_NS)
    assert peer["plain"] == "cam"
    assert peer["late"] == CLOCK_NS  # latched, under another name
    assert peer["reset"] == "done"
    assert {"event": "heard", "value": True} in events(node, "heard")
    (own,) = events(node, "topics")
    assert own["topics"] == []


@pytest.mark.acceptance
def test_services_refuse_in_words(ros: Ros, node: Program) -> None:  # noqa: F811
    peer = ros.ask(PEER, "services")
    node.end()
    assert events(node, "pose") == [{"event": "pose", "x": 1.5}]
    assert "no such frame" in peer["refusal"]
    assert "md5sum" in peer["other"]


@pytest.mark.acceptance
def test_parameters_change_by_the_client_of_dynamic_reconfigure(
    ros: Ros,  # noqa: F811
    node: Program,
) -> None:
    peer = ros.ask(PEER, "parameters")
    node.end()
    optional = [one for listed in list_parameters().values() for one in listed if one.is_optional]
    n_listed = sum(map(len, list_parameters().values()))
    assert peer["n"] == n_listed + len(optional)
    assert peer["groups"] == [*list_parameters()]
    size, readout = peer["size"], peer["readout"]
    assert (size["type"], size["min"], size["max"], size["default"]) == ("int", 2, 1000, 5)
    assert "default 5" in size["description"]
    assert (readout["type"], readout["min"], readout["max"]) == ("double", -100.0, 100.0)
    choices = [choice["value"] for choice in ast.literal_eval(peer["kind"])["enum"]]
    assert choices == ["orb", "sift", "fast", "gftt"]
    assert peer["answers"] == [7, 7, False, True, 1.0, "sift"]
    changes = [(one["size"], one["readout_ms"]) for one in events(node, "parameters")]
    assert changes == [(7, None), (7, 3.5), (7, None), (7, 1.0), (7, 1.0)]
    assert [line for line in node.errors if "window.size" in line] == node.errors
    assert len(node.errors) == 1


@pytest.mark.acceptance
def test_a_hostile_node_is_survived(ros: Ros, node: Program) -> None:  # noqa: F811
    assert ros.ask(PEER, "hostile")["n_sent"] < 1 << 25
    other = ros.start(PEER, "of_another_type")
    other.wait_for("types do not match")
    other.end()
    peer = ros.start(PEER, "an_image")
    node.wait_for('"image"')
    node.tell("end the subscription")
    node.wait_for('"ended"')
    assert peer.end() == 0
    node.end()
    (image,) = events(node, "image")
    assert image["digest"] == json.loads(peer.lines[0])["image"]
    assert len(events(node, "fault")) == 4
