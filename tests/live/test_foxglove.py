"""A server for Foxglove, asked by a plain WebSocket client in another process."""

import base64
import json
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import gvo
from gvo.config import Config, Parameters
from gvo.errors import ConfigurationError
from gvo.live.foxglove import Foxglove
from gvo.live.transport import SET_POSE, TRIGGER, NetworkWriter, Service, decode
from gvo.runs.outputs.bag import RunMessages
from gvo.runs.outputs.frames import RunFrames
from gvo.types import FrameResult, StereoFrame
from tests.conftest import Command, assert_open_to_this_machine_alone, refused
from tests.live.conftest import N_FRAMES
from tests.live.pipe import LiveCommand, sent
from tests.viz.view.fakes import result_of

# Between lines of JSON, a text or bytes in base 64, and a WebSocket.
_RELAY = """
import base64, json, sys, threading
from websockets.sync.client import connect

def send():
    for line in sys.stdin:
        content = json.loads(line)
        text = isinstance(content, str)
        socket.send(content if text else base64.b64decode(content["bytes"]))

with connect(sys.argv[1], subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
    threading.Thread(target=send, daemon=True).start()
    for message in socket:
        if isinstance(message, bytes):
            message = json.dumps({"op": message[0], "bytes": base64.b64encode(message).decode()})
        print(message, flush=True)
"""
_LIMIT_S = 60.0
_DATA, _CALL, _ANSWER = 1, 2, 3


