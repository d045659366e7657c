"""The node of rclpy, against a replacement of rclpy: that it fits gvo, not that it fits ROS 2."""

import importlib.util
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from gvo.io.bag.reader import BagReader
from gvo.io.bag.topics import COMPRESSED_TYPE, IMAGE_TYPE
from tests.conftest import assert_same_files
from tests.live.conftest import N_FRAMES
from tests.live.network import Network, Outlet, recorded

SCRIPT = Path(__file__).parents[2] / "scripts" / "ros" / "ros2_node.py"
HELD, RELIABLE, BEST_EFFORT = "transient local", "reliable", "best effort"


class Publisher:
    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet

    def publish(self, data: bytes) -> None:
        self._outlet.publish(data, 0)

    def get_subscription_count(self) -> int:
        return 1


class FakeNode:
    """What the script uses of a node of rclpy, over a network in this process."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.received_as: dict[str, Any] = {}
        self.answers: dict[str, Callable[[Any, Any], Any]] = {}
        self.is_destroyed = False

    def get_name(self) -> str:
        return "gvo"

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=1))

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        own = [("/tf", ["tf2_msgs/msg/TFMessage"])]
        return [*((each.name, [each.type]) for each in self.network.announced), *own]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        types = {each.name: each.type for each in self.network.announced}
        is_image = types.get(topic) in (IMAGE_TYPE, COMPRESSED_TYPE)
        offer = SimpleNamespace(
            reliability=BEST_EFFORT if is_image else RELIABLE,
            durability=HELD if topic == "/tf_static" else "volatile",
        )
        name = "camera" if topic in types else "gvo"
        return [SimpleNamespace(node_name=name, qos_profile=offer)]

    def create_subscription(
        self, type_: str, topic: str, take: Callable[[bytes], None], qos: Any, **options: Any
    ) -> object:
        assert options.keys() == {"raw", "callback_group"}
        assert options["raw"] is True
        self.received_as[topic] = qos
        self.network.subscribe(topic, type_, lambda data, _: take(data))
        return topic

    def create_publisher(self, type_: str, topic: str, qos: Any) -> Publisher:
        is_latched = qos.durability == HELD
        return Publisher(self.network.advertise(topic, type_, is_latched=is_latched))

    def create_service(
        self, type_: str, name: str, answer: Callable[[Any, Any], Any], **options: Any
    ) -> None:
        assert type_ == "std_srvs/srv/Trigger"
        assert options.keys() == {"callback_group"}
        self.answers[name] = answer

    def destroy_node(self) -> None:
        self.is_destroyed = True


class FakeExecutor:
    def __init__(self) -> None:
        self._end = threading.Event()

    def add_node(self, node: FakeNode) -> None:
        assert isinstance(node, FakeNode)

    def spin(self) -> None:
        self._end.wait()

    def shutdown(self) -> None:
        self._end.set()


def find_service(name: str) -> str:
    if not name.startswith("std_srvs/"):
        raise ModuleNotFoundError(name)
    return name


def make_qos(depth: int) -> Any:
    return SimpleNamespace(depth=depth, reliability=RELIABLE, durability="volatile")


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> FakeNode:
    made = FakeNode(Network())
    policies = SimpleNamespace(RELIABLE=RELIABLE, BEST_EFFORT=BEST_EFFORT, TRANSIENT_LOCAL=HELD)
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"create_node": lambda _: made},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": object},
        "rclpy.executors": {"MultiThreadedExecutor": FakeExecutor},
        "rclpy.qos": {"QoSProfile": make_qos}
        | dict.fromkeys(("DurabilityPolicy", "ReliabilityPolicy"), policies),
        "rclpy.signals": {"SignalHandlerOptions": object},
        "rclpy.utilities": {"remove_ros_args": list},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": str, "get_service": find_service},
    }
    for name, content in contents.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return made


@pytest.mark.acceptance
def test_a_camera_is_tracked_as_in_its_bag(
    node: FakeNode, drive_bag: Path, drive_run: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    spec = importlib.util.spec_from_file_location("ros2_node", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    before = signal.getsignal(signal.SIGINT)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    saved, main_thread, is_over = [], threading.get_ident(), threading.Event()

    def play() -> None:
        try:
            n_images = 0
            for message in recorded(drive_bag):
                if message.topic.name != "/tf":
                    node.network.send(message)
                n_images += message.topic.type == IMAGE_TYPE
                node.network.wait_for("/gvo/odom/odometry", n_images // 2)  # none may be dropped
            response = SimpleNamespace()
            saved.append(node.answers["/gvo/save"](SimpleNamespace(), response))
        finally:
            # Again, since one that comes just before a thread blocks does not wake it in Python.
            while not is_over.wait(0.1):
                signal.pthread_kill(main_thread, signal.SIGINT)

    bag = BagReader(drive_bag)
    node.network.announce(topic for topic in bag.topics if topic.name != "/tf")
    player = threading.Thread(target=play, daemon=True)
    player.start()
    try:
        script.main(str(tmp_path / "live"))
    finally:
        is_over.set()
    player.join(timeout=60)
    assert_same_files(tmp_path / "live", drive_run)
    assert [vars(each) for each in saved] == [
        {"success": True, "message": f"{N_FRAMES} frames are written"}
    ]
    assert node.answers.keys() == {"/gvo/reset", "/gvo/save"}
    qos = {name: (each.reliability, each.durability) for name, each in node.received_as.items()}
    assert qos["/tf_static"] == (RELIABLE, HELD)
    assert {qos[name] for name in qos if "image" in name} == {(BEST_EFFORT, "volatile")}
    assert "/tf" not in qos
    assert node.network.opened["/tf_static"][1]
    assert node.is_destroyed
