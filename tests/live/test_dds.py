"""ROS 2's topics and services over DDS, against plain CycloneDDS in another process."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.errors import ConfigurationError
from gvo.io.bag.reader import typestore
from gvo.live.transport import Service, ServiceType, decode

pytest.importorskip("cyclonedds")

from gvo.live.dds import Dds, sockets
from tests.conftest import GVO, Command, assert_same_files, refused, run_of
from tests.live.pipe import Program
from tests.make.blind_walk import BLIND, blind_walk

pytestmark = pytest.mark.dds

HOLD_S = 60.0
STRING = "std_msgs/msg/String"

# Types as an IDL file declares them, and what a program of another maker does with them.
PEER = '''
import queue, sys, threading
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, float64, int32, int64, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

def struct(package, name, /, **fields):
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)

String = struct("std_msgs", "String", data=str)
Time = struct("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = struct("std_msgs", "Header", stamp=Time, frame_id=str)
Image = struct("sensor_msgs", "Image", header=Header, height=uint32, width=uint32,
    encoding=str, is_bigendian=uint8, step=uint32, data=sequence[uint8])
Region = struct("sensor_msgs", "RegionOfInterest",
    x_offset=uint32, y_offset=uint32, height=uint32, width=uint32, do_rectify=bool)
CameraInfo = struct("sensor_msgs", "CameraInfo", header=Header, height=uint32, width=uint32,
    distortion_model=str, d=sequence[float64], k=array[float64, 9], r=array[float64, 9],
    p=array[float64, 12], binning_x=uint32, binning_y=uint32, roi=Region)
Vector3 = struct("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Point = struct("geometry_msgs", "Point", x=float64, y=float64, z=float64)
Quaternion = struct("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Pose = struct("geometry_msgs", "Pose", position=Point, orientation=Quaternion)
Twist = struct("geometry_msgs", "Twist", linear=Vector3, angular=Vector3)
Imu = struct("sensor_msgs", "Imu", header=Header,
    orientation=Quaternion, orientation_covariance=array[float64, 9],
    angular_velocity=Vector3, angular_velocity_covariance=array[float64, 9],
    linear_acceleration=Vector3, linear_acceleration_covariance=array[float64, 9])
CovariantPose = struct(
    "geometry_msgs", "PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
CovariantTwist = struct(
    "geometry_msgs", "TwistWithCovariance", twist=Twist, covariance=array[float64, 36])
Odometry = struct("nav_msgs", "Odometry",
    header=Header, child_frame_id=str, pose=CovariantPose, twist=CovariantTwist)
Transform = struct("geometry_msgs", "Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = struct("geometry_msgs", "TransformStamped",
    header=Header, child_frame_id=str, transform=Transform)
Transforms = struct("tf2_msgs", "TFMessage", transforms=sequence[TransformStamped])
Clock = struct("rosgraph_msgs", "Clock", clock=Time)

NETWORK = Domain(DOMAIN, '<CycloneDDS><Domain><General><Interfaces>'
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General></Domain></CycloneDDS>')
PARTICIPANT = DomainParticipant(DOMAIN)
RELIABLE = Policy.Reliability.Reliable(duration(seconds=10))
HELD = Policy.Durability.TransientLocal
KEPT = Policy.History.KeepLast(10)

HEADER = {"guid": uint64, "sequence": int64}

def writer(name, type_, *policies):
    return DataWriter(PARTICIPANT, Topic(PARTICIPANT, name, type_), Qos(KEPT, *policies))

def reader(name, type_, *policies):
    return DataReader(PARTICIPANT, Topic(PARTICIPANT, name, type_), Qos(KEPT, *policies))

END, LINES = threading.Event(), queue.Queue()

def listen():
    for line in sys.stdin:
        LINES.put(line)
    END.set()

threading.Thread(target=listen, daemon=True).start()

def wait(is_so):
    while not is_so():
        if END.wait(0.005):
            sys.exit()

def say(*words):
    print(*words, flush=True)

def client(name, package, type_, answered):
    """Types of services are told by their header alone; `rmw_cyclonedds` tells nothing of them."""
    request, response = (
        make_idl_struct(end, f"{package}::srv::dds_::{type_}_{end}_", HEADER, dataclassify=False)
        for end in ("Request", "Response"))
    request.serialize = lambda self, **_: self.full.serialize()
    response.deserialize = classmethod(lambda _, data, **__: answered.deserialize(data))
    asks = writer(f"rq{name}Request", request, RELIABLE)
    hears = reader(f"rr{name}Reply", response, RELIABLE)
    wait(lambda: asks.matched_sub and hears.matched_pub)

    def send(number, full):
        sample = request()
        sample.full = full
        asks.write(sample)

    def answer(number):
        found = hears.take_one(timeout=duration(seconds=60))
        assert (found.guid, found.sequence) == (77, number)
        return found

    return send, answer
'''


class Peer(Program):
    """A process of plain CycloneDDS; it ends where its standard input does."""

    def __init__(self, domain: int, source: str) -> None:
        content = f"DOMAIN = {domain}\n{PEER}\n{source}\nEND.wait()\n"
        super().__init__([sys.executable, "-c", content], {**os.environ})
        self._n_read = 0

    def line(self) -> str:
        self._n_read += 1
        return self.wait_for("", n=self._n_read, is_output=True).rstrip("\n")


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """Return a domain that no other worker of this session has."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    number = 1 + (os.getppid() + worker) % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    for name in ("CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(name, raising=False)
    return number


