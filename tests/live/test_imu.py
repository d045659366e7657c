"""An IMU beside a camera in a network: chosen as in a bag, waited for a little, never for long."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.config import Config
from gvo.geometry.imu import ImuSamples
from gvo.io.bag.imu import BagImu
from gvo.io.bag.messages import header_stamp
from gvo.io.bag.reader import BagMessage, BagReader, serialize
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.topics import IMAGE_TYPES, IMU_TYPE, Topic, TopicChoice
from gvo.io.synthetic import rendered_imu
from gvo.live import imu as live_imu
from gvo.live import topics
from gvo.live.imu import ImuQueue
from gvo.live.topics import NetworkReader, TopicSource, wait_for
from tests.conftest import TABLES, Command, assert_same_files, run_of
from tests.live.network import ODOMETRY, SECOND_NS, Network, Play, recorded, shifted
from tests.make.bags import imu
from tests.make.blind_walk import BLIND, blind_walk, stamps_of, true_twists
from tests.make.blind_walk import N_FRAMES as N_WALK

FACTS: Any = {"delay_s": 0.0}
N_HAND = 26
MS = 1_000_000


@pytest.fixture(scope="session")
def walk_bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return bags of a walk with an IMU on which the camera is blind for a while."""
    folder = tmp_path_factory.mktemp("bags")
    bags = {name: folder / f"walk.{name}" for name in ("mcap", "bag")}
    for path in bags.values():
        gvo.convert(blind_walk(), path)
    return bags


