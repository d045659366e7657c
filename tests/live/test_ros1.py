"""ROS 1: what `gvo.live.ros1` and rospy say to each other; `gvo live ros1` as a whole."""

import ast
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.config import list_parameters
from gvo.types import FloatArray
from tests.conftest import GVO, assert_same_files, python, refused, run_of
from tests.live.ros1 import PATIENCE_S, Program, Ros

pytestmark = pytest.mark.ros1

FOLDER = Path(__file__).parent
PEER, DRIVER = FOLDER / "ros1_peer.py", FOLDER / "ros1_driver.py"
PLAYER = FOLDER.parents[1] / "scripts" / "ros" / "play.py"
STAMP_NS = 1_700_000_000_123_456_789
CLOCK_NS = 5_000_000_006


def events(node: Program, name: str) -> list[dict[str, Any]]:
    found = map(json.loads, node.lines)
    return [event for event in found if event["event"] == name]


@pytest.fixture
def node(ros: Ros) -> Iterator[Program]:
    program = ros.start(FOLDER / "ros1_node.py")
    program.wait_for('"ready"')
    yield program
    assert program.end() == 0
    assert events(program, "left") == [{"event": "left", "threads": ["MainThread"]}]
    assert not any("Traceback" in line for line in program.errors), program.errors


@pytest.mark.acceptance
def test_messages_travel_both_ways_as_rospy_has_them(ros: Ros, node: Program) -> None:
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
def test_services_refuse_in_words(ros: Ros, node: Program) -> None:
    peer = ros.ask(PEER, "services")
    node.end()
    assert events(node, "pose") == [{"event": "pose", "x": 1.5}]
    assert "no such frame" in peer["refusal"]
    assert "md5sum" in peer["other"]


@pytest.mark.acceptance
def test_parameters_change_by_the_client_of_dynamic_reconfigure(ros: Ros, node: Program) -> None:
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


def pose(values: list[float]) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T


class Transforms:
    """What `/tf` and `/tf_static` held, by stamp."""

    def __init__(self, noted: dict[str, Any]) -> None:
        self._fixed = {child: (parent, pose(q)) for _, parent, child, q in noted["static"]}
        self._moving = {
            (stamp_ns, child): (parent, pose(q)) for stamp_ns, parent, child, q in noted["tf"]
        }

    def to_map(self, frame: str, stamp_ns: int) -> FloatArray:
        """Return T_map_frame at exactly this stamp."""
        T_map_frame = np.eye(4)
        while frame != "map":
            moving = self._moving.get((stamp_ns, frame))
            frame, T = self._fixed[frame] if moving is None else moving
            T_map_frame = T @ T_map_frame
        return T_map_frame


def live(ros: Ros, out: Path, *options: str) -> Program:
    return ros.start(*GVO[1:], "live", "ros1", "--no-report", "--out", out, *options)


@pytest.mark.acceptance
@pytest.mark.recorded
@pytest.mark.parametrize("name", ["kitti_06_start", "rgbd_dataset_freiburg1_xyz_start"])
def test_what_is_played_is_tracked_as_from_its_files(
    name: str, ros: Ros, gvo_data: Path, tmp_path: Path
) -> None:
    run_of(gvo_data / name, tmp_path / "run")
    expected = gvo.read_trajectory(tmp_path / "run" / "causal.txt")
    odometry = live(ros, tmp_path / "out")
    watcher = ros.start(DRIVER)
    watcher.wait_for("watching")
    player = ros.start(PLAYER, gvo_data / name)
    player.wait_for("pairs sent")
    assert player.end() == 0
    assert odometry.send(signal.SIGINT) == 0, odometry.errors
    assert_same_files(tmp_path / "out", tmp_path / "run")
    watcher.tell(str(expected.stamps_ns[-1]))
    assert watcher.end() == 0, watcher.errors
    noted = json.loads(watcher.lines[-1])
    transforms = Transforms(noted)
    # Who listens is not connected to all topics at once; of a frame, gvo/odom is sent first.
    begun = noted["odometry"], noted["clouds"], [one for one in noted["tf"] if one[2] == "gvo/odom"]
    first_ns = max(messages[0][0] for messages in begun)
    poses = dict(zip(expected.stamps_ns.tolist(), expected.T_world_frame, strict=True))
    checked = [one for one in noted["odometry"] if one[0] >= first_ns]
    assert len(checked) > len(poses) // 2
    for stamp_ns, frame, child, values in checked:
        T_map_base = transforms.to_map(frame, stamp_ns) @ pose(values)
        np.testing.assert_allclose(transforms.to_map(child, stamp_ns), T_map_base, atol=1e-9)
        np.testing.assert_allclose(T_map_base, poses[stamp_ns], atol=1e-6)
    clouds = [one for one in noted["clouds"] if one[0] >= first_ns]
    assert len(clouds) == len(checked)
    for stamp_ns, frame, step, offsets, text in clouds:
        assert offsets == [0, 4, 8]
        rows = np.frombuffer(bytes.fromhex(text), np.uint8).reshape(-1, step)
        points_cam = rows[:, :12].copy().view("<f4")
        assert np.all(points_cam[:, 2] > 0.1)  # the camera looks along z
        np.testing.assert_allclose(transforms.to_map(frame, stamp_ns), poses[stamp_ns], atol=1e-6)