@pytest.fixture
def peer(domain: int) -> Iterator[Callable[[str], Peer]]:
    peers = []

    def start(source: str) -> Peer:
        peers.append(Peer(domain, source))
        return peers[-1]

    yield start
    for made in peers:
        made.end()


@pytest.fixture
def dds(domain: int) -> Iterator[Dds]:
    made = Dds(qos="reliable")
    yield made
    made.close()


class Inbox:
    """What came on a topic of a peer."""

    def __init__(self, dds: Dds, topic: str) -> None:
        hold, end_s = threading.Event(), time.monotonic() + HOLD_S
        while not (found := [each for each in dds.topics() if each.name == topic]):
            assert time.monotonic() < end_s, topic
            hold.wait(0.005)
        (self.topic,) = found
        self._came: queue.Queue[tuple[bytes, int]] = queue.Queue()
        dds.subscribe(topic, self.topic.type, lambda *came: self._came.put(came))

    def take(self) -> tuple[Any, int]:
        data, stamp_ns = self._came.get(timeout=HOLD_S)
        return decode(data, self.topic.type, is_ros1=False), stamp_ns


def string(text: str) -> bytes:
    store = typestore(is_ros1=False)
    return bytes(store.serialize_cdr(store.types[STRING](data=text), STRING))


@pytest.mark.acceptance
def test_what_is_held_for_late_ones_is_received(dds: Dds, peer: Callable[[str], Peer]) -> None:
    other = peer("""
out = writer("rt/held", String, RELIABLE, HELD)
out.write(String("early"))
plain = writer("rt/plain", String, RELIABLE)
plain.write(String("nobody hears it"))
say("written")
wait(lambda: plain.matched_sub)
plain.write(String("heard"))
""")
    assert other.line() == "written"
    assert Inbox(dds, "/held").take()[0].data == "early"
    assert Inbox(dds, "/plain").take()[0].data == "heard"


@pytest.mark.acceptance
@pytest.mark.parametrize("qos", ["sensor", "system"])
def test_best_effort_is_enough(domain: int, qos: Any, peer: Callable[[str], Peer]) -> None:
    """A peer of best effort has no reliable readers: it is heard by those who ask for no more."""
    peer("""
out = writer("rt/cam/image", Image, Policy.Reliability.BestEffort)
while not END.wait(0.02):
    out.write(Image(Header(Time(7, 0), "cam"), 1, 1, "mono8", 0, 1, b"x"))
""")
    dds = Dds(qos=qos)
    try:
        assert Inbox(dds, "/cam/image").take()[0].header.frame_id == "cam"
    finally:
        dds.close()