@pytest.fixture(scope="session")
def walk_run(walk_bags: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run over such a bag."""
    out, config = (
        tmp_path_factory.mktemp("walk_run"),
        Config.model_validate({"imu": {"delay_ms": 0}}),
    )
    check_carried(run_of(walk_bags["mcap"], out, config=config))
    return out


@pytest.fixture(scope="session")
def hand_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a short walk with an IMU."""
    path = tmp_path_factory.mktemp("bags") / "hand.mcap"
    walk = gvo.SyntheticRecording(
        "handheld", "stereo", n_frames=N_HAND, scale=0.25, imu=rendered_imu()
    )
    gvo.convert(walk, path)
    return path


class Steps:
    """The messages of a play in steps of a pair of images and the samples up to it."""

    def __init__(self, play: Play) -> None:
        self._send, kinds = play.network.send, (IMU_TYPE, *IMAGE_TYPES)
        self._samples = deque(each for each in play.messages if each.topic.type == IMU_TYPE)
        images = [each for each in play.messages if each.topic.type in IMAGE_TYPES]
        self.pairs = [*zip(images[::2], images[1::2], strict=True)]
        for message in play.messages:
            if message.topic.type not in kinds:
                self._send(message)

    def send_pair(self, k: int) -> None:
        for message in self.pairs[k]:
            self._send(message)

    def send_samples(self, k: int) -> None:
        """Send those up to 10 ms after a pair."""
        end_ns = stamp_ns_of(self.pairs[k][0]) + 10 * MS
        while self._samples and stamp_ns_of(self._samples[0]) <= end_ns:
            self._send(self._samples.popleft())

    def send_rest(self) -> None:
        while self._samples:
            self._send(self._samples.popleft())


def stamp_ns_of(message: BagMessage) -> int:
    stamp_ns = header_stamp(message)
    assert stamp_ns is not None
    return stamp_ns


def apart(messages: Sequence[BagMessage]) -> list[BagMessage]:
    """Return messages with gyro and accelerometer as topics of their own, as of a RealSense."""
    found = []
    for message in messages:
        if message.topic.type != IMU_TYPE:
            found.append(message)
            continue
        for name, other in (("gyro", "linear_acceleration"), ("accel", "angular_velocity")):
            content = message.decode()
            setattr(content, f"{other}_covariance", np.full(9, -1.0))
            is_ros1 = message.topic.is_ros1
            data = serialize(content, IMU_TYPE, is_ros1=is_ros1)
            channel = Channel(f"/stereo/{name}/sample", IMU_TYPE, is_ros1)
            found.append(BagMessage(channel, message.log_time_ns, data))
    return found


def check_carried(result: gvo.RunResult) -> None:
    told = result.summary["imu"]
    assert (told["n_gaps"], told["n_carried"], told["n_restarts"]) == (1, len(BLIND), 0)
    assert result.summary["frames"] == N_WALK


@pytest.mark.parametrize(("name", "is_apart"), [("mcap", False), ("bag", True)])
def test_frames_wait_for_samples_and_the_dark_is_passed_as_in_a_bag(
    name: str,
    is_apart: bool,
    walk_bags: dict[str, Path],
    walk_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def script(play: Play) -> None:
        steps = Steps(play)
        steps.send_samples(0)
        for k in range(N_WALK):
            steps.send_pair(k)
            assert is_asked.acquire(timeout=60)
            steps.send_samples(k)  # 5 ms later, say
            play.network.wait_for(ODOMETRY, k + 1)

    def until(queue: ImuQueue, stamp_ns: int) -> Iterator[ImuSamples]:
        is_asked.release()
        return ask(queue, stamp_ns)

    is_asked, ask = threading.Semaphore(0), ImuQueue.until
    monkeypatch.setattr(ImuQueue, "until", until)
    monkeypatch.setattr(live_imu, "_PATIENCE_S", 60.0)
    messages = recorded(walk_bags[name])
    play = Play(apart(messages) if is_apart else messages, script, imu=FACTS)
    ((folder, result),) = play.run(tmp_path / "out")
    check_carried(result)
    assert_same_files(folder, walk_run, (*TABLES, "global.txt"))
    # The rate of turn at a frame is a mean of what comes before and after it, here before it.
    found, expected = (
        np.loadtxt(each / "inertial.csv", delimiter=",", skiprows=1) for each in (folder, walk_run)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.01)
    check_twists(play.sent(ODOMETRY))


def check_twists(sent: Sequence[Any]) -> None:
    """Check the velocities sent, in the dark too, and that they are not those of the poses."""
    stamps_ns = stamps_of(blind_walk())
    truth = true_twists(1e-9 * (stamps_ns - stamps_ns[0]), np.eye(4))
    for k in BLIND:
        twist = sent[k].twist
        parts = twist.twist.angular, twist.twist.linear
        found = [getattr(part, axis) for part in parts for axis in "xyz"]
        np.testing.assert_allclose(found, truth[k], rtol=0, atol=0.05)
        assert 0.0 < twist.covariance[0] < 0.01


def test_frames_whose_samples_are_late_go_without_and_the_next_have_them(
    walk_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def script(play: Play) -> None:
        steps = Steps(play)
        steps.send_samples(0)
        for k in range(N_WALK):
            steps.send_pair(k)
            play.network.wait_for(ODOMETRY, k + 1)
            steps.send_samples(k)

    monkeypatch.setattr(live_imu, "_PATIENCE_S", 0.001)
    ((_, result),) = Play(walk_bags["mcap"], script, imu=FACTS).run(tmp_path / "out")
    check_carried(result)


def test_the_imu_begins_anew_with_a_new_run(hand_bag: Path, tmp_path: Path) -> None:
    def script(play: Play) -> None:
        steps = Steps(play)
        for k in range(N_HAND):
            steps.send_samples(k)
            steps.send_pair(k)
        play.network.wait_for(ODOMETRY, N_HAND)
        steps.send_rest()
        play.messages = [shifted(each, -10 * SECOND_NS) for each in play.messages]
        steps = Steps(play)
        for k in range(N_HAND):
            if k >= 4:  # before, the run that ends may take them
                play.network.wait_for(ODOMETRY, N_HAND + k - 3)
            steps.send_samples(k)
            steps.send_pair(k)

    runs = Play(hand_bag, script, imu=FACTS).run(tmp_path / "out")
    assert [each.result.summary["imu"]["has_started"] for each in runs] == [True, True]


def test_an_imu_that_is_silent_keeps_no_camera_waiting(
    hand_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def script(play: Play) -> None:
        for message in play.messages:
            if message.topic.type != IMU_TYPE:
                play.network.send(message)

    monkeypatch.setattr(topics, "_IMU_WITHIN_S", 0.1)
    play = Play(hand_bag, script)
    assert "imu: none: /imu without a message that can be read" in play.source.info.decisions
    ((_, result),) = play.run(tmp_path / "out")
    assert result.is_complete
    assert result.summary["frames"] == N_HAND


@pytest.mark.parametrize(
    ("asked", "missing"), [("/imu", "nothing came on /imu"), ("/gyro", "has no IMU topic /gyro")]
)
def test_the_imu_asked_for_is_waited_for(
    asked: str, missing: str, hand_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "_IMU_WITHIN_S", 0.0)
    network, said, is_said = Network(), list[str](), threading.Event()
    network.announce(BagReader(hand_bag).topics)

    def say(line: str) -> None:
        said.append(line)
        if missing in line:
            is_said.set()

    def send() -> None:
        for message in recorded(hand_bag):
            if message.topic.type != IMU_TYPE:
                network.send(message)

    threading.Thread(target=send, daemon=True).start()
    make = partial(TopicSource, NetworkReader(network), topics=TopicChoice(imu=asked), imu={})
    assert wait_for(make, say, is_said) is None, said


def test_of_two_imus_neither_is_taken_unasked(hand_bag: Path) -> None:
    messages = recorded(hand_bag)
    both = [
        each._replace(topic=each.topic._replace(name=name))
        for each in messages
        for name in (("/a/imu", "/b/imu") if each.topic.name == "/imu" else (each.topic.name,))
    ]
    assert "imu: none: --imu chooses one of /a/imu, /b/imu" in Play(both).source.info.decisions
    play = Play(both, choice=TopicChoice(imu="/b/imu"))
    chosen, waiting = play.source.info.imu, play.source.imu_queue
    assert chosen is not None
    assert waiting is not None
    assert chosen.name == "/b/imu"
    play.wait()  # what came before it was chosen counts too
    n_sent = sum(message.topic.name == "/b/imu" for message in both)
    assert sum(map(len, waiting.until(0))) == n_sent
    near = [
        each._replace(topic=each.topic._replace(name=each.topic.name.replace("/a/", "/stereo/")))
        for each in both
    ]
    found = Play(near).source.info.imu
    assert found is not None
    assert found.name == "/stereo/imu"


def test_samples_that_nobody_takes_push_out_the_oldest_and_no_image(hand_bag: Path) -> None:
    def script(play: Play) -> None:
        play.send_all()
        assert is_found.wait(60)
        last = [each for each in play.messages if each.topic.type == IMU_TYPE][-1]
        for k in range(live_imu.N_WAITING):
            play.network.send(shifted(last, SECOND_NS + k * MS))

    is_found = threading.Event()
    play = Play(hand_bag, script)
    is_found.set()
    play.wait()
    assert play.source.imu_queue is not None
    parts = [*play.source.imu_queue.until(0)]
    assert sum(map(len, parts)) == live_imu.N_WAITING
    assert np.all(np.diff(np.concatenate([part.stamps_ns for part in parts])) == MS)
    assert len([*play.reader.images()]) == 2 * N_HAND
    assert play.reader.n_dropped == 0


def queue_of_one() -> ImuQueue:
    topic = Topic(name="/imu", type=IMU_TYPE, n_messages=1)
    return ImuQueue(BagImu(topic, topic, "", 0), header_stamp)


def sample(stamp_ns: int) -> BagMessage:
    topic, type_, log_time_ns, message = imu("/imu", stamp_ns, (0.1, 0.2, 0.3), (0.0, 0.0, 9.81))
    data = serialize(message, type_, is_ros1=True)
    return BagMessage(Channel(topic, type_, is_ros1=True), log_time_ns, data)


def test_a_frame_waits_until_a_sample_is_as_late_as_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live_imu, "_PATIENCE_S", 60.0)
    waiting, has_first, found = queue_of_one(), threading.Event(), list[int]()

    def take() -> None:
        for samples in waiting.until(7 * MS):
            found.extend(samples.stamps_ns.tolist())
            has_first.set()

    thread = threading.Thread(target=take)
    thread.start()
    waiting.put(sample(5 * MS))
    assert has_first.wait(60)
    waiting.put(sample(10 * MS))
    thread.join(60)
    assert found == [5 * MS, 10 * MS]


def test_samples_that_stop_are_told_once_and_waited_for_no_more(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def n_of(stamp_ns: int) -> int:
        return sum(map(len, waiting.until(stamp_ns)))

    waiting, now_s = queue_of_one(), time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    waiting.put(sample(MS))
    assert n_of(MS) == 1
    for k in range(3):
        assert n_of((k + 2) * MS) == 0  # after 20 ms
        now_s += 0.6
    monkeypatch.setattr(live_imu, "_PATIENCE_S", 30.0)
    assert n_of(5 * MS) == 0
    assert caplog.messages == ["/imu: no samples for 1 s: frames do not wait for them any more"]
    waiting.put(sample(9 * MS))
    assert n_of(9 * MS) == 1
    assert caplog.messages[1:] == ["/imu: samples come again"]


@pytest.mark.parametrize(
    ("words", "line", "has_imu"),
    [
        ([], "imu: /imu (1 messages); placed by tf", True),
        (["--imu=/imu"], "imu: /imu (1 messages); placed by tf", True),
        (["--imu=none"], "", False),
    ],
)
def test_the_command_takes_the_imu_or_leaves_it_out(
    words: list[str],
    line: str,
    has_imu: bool,
    hand_bag: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: Command,
) -> None:
    network = Network()

    def send() -> None:
        for message in recorded(hand_bag):
            if message.topic.type != IMU_TYPE or has_imu:
                network.send(message)
        network.wait_for(ODOMETRY, N_HAND)
        os.kill(os.getpid(), signal.SIGINT)

    network.announce(BagReader(hand_bag).topics)
    monkeypatch.setattr("gvo.live.ros1.Ros1", lambda _: network)
    threading.Thread(target=send, daemon=True).start()
    out = tmp_path / "out"
    answer = command("live", "ros1", *words, "--no-report", "--queue=100", f"--out={out}")
    assert answer.code == 0, answer.err
    assert line in answer.err
    assert ("imu: " in answer.err) == has_imu
    assert network.is_heard("/imu") == has_imu
    assert ("imu" in json.loads((out / "summary.json").read_text())) == has_imu
