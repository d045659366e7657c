"""ROS 1: what `gvo.live.ros1` and rospy say to each other; `gvo live ros1` as a whole."""

import ast
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.config import list_parameters
from gvo.types import FloatArray
from tests.conftest import GVO, assert_same_files, python, refused, run_of
from tests.live.pipe import PATIENCE_S, Program
from tests.live.ros1 import Ros, master
from tests.make.blind_walk import BLIND, blind_walk

pytestmark = pytest.mark.ros1

FOLDER = Path(__file__).parent
DRIVER = FOLDER / "ros1_driver.py"
PLAYER = FOLDER.parents[1] / "scripts" / "ros" / "play.py"


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
def test_what_is_played_is_tracked_as_from_its_files(
    ros: Ros, gvo_data: Path, tmp_path: Path
) -> None:
    recording = gvo_data / "kitti_06_start"
    run_of(recording, tmp_path / "run")
    expected = gvo.read_trajectory(tmp_path / "run" / "causal.txt")
    odometry = live(ros, tmp_path / "out")
    watcher = ros.start(DRIVER)
    watcher.wait_for("watching")
    player = ros.start(PLAYER, recording)
    player.wait_for("pairs sent")
    assert player.end() == 0
    assert odometry.interrupt() == 0, odometry.errors
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
def test_an_imu_that_is_played_carries_the_camera_through_the_dark(tmp_path: Path) -> None:
    gvo.convert(blind_walk(), tmp_path / "walk.bag")
    out = tmp_path / "out"
    with master(tmp_path) as ros:
        ros.use_simulated_clock()
        odometry = live(ros, out, "--imu", "imu", "--set", "imu.delay_ms=0")
        player = ros.start(PLAYER, tmp_path / "walk.bag")
        player.wait_for("pairs sent")
        assert player.end() == 0
        assert odometry.interrupt() == 0, odometry.errors
    odometry.wait_for("imu: /imu (1 messages); placed by tf")
    told = json.loads((out / "summary.json").read_text())["imu"]
    assert (told["n_carried"], told["n_restarts"]) == (len(BLIND), 0)


@pytest.mark.acceptance
@pytest.mark.recorded
def test_a_session_goes_on_whatever_comes(ros: Ros, gvo_data: Path, tmp_path: Path) -> None:
    recording = gvo_data / "kitti_06_start"
    driver = ros.start(DRIVER, recording)
    driver.wait_for("introduced")  # CameraInfo is sent once, and not again
    odometry = live(ros, tmp_path / "out")
    for index in range(40):
        driver.wait_for(f"pair {index}\n")
    check_parameters(json.loads(driver.wait_for("parameters ").partition(" ")[2]))
    driver.interrupt(signal.SIGKILL)
    odometry.wait_for("no images for")
    # A new time counts from its third image on.
    player = ros.start(PLAYER, recording, "--ahead", "3")
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
        "the pose is not set: it is of elsewhere",
        f"a new run begins in {tmp_path / 'out-2'}: it was reset",
        f"a new run begins in {tmp_path / 'out-3'}: the stamps go back",
        "the master ends the node",
        "5 of 35 frames are faulty",
    ):
        assert said.count(words) == 1, (words, said)
    assert "Traceback" not in said


def check_parameters(told: dict[str, Any]) -> None:
    """Check what the client of dynamic_reconfigure was told."""
    listed = [one for each in list_parameters().values() for one in each]
    assert told["n"] == len(listed)
    assert told["groups"] == [*list_parameters()]
    corners, readout = told["corners"], told["readout"]
    assert (corners["type"], corners["min"], corners["max"]) == ("int", 50, 20000)
    assert "default 250" in corners["description"]
    assert (readout["type"], readout["default"]) == ("str", "null")
    choices = [choice["value"] for choice in ast.literal_eval(told["kind"])["enum"]]
    assert choices == ["orb", "sift", "fast", "gftt"]
    assert told["answers"] == [120, 120, "3.5", "null", "sift", "orb"]


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