@pytest.mark.acceptance
def test_the_clock_of_a_simulation_is_the_clock(dds: Dds, peer: Callable[[str], Peer]) -> None:
    peer("""
clock = writer("rt/clock", Clock, RELIABLE)
out = writer("rt/a", String, RELIABLE)
wait(lambda: clock.matched_sub and out.matched_sub)
while not END.wait(0.02):
    clock.write(Clock(Time(5, 7)))
    out.write(String("a"))
""")
    inbox = Inbox(dds, "/a")
    stamps_ns = iter(lambda: inbox.take()[1], 5_000_000_007)
    assert all(stamp_ns > 5_000_000_007 for stamp_ns in stamps_ns)


@pytest.mark.acceptance
def test_what_is_sent_is_read_by_another_program(dds: Dds, peer: Callable[[str], Peer]) -> None:
    held = dds.advertise("/held", STRING, is_latched=True)
    for text in ("first", "last"):
        held.publish(string(text), 0)
    sent = dds.advertise("/sent", STRING)
    assert not sent.is_heard
    assert not dds.topics()
    other = peer("""
for name, policies in (("rt/held", [HELD]), ("rt/sent", [])):
    say(reader(name, String, RELIABLE, *policies).take_one(timeout=duration(seconds=60)).data)
""")
    assert other.line() == "last"
    hold = threading.Event()
    while not sent.is_heard:
        hold.wait(0.005)
    sent.publish(string("heard"), 0)
    assert other.line() == "heard"


@pytest.mark.acceptance
def test_a_service_answers_who_asked_and_survives_what_is_no_request(
    dds: Dds, peer: Callable[[str], Peer], caplog: pytest.LogCaptureFixture
) -> None:
    type_ = ServiceType(name="gvo_test/srv/Echo", request="string text", response="string text")
    dds.serve(Service(name="/gvo/echo", type=type_, answer=lambda asked: {"text": asked.text * 2}))
    other = peer("""
Text = struct("gvo_test", "Text", **HEADER, text=str)

class Damaged:
    def serialize(self, **_):
        return Text(77, 1, "abc").serialize()[:20] + (1 << 31).to_bytes(4, "little") + b"ab"

send, answer = client("/gvo/echo", "gvo_test", "Echo", Text)
send(1, Damaged())
send(2, Text(77, 2, "ab"))
say(answer(2).text)
""")
    assert other.line() == "abab"
    assert "/gvo/echo: a request is ignored" in caplog.text


@pytest.mark.linux
def test_no_port_is_open_beyond_loopback(domain: int) -> None:
    before = sockets()
    dds = Dds()
    try:
        made = sockets() - before
        assert made
        for number in made:
            with socket.socket(fileno=os.dup(number)) as each:
                device = each.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                assert device.rstrip(b"\0") == b"lo"
    finally:
        dds.close()
    assert sockets() == before


def test_a_domain_that_cannot_be_joined_is_told(
    dds: Dds, domain: int, monkeypatch: pytest.MonkeyPatch, command: Command, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=f"ROS_DOMAIN_ID={domain} cannot be joined"):
        Dds()
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    said = refused(command("live", "ros2", "--out", tmp_path / "run"))
    assert "expected a number from 0 to 232, got 233" in said


