"""A node of ROS 1 through `gvo.live.ros1`, which tells what it receives, a line of JSON each.

It leaves when its standard input ends.
"""

import hashlib
import json
import struct
import sys
import threading
from collections.abc import Callable
from typing import Any

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.bag.topics import CAMERA_INFO_TYPE, IMAGE_TYPE
from gvo.live.ros1 import Ros1
from gvo.live.transport import SET_POSE, TRIGGER, Parameters, Service, decode

POINT = "geometry_msgs/msg/PointStamped"


def tell(event: str, **fields: object) -> None:
    sys.stdout.write(json.dumps({"event": event} | fields) + "\n")
    sys.stdout.flush()


def point(stamp_ns: int) -> bytes:
    """Return a point at the origin of `cam`, in the bytes of ROS 1."""
    header = struct.pack("<IIII3s", 0, *divmod(stamp_ns, 10**9), 3, b"cam")
    return header + struct.pack("<ddd", 0.0, 0.0, 0.0)


def set_pose(request: Any) -> dict[str, object]:
    if request.pose.header.frame_id != "map":
        raise RecordingError("no such frame")
    tell("pose", x=request.pose.pose.pose.position.x)
    return {}


def main() -> None:
    node = Ros1(["__name:=vo", "/gvo/latched:=/renamed"])
    latched = node.advertise("/gvo/latched", POINT, is_latched=True)
    plain = node.advertise("/gvo/plain", POINT)
    assert latched.is_heard
    assert not plain.is_heard

    def told(topic: str, type_: str) -> Callable[[bytes, int], None]:
        def receive(data: bytes, clock_ns: int) -> None:
            try:
                stamp = decode(data, type_, is_ros1=True).header.stamp
                stamp_ns = stamp.sec * 10**9 + stamp.nanosec
            except RecordingError as error:
                tell("fault", text=str(error))
                return
            digest = hashlib.sha256(data).hexdigest()
            tell(topic, digest=digest, clock_ns=clock_ns, stamp_ns=stamp_ns)
            if topic == "image":
                tell("heard", value=plain.is_heard)
                for publisher in (latched, plain):
                    publisher.publish(point(clock_ns), stamp_ns)

        return receive

    parameters = Parameters(Config())
    parameters.follow(
        lambda config: tell(
            "parameters", size=config.window.size, readout_ms=config.camera.readout_ms
        )
    )
    node.offer(parameters)
    done = {"success": True, "message": "done"}
    node.serve(Service(name="/gvo/reset", type=TRIGGER, answer=lambda _: done))
    node.serve(Service(name="/gvo/set_pose", type=SET_POSE, answer=set_pose))
    tell("topics", topics=[[topic.name, topic.type] for topic in node.topics()])
    node.subscribe("/cam/camera_info", CAMERA_INFO_TYPE, told("info", CAMERA_INFO_TYPE))
    node.subscribe("/cam/image", IMAGE_TYPE, told("image", IMAGE_TYPE))
    tell("ready")
    sys.stdin.read()
    node.close()
    threads = [one for one in threading.enumerate() if not one.daemon]
    for thread in set(threads) - {threading.main_thread()}:
        thread.join(20.0)
    left = [one.name for one in threads if one.is_alive()]
    tell("left", threads=left)


main()