class Client:
    """A client in a process of its own; it is ended where an answer does not come."""

    def __init__(self, url: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _RELAY, url],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._timer = threading.Timer(_LIMIT_S, self.process.kill)
        self._timer.start()
        self.info = self.next("serverInfo")
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.data: list[tuple[str, int, bytes]] = []
        self.said = ""

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *exception: object) -> None:
        self._timer.cancel()
        self.process.kill()
        self.process.communicate()

    def send(self, op: str, **fields: object) -> None:
        self._send(json.dumps({"op": op, **fields}))

    def send_bytes(self, data: bytes) -> None:
        self._send({"bytes": base64.b64encode(data).decode()})

    def _send(self, content: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(content) + "\n")
        self.process.stdin.flush()

    def next(self, *ops: str | int) -> dict[str, Any]:
        """Return the next message of a kind, and note what comes before."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            message: dict[str, Any] = json.loads(line)
            self._note(message)
            if message["op"] in ops:
                return message
        raise AssertionError(f"the connection ended before {ops}")

    def _note(self, message: dict[str, Any]) -> None:
        if message["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in message["channels"]}
        elif message["op"] == "advertiseServices":
            self.services |= {service["name"]: service for service in message["services"]}
        elif message["op"] == "status":
            self.said = str(message["message"])
        elif message["op"] == _DATA:
            data = base64.b64decode(message["bytes"])
            number, stamp_ns = struct.unpack_from("<xIQ", data)
            topics = {channel["id"]: topic for topic, channel in self.channels.items()}
            self.data.append((topics[number], stamp_ns, data[13:]))

    def subscribe(self, *topics: str) -> None:
        numbers = [self.channels[topic]["id"] for topic in topics]
        pairs = [{"id": number, "channelId": number} for number in numbers]
        self.send("subscribe", subscriptions=pairs)
        self.parameters()  # answered after it

    def parameters(self, *names: str) -> dict[str, object]:
        self.send("getParameters", parameterNames=names, id="asked")
        return self.answered("asked")

    def assign(self, **wanted: object) -> dict[str, object]:
        given = [{"name": name, "value": value} for name, value in wanted.items()]
        self.send("setParameters", parameters=given, id="set")
        return self.answered("set")

    def answered(self, id_: str) -> dict[str, object]:
        """Return the values that answer a request, not those told in between."""
        while (message := self.next("parameterValues")).get("id") != id_:
            pass
        return values(message)

    def receive(self, n: int) -> None:
        while len(self.data) < n:
            self.next(_DATA)

    def call(self, name: str, request: bytes, encoding: bytes = b"cdr") -> bytes | str:
        head = struct.pack("<BIII", _CALL, self.services[name]["id"], 7, len(encoding))
        self.send_bytes(head + encoding + request)
        answer = self.next(_ANSWER, "serviceCallFailure")
        if answer["op"] != _ANSWER:
            return str(answer["message"])
        return base64.b64decode(answer["bytes"])[13 + len(b"cdr") :]


def values(message: Mapping[str, Any]) -> dict[str, object]:
    return {each["name"]: each["value"] for each in message["parameters"]}


@pytest.fixture
def server() -> Iterator[Foxglove]:
    opened = Foxglove(port=0)
    yield opened
    opened.close()


class Noting(NetworkWriter):
    def __init__(self, sink: Foxglove) -> None:
        super().__init__(sink, "foxglove")
        self.noted: list[tuple[str, int, str, bytes]] = []

    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        self.noted.append((topic, stamp_ns, type_, self.serialize(message, type_)))
        super().write(topic, type_, message, stamp_ns, is_latched=is_latched)


def tracked(index: int) -> tuple[StereoFrame, FrameResult]:
    left, right = np.random.default_rng(index).integers(0, 256, (2, 48, 64), dtype=np.uint8)
    result = result_of(index)
    return StereoFrame(stamp_ns=result.stamp_ns, left=left, right=right), result


def test_a_client_gets_messages_of_a_run_and_nothing_is_drawn_for_nobody(server: Foxglove) -> None:
    writer = Noting(server)
    messages = RunMessages(writer, RunFrames(is_world_optical=True))
    for index in (0, 6, 12):
        messages.add_frame(*tracked(index))
    unheard = "/gvo/matches/compressed"
    with Client(server.url) as client:
        client.next("advertise")
        assert {topic for topic, *_ in writer.noted} == {*client.channels}
        heard = {*client.channels} - {unheard}
        assert heard >= {"/tf", "/tf_static", "/gvo/points", "/gvo/raw/path", "/gvo/odom/odometry"}
        client.subscribe(*heard)
        client.receive(1)
        latched = [each for each in writer.noted if each[0] == "/tf_static"]
        assert [each[:2] for each in client.data] == [each[:2] for each in latched]
        writer.noted.clear()
        client.data.clear()
        for index in (18, 24):
            messages.add_frame(*tracked(index))
        assert unheard not in {topic for topic, *_ in writer.noted}
        noted = [each for each in writer.noted if each[0] in heard]
        client.receive(len(noted))
        assert client.data == [(topic, stamp_ns, data) for topic, stamp_ns, _, data in noted]
        for topic, _, type_, data in noted:
            assert client.channels[topic]["schemaName"] == type_
            assert read_by_its_schema(client.channels[topic], data) == data


def read_by_its_schema(channel: Mapping[str, str], data: bytes) -> bytes:
    """Decode a message by what its channel says of it alone, and return it encoded again."""
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    store, name = get_typestore(Stores.EMPTY), channel["schemaName"]
    store.register(get_types_from_msg(channel["schema"], name))
    return bytes(store.serialize_cdr(store.deserialize_cdr(data, name), name))


def test_parameters_are_seen_set_refused_and_followed(server: Foxglove) -> None:
    parameters = Parameters(Config())
    server.offer(parameters)
    with Client(server.url) as client:
        assert {"parameters", "parametersSubscribe"} <= {*client.info["capabilities"]}
        shown = client.parameters()
        config = Config().model_dump()
        assert {*shown} == {f"{name}.{key}" for name in config for key in config[name]}
        corners = config["klt"]["n_corners"]
        assert (shown["klt.n_corners"], shown["camera.readout_ms"]) == (corners, "null")
        assert client.parameters("klt.n_corners", "no.such") == {"klt.n_corners": corners}

        wanted = {"klt.n_corners": 300, "window.size": "null"}
        client.send("subscribeParameterUpdates", parameterNames=[*wanted])
        assert client.assign(**wanted) == wanted
        assert (parameters.config.klt.n_corners, parameters.config.window.size) == (300, None)

        assert client.assign(**{"klt.n_corners": -1}) == {"klt.n_corners": 300}
        assert "klt.n_corners=-1" in client.said
        assert parameters.config.klt.n_corners == 300


def pose_request(x: float) -> bytes:
    """Return a request of SetPose as CDR: stamp, frame, position, orientation, covariance."""
    head = struct.pack("<4sIII", b"\0\1\0\0", 12, 34, 4) + b"map\0"
    return head + struct.pack("<43d", x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *[0.0] * 36)


def test_services_are_called(server: Foxglove) -> None:
    asked: list[Any] = []

    def reset(request: object) -> dict[str, object]:
        asked.append(request)
        return {"success": True, "message": f"call {len(asked)}"}

    def set_pose(request: Any) -> dict[str, object]:
        asked.append(request.pose.pose.pose.position.x)
        return {}

    server.serve(Service(name="/gvo/reset", type=TRIGGER, answer=reset))
    server.serve(Service(name="/gvo/set_pose", type=SET_POSE, answer=set_pose))
    with Client(server.url) as client:
        client.next("advertiseServices")
        client.parameters()
        assert client.services["/gvo/reset"]["type"] == "std_srvs/srv/Trigger"
        for number, empty in enumerate((b"\0\1\0\0\0", b"\0\1\0\0"), start=1):
            answer = client.call("/gvo/reset", empty)
            assert isinstance(answer, bytes)
            message = decode(answer, TRIGGER.response_type, is_ros1=False)
            assert (message.success, message.message) == (True, f"call {number}")

        definition = client.services["/gvo/set_pose"]["request"]
        assert "PoseWithCovarianceStamped pose" in definition["schema"]
        request = pose_request(3.5)
        answer = client.call("/gvo/set_pose", request)
        assert asked[-1] == 3.5
        assert isinstance(answer, bytes)
        assert "a message of 5 bytes is not a" in str(client.call("/gvo/set_pose", b"\0\1\0\0"))
        assert "ncoding" in str(client.call("/gvo/set_pose", request, encoding=b"json"))


def test_it_listens_on_this_machine_alone_and_a_port_that_is_taken_is_told(
    server: Foxglove,
) -> None:
    port = int(server.url.rpartition(":")[2])
    assert_open_to_this_machine_alone(port)
    with pytest.raises(ConfigurationError, match=f"cannot listen on 127.0.0.1:{port}: ") as raised:
        Foxglove(port=port)
    assert "\n" not in str(raised.value)
    with pytest.raises(ConfigurationError, match=r"cannot listen on 192\.0\.2\.1:0: "):
        Foxglove(host="192.0.2.1", port=0)


def test_the_command_ends_in_one_line_where_the_port_is_taken_or_the_package_missing(
    server: Foxglove, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = [f"--foxglove={server.url.removeprefix('ws://')}", f"--out={tmp_path / 'out'}"]
    assert "cannot listen on 127.0.0.1" in refused(command("live", "-", *options))
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, "gvo.live.foxglove")
    assert "pip install" in refused(command("live", "-", *options))
    assert not (tmp_path / "out").exists()


@pytest.mark.acceptance
def test_the_command_serves_its_run_to_foxglove(drive_bag: Path, tmp_path: Path) -> None:
    source = gvo.open_recording(drive_bag)
    odometry, causal, state = "/gvo/odom/odometry", "/gvo/causal/odometry", "/diagnostics"
    with LiveCommand(source.info, tmp_path, "--foxglove=0") as run:
        with Client(run.said("serves Foxglove")) as client:
            while not {odometry, causal, state} <= {*client.channels}:
                client.next("advertise")
            client.subscribe(odometry, causal, state)
            assert client.assign(**{"klt.n_corners": 150}) == {"klt.n_corners": 150}
            run.feed(sent(source))
            while sum(topic == odometry for topic, *_ in client.data) < N_FRAMES:
                client.next(_DATA)
            TRIGGER.register(is_ros1=False)
            saved = client.call("/gvo/save", b"\0\1\0\0")
            assert isinstance(saved, bytes)
            answer = decode(saved, TRIGGER.response_type, is_ros1=False)
            assert (answer.success, answer.message) == (True, f"{N_FRAMES} frames are written")
        assert run.end() == 0, run.errors
    assert f"{N_FRAMES} frames, all tracked" in "".join(run.lines)
    assert "foxglove" not in "".join(run.errors).replace("serves Foxglove", "").lower()
    poses = [each for topic, _, each in decoded(client) if topic == causal]
    positions = [(p.x, p.y, p.z) for p in (each.pose.pose.position for each in poses)]
    written = gvo.read_trajectory(run.out / "causal.txt")
    np.testing.assert_allclose(positions, written.positions, atol=1e-8)
    told = [each.status[0] for topic, _, each in decoded(client) if topic == state]
    counts = [{v.key: v.value for v in each.values}.get("keypoints", "") for each in told]
    found = [int(count) for count in counts if count]
    assert 0 < max(found) <= 150


def decoded(client: Client) -> Iterator[tuple[str, int, Any]]:
    for topic, stamp_ns, data in client.data:
        type_ = client.channels[topic]["schemaName"]
        yield topic, stamp_ns, decode(data, type_, is_ros1=False)