# Plays a bag: each pair once the pose of the last has come, with all transforms of its stamp, and
# after the samples of an IMU up to 10 ms later.
PLAYER = """
from pathlib import Path
from gvo.io.bag.reader import BagReader

def raw(type_, data):
    sample = type_.__new__(type_)
    sample.serialize = lambda **_: data
    return sample

types = {"Image": Image, "CameraInfo": CameraInfo, "Imu": Imu, "TFMessage": Transforms}
held = CameraInfo, Transforms
bag = BagReader(Path(BAG))
kinds = {topic.name: types[topic.type.rpartition("/")[2]] for topic in bag.topics if
         topic.name != "/tf"}
writers = {name: writer("rt" + name, type_, RELIABLE, *([HELD] if type_ in held else []))
           for name, type_ in kinds.items()}
messages = [*bag.messages(kinds)]
for name, type_ in kinds.items():
    if type_ in held:
        first = next(each for each in messages if each.topic.name == name)
        writers[name].write(raw(type_, first.data))
answers = reader("rt/gvo/odom/odometry", Odometry, RELIABLE)
moves = DataReader(PARTICIPANT, Topic(PARTICIPANT, "rt/tf", Transforms),
    Qos(RELIABLE, Policy.History.KeepLast(1000)))
images = [each for each in messages if kinds[each.topic.name] is Image]
samples = [each for each in messages if kinds[each.topic.name] is Imu]
outs = [writers[name] for name in {each.topic.name for each in images}]

def is_joined():
    for each in samples[:1]:  # so that it is not silent
        writers[each.topic.name].write(raw(Imu, each.data))
    return all(out.matched_sub for out in outs) and answers.matched_pub and moves.matched_pub

wait(is_joined)
stamps = []
for first, second in zip(images[::2], images[1::2], strict=True):
    while samples and samples[0].log_time_ns < first.log_time_ns + 10_000_000:
        each = samples.pop(0)
        writers[each.topic.name].write(raw(Imu, each.data))
    for each in (first, second):
        writers[each.topic.name].write(raw(Image, each.data))
    answer = answers.take_one(timeout=duration(seconds=60))
    stamps.append((answer.header.stamp.sec, answer.header.stamp.nanosec))
say(len(stamps), answer.header.frame_id, answer.child_frame_id)
moved = [(each.header.stamp.sec, each.header.stamp.nanosec) for each in
    (each for message in moves.take(1000) for each in message.transforms)
    if each.child_frame_id == answer.child_frame_id]
say(moved == stamps)
"""


class LiveRos2:
    """`gvo live ros2` that tracks what a peer plays; interrupted at the end."""

    def __init__(self, bag: Path, out: Path, peer: Callable[[str], Peer], *options: str) -> None:
        words = ["--qos", "reliable", "--out", str(out), "--no-report", *options]
        with subprocess.Popen(
            [*GVO, "live", "ros2", *words], stderr=subprocess.PIPE, text=True
        ) as live:
            try:
                player = peer(f"BAG = {str(bag)!r}\n{PLAYER}")
                self.lines = [player.line(), player.line()]
            finally:
                live.send_signal(signal.SIGINT)
                _, self.errors = live.communicate(timeout=HOLD_S)
        assert live.returncode == 0, self.errors


@pytest.mark.recorded
@pytest.mark.acceptance
def test_a_drive_that_another_program_plays_is_tracked_as_in_its_bag(
    gvo_data: Path, domain: int, tmp_path: Path, peer: Callable[[str], Peer]
) -> None:
    bag = tmp_path / "drive.mcap"
    gvo.convert(gvo.open_recording(gvo_data / "kitti_06_start"), bag)
    run_of(bag, tmp_path / "run")
    live = LiveRos2(bag, tmp_path / "live", peer)
    assert live.lines == ["51 gvo/odom gvo/odom/camera_left_optical", "True"]
    assert_same_files(tmp_path / "live", tmp_path / "run")


@pytest.mark.acceptance
def test_an_imu_that_another_program_plays_carries_the_camera_through_the_dark(
    domain: int, tmp_path: Path, peer: Callable[[str], Peer]
) -> None:
    bag = tmp_path / "walk.mcap"
    gvo.convert(blind_walk(), bag)
    live = LiveRos2(bag, tmp_path / "live", peer, "--set", "imu.delay_ms=0")
    assert "imu: /imu (1 messages); placed by tf " in live.errors
    told = json.loads((tmp_path / "live" / "summary.json").read_text())["imu"]
    assert (told["n_carried"], told["n_restarts"]) == (len(BLIND), 0)