@pytest.mark.acceptance
@pytest.mark.recorded
def test_a_session_goes_on_whatever_comes(ros: Ros, gvo_data: Path, tmp_path: Path) -> None:
    recording = gvo_data / "kitti_06_start"
    driver = ros.start(DRIVER, recording)
    driver.wait_for("introduced")  # CameraInfo is sent once, and not again
    odometry = live(ros, tmp_path / "out")
    for index in range(40):
        driver.wait_for(f"pair {index}\n")
    driver.send(signal.SIGKILL)
    odometry.wait_for("no images for")
    player = ros.start(PLAYER, recording, "--ahead", "0")
    player.wait_for("pairs sent")
    assert player.end() == 0
    ros.end_node("/gvo")
    assert odometry.end() == 3, odometry.errors  # some frames are faulty
    # The parameter that was set after ten frames; the one out of its range was not.
    lines = (tmp_path / "out" / "frames.csv").read_text().splitlines()[1:]
    rows = [line.split(",") for line in lines]
    counts = [int(row[3]) for row in rows if row[1] == "ok"]
    assert (counts[:10], counts[10:]) == ([250] * 10, [120] * 20)
    assert len(rows) == 30 + 5  # and five messages that were no images
    assert (tmp_path / "out-2" / "causal.txt").read_text().count("\n") == 10
    run_of(recording, tmp_path / "run", config=gvo.Config(klt={"n_corners": 120}))
    assert_same_files(tmp_path / "out-3", tmp_path / "run")
    said = "".join(odometry.errors)
    for words in (
        "dynamic_reconfigure: klt.n_corners=-1",
        f"a new run begins in {tmp_path / 'out-2'}: it was reset",
        f"a new run begins in {tmp_path / 'out-3'}: the stamps go back",
        "the master ends the node",
        "5 of 35 frames are faulty",
    ):
        assert said.count(words) == 1, (words, said)
    assert "Traceback" not in said


@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("uri", "words", "fault"),
    [
        ("http://127.0.0.1:9", [], "no master answers at http://127.0.0.1:9"),
        ("nowhere", [], "no master answers at nowhere"),
        ("", ["_x:=["], "invalid command-line parameters"),
        ("", ["left"], "expected ros1 [FROM:=TO...]"),
    ],
)
def test_what_cannot_begin_ends_in_one_line(
    uri: str, words: list[str], fault: str, ros: Ros, tmp_path: Path
) -> None:
    world = ros.environment | ({"ROS_MASTER_URI": uri} if uri else {})
    command = [*GVO[1:], "live", "ros1", *words, "--out", tmp_path / "out"]
    answer = python(*command, env=world, timeout=PATIENCE_S)
    assert fault in refused(answer)
    assert not (tmp_path / "out").exists()


@pytest.mark.acceptance
def test_without_rospy_a_line_says_what_to_install(tmp_path: Path) -> None:
    elsewhere = "import gvo.live.ros1; gvo.live.ros1._DEBIAN = '/nowhere'"
    program = f"{elsewhere}; from gvo.cli import main; main()"
    answer = python("-c", program, "live", "ros1", "--out", tmp_path / "out", timeout=PATIENCE_S)
    assert "apt-get install python3-rospy" in refused(answer)
