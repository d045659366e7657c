"""Track a camera of ROS 2 as a node of rclpy. UNTESTED with ROS 2: its test replaces rclpy.

Example: python scripts/ros/ros2_node.py RUN_FOLDER base_link --ros-args -p use_sim_time:=true
"""

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rosidl_runtime_py.utilities import get_message, get_service

from gvo.io.bag.topics import Topic
from gvo.io.poses.base_frame import find_base_frame
from gvo.live import LiveOdometry, NetworkReader, Parameters, Service, TopicSource, wait_for


class Outlet:
    """A topic that messages are written to."""

    def __init__(self, publisher: Any) -> None:  # noqa: ANN401
        self._publisher = publisher

    def publish(self, data: bytes, stamp_ns: int) -> None:
        """Send a message, which has its stamp."""
        self._publisher.publish(data)

    @property
    def is_heard(self) -> bool:
        """Whether anybody listens."""
        return bool(self._publisher.get_subscription_count() > 0)


class Node:
    """A `gvo.live.Transport` over a node of rclpy."""

    is_ros1, name = False, "ROS 2"

    def __init__(self, node: Any) -> None:  # noqa: ANN401
        self._node, self._group = node, ReentrantCallbackGroup()

    def topics(self) -> Sequence[Topic]:
        """Return what other nodes write."""
        known = self._node.get_topic_names_and_types()
        return [Topic(name=n, type=t[0], n_messages=1) for n, t in known if self._offers(n)]

    def subscribe(self, topic: str, type_: str, callback: Callable[[bytes, int], None]) -> None:
        """Receive messages as bytes, held and sent again where all writers offer it."""
        offers, clock = self._offers(topic), self._node.get_clock()
        reliable, held = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
        qos = QoSProfile(depth=100)
        if any(offer.reliability != reliable for offer in offers):
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if offers and all(offer.durability == held for offer in offers):
            qos.durability = held
        take = lambda data: callback(data, clock.now().nanoseconds)  # noqa: E731
        options = {"raw": True, "callback_group": self._group}
        self._node.create_subscription(get_message(type_), topic, take, qos, **options)

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> Outlet:
        """Open a topic for writing."""
        qos = QoSProfile(depth=1 if is_latched else 100)
        if is_latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return Outlet(self._node.create_publisher(get_message(type_), topic, qos))

    def serve(self, service: Service) -> None:
        """Answer a service whose package is installed."""

        def answer(request: Any, response: Any) -> Any:  # noqa: ANN401
            for name, value in service.answer(request).items():
                setattr(response, name, value)
            return response

        with suppress(ModuleNotFoundError):
            type_ = get_service(service.type.name)
            self._node.create_service(type_, service.name, answer, callback_group=self._group)

    def offer(self, parameters: Parameters) -> None:
        """Offer none: they are those of `gvo live ros2`."""

    def close(self) -> None:
        """Leave the network."""
        self._node.destroy_node()

    def _offers(self, topic: str) -> list[Any]:
        infos = self._node.get_publishers_info_by_topic(topic)
        return [info.qos_profile for info in infos if info.node_name != self._node.get_name()]


def main(out: str, frame: str | None = None) -> None:
    """Track until a signal, and write a run folder."""
    made, ended = rclpy.create_node("gvo"), threading.Event()
    stops = [ended.set]

    def end(*_: object) -> None:
        # In threads: here, what is stopped may have its lock.
        for stop in stops:
            threading.Thread(target=stop).start()

    signal.signal(signal.SIGINT, end)
    executor = MultiThreadedExecutor()
    executor.add_node(made)
    threading.Thread(target=executor.spin, daemon=True).start()
    node = Node(made)
    reader = NetworkReader(node)
    if source := wait_for(lambda: TopicSource(reader), print, ended):
        base_frame = find_base_frame(source, frame)
        live = LiveOdometry(source, sinks=[node], base_frame=base_frame, say=print)
        stops.append(live.stop)
        live.run(out)
    executor.shutdown()
    node.close()


if __name__ == "__main__":
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    main(*remove_ros_args(sys.argv)[1:3])
