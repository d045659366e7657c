"""What rospy does as anybody uses it, against `ros1_node.py`; prints what it got, as JSON."""

import hashlib
import io
import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

sys.path.append("/usr/lib/python3/dist-packages")

import genpy
import rospy
from dynamic_reconfigure.client import Client
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rosgraph_msgs.msg import Clock, Log
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

PATIENCE_S = 20.0
STAMP = rospy.Time(1_700_000_000, 123_456_789)
CLOCK = rospy.Time(5, 6)


class SetPoseRequest(genpy.Message):  # type: ignore[misc]
    """robot_localization is not in Debian."""

    _type = "robot_localization/SetPoseRequest"
    _md5sum = ""
    _slot_types = ("geometry_msgs/PoseWithCovarianceStamped",)
    __slots__ = ("pose",)

    def serialize(self, buffer: io.BytesIO) -> None:
        self.pose.serialize(buffer)


class SetPoseResponse(genpy.Message):  # type: ignore[misc]
    _type = "robot_localization/SetPoseResponse"
    _md5sum = ""
    __slots__ = ()

    def deserialize(self, _: bytes) -> "SetPoseResponse":
        return self


class SetPose:
    _type = "robot_localization/SetPose"
    _md5sum = "4f3e0bbe7a24e1f929488cd1970222d3"
    _request_class = SetPoseRequest
    _response_class = SetPoseResponse


class Got:
    """The last message of a topic."""

    def __init__(self, topic: str, type_: Any) -> None:
        self.has_come = threading.Event()
        self.message: Any = None
        rospy.Subscriber(topic, type_, self._take)

    def _take(self, message: Any) -> None:
        self.message = message
        self.has_come.set()

    def wait(self) -> Any:
        assert self.has_come.wait(PATIENCE_S)
        return self.message


def until(is_true: Callable[[], Any], what: object) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end_s, what
        time.sleep(0.005)


def publisher(topic: str, type_: Any, *, latch: bool = False) -> Any:
    """Return a publisher to whom somebody listens."""
    made = rospy.Publisher(topic, type_, queue_size=10, latch=latch)
    until(made.get_num_connections, topic)
    return made


def image(seed: int) -> Image:
    made = Image(height=20, width=30, step=30, encoding="mono8", data=bytes([seed]) * 600)
    made.header.stamp = STAMP
    return made


def digest(message: genpy.Message) -> str:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def messages() -> dict[str, Any]:
    """Send an image and a latched CameraInfo, and receive what is answered."""
    publisher("/clock", Clock, latch=True).publish(Clock(CLOCK))
    info = CameraInfo(height=20, width=30)
    info.header.stamp = STAMP
    publisher("/cam/camera_info", CameraInfo, latch=True).publish(info)
    plain = Got("/gvo/plain", PointStamped)
    images = publisher("/cam/image", Image)
    sent = image(1)
    while plain.message is None or plain.message.header.stamp != CLOCK:
        plain.has_come.clear()  # until all are connected
        images.publish(sent)
        plain.has_come.wait(0.1)
    late = Got("/renamed", PointStamped).wait()  # nothing is sent any more
    return {
        "image": digest(sent),
        "info": digest(info),
        "plain": plain.message.header.frame_id,
        "late": late.header.stamp.to_nsec(),
        "reset": rospy.ServiceProxy("/gvo/reset", Trigger)().message,
    }


def services() -> dict[str, Any]:
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = "map"
    pose.pose.pose.position.x = 1.5
    set_pose = rospy.ServiceProxy("/gvo/set_pose", SetPose)
    set_pose(SetPoseRequest(pose=pose))
    pose.header.frame_id = "elsewhere"
    try:
        set_pose(SetPoseRequest(pose=pose))
    except rospy.ServiceException as error:
        refusal = str(error)
    Trigger._md5sum = "0" * 32
    try:
        rospy.ServiceProxy("/gvo/reset", Trigger)()
    except rospy.ServiceException as error:
        other = str(error)
    return {"refusal": refusal, "other": other}


def parameters() -> dict[str, Any]:
    log = rospy.Subscriber("/rosout", Log, lambda message: logged.append(message.msg))
    logged: list[str] = []
    client = Client("/vo", timeout=PATIENCE_S)
    first = client.get_configuration(timeout=PATIENCE_S)
    listed = {one["name"]: one for one in client.get_parameter_descriptions()}
    answers = [
        client.update_configuration({"window__size": 7})["window__size"],
        client.update_configuration({"window__size": 1, "window__n_links": 2})["window__size"],
        client.update_configuration({"camera__readout_ms": 3.5})["camera__readout_ms__null"],
        client.update_configuration({"camera__readout_ms__null": True})["camera__readout_ms__null"],
        client.update_configuration({"camera__readout_ms__null": False})["camera__readout_ms"],
        client.update_configuration({"features__kind": "sift"})["features__kind"],
    ]
    until(lambda: any("window.size" in line for line in logged), logged)
    log.unregister()
    return {
        "n": len(first) - 1,  # but the groups
        "groups": [*client.get_group_descriptions()["groups"]],
        "size": listed["window__size"],
        "readout": listed["camera__readout_ms"],
        "kind": listed["features__kind"]["edit_method"],
        "answers": answers,
    }


def main() -> None:
    rospy.init_node("peer", anonymous=True)
    sys.stdout.write(json.dumps(globals()[sys.argv[1]]()))
    sys.stdout.flush()


main()
