"""Nodes beside `gvo live ros1`: one that notes what is sent, one that drives through a session."""

import json
import sys
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path += ["/usr/lib/python3/dist-packages", str(Path(__file__).parents[2])]

import rospy
from dynamic_reconfigure.client import Client
from genpy import Message
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

import gvo
from gvo.io.bag.topics import CAMERA_INFO_TYPE, IMAGE_TYPE
from gvo.io.convert.bag import plan_streams
from gvo.io.convert.bag_messages import Header, write_camera_info, write_image
from scripts.ros.play import PATIENCE_S, Answers, Writer, introduce, until


def tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def numbers(position: Any, orientation: Any) -> list[float]:
    return [getattr(position, name) for name in "xyz"] + [
        getattr(orientation, name) for name in "xyzw"
    ]


class Watch:
    """Notes odometry, transforms and clouds, until all have a stamp."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.noted: dict[str, list[Any]] = {"odometry": [], "tf": [], "static": [], "clouds": []}
        rospy.Subscriber("/gvo/odom/odometry", Odometry, self._note_odometry)
        rospy.Subscriber("/tf", TFMessage, self._note_tf, "tf")
        rospy.Subscriber("/tf_static", TFMessage, self._note_tf, "static")
        rospy.Subscriber("/gvo/points", PointCloud2, self._note_cloud)

    def _note(self, kind: str, message: Any, *values: Any) -> None:
        with self._changed:
            stamp_ns = message.header.stamp.to_nsec()
            self.noted[kind].append([stamp_ns, message.header.frame_id, *values])
            self._changed.notify_all()

    def _note_odometry(self, message: Any) -> None:
        pose = message.pose.pose
        values = numbers(pose.position, pose.orientation)
        self._note("odometry", message, message.child_frame_id, values)

    def _note_tf(self, message: Any, kind: str) -> None:
        for one in message.transforms:
            values = numbers(one.transform.translation, one.transform.rotation)
            self._note(kind, one, one.child_frame_id, values)

    def _note_cloud(self, message: Any) -> None:
        offsets = [field.offset for field in message.fields[:3]]
        assert [field.name for field in message.fields[:3]] == ["x", "y", "z"]
        self._note("clouds", message, message.point_step, offsets, message.data.hex())

    def wait_for(self, stamp_ns: int) -> None:
        def have_all() -> bool:
            kinds = ("odometry", "tf", "clouds")
            return all(any(stamp_ns == one[0] for one in self.noted[kind]) for kind in kinds)

        with self._changed:
            assert self._changed.wait_for(have_all, PATIENCE_S)


class Garbage(Message):  # type: ignore[misc]
    """Says that it is an image."""

    _type, _md5sum, _full_text = Image._type, Image._md5sum, Image._full_text
    __slots__ = ("data",)

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, buffer: Any) -> None:
        buffer.write(self.data)


def send_hostile(images: Any, stamp_ns: int) -> None:
    """Send what is no image, one that says it is huge, and one of no encoding."""
    stamp = (0).to_bytes(4, "little") + b"".join(
        part.to_bytes(4, "little") for part in divmod(stamp_ns, 10**9)
    )
    name = (1).to_bytes(4, "little") + b"c"
    huge = (2**31).to_bytes(4, "little") * 2 + (5).to_bytes(4, "little") + b"mono8"
    for data in (
        b"",
        b"\xff" * 40,
        stamp,
        stamp + name + huge + bytes(9),
        stamp + name + (4).to_bytes(4, "little") * 2 + name + bytes(9),
    ):
        images.publish(Garbage(data))


class SetPoseRequest(Message):  # type: ignore[misc]
    """robot_localization is not in Debian."""

    _type = "robot_localization/SetPoseRequest"
    _md5sum = ""
    _slot_types = ("geometry_msgs/PoseWithCovarianceStamped",)
    __slots__ = ("pose",)

    def serialize(self, buffer: Any) -> None:
        self.pose.serialize(buffer)


class SetPoseResponse(Message):  # type: ignore[misc]
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


def set_poses() -> None:
    pose = PoseWithCovarianceStamped()
    pose.pose.pose.orientation.w = 1.0
    for frame in ("map", "elsewhere"):
        pose.header.frame_id = frame
        rospy.ServiceProxy("/gvo/set_pose", SetPose)(SetPoseRequest(pose=pose))


def reconfigure() -> dict[str, Any]:
    """Change parameters by the client of dynamic_reconfigure; return what it tells of them."""
    client = Client("/gvo", timeout=PATIENCE_S)
    first = client.get_configuration(timeout=PATIENCE_S)
    listed = {one["name"]: one for one in client.get_parameter_descriptions()}
    answers = [
        client.update_configuration({name: value})[asked]
        for name, value, asked in (
            ("klt__n_corners", 120, "klt__n_corners"),
            ("klt__n_corners", -1, "klt__n_corners"),
            ("camera__readout_ms", "3.5", "camera__readout_ms"),
            ("camera__readout_ms", "null", "camera__readout_ms"),
            ("features__kind", "sift", "features__kind"),
            ("features__kind", "orb", "features__kind"),
        )
    ]
    return {
        "n": len(first) - 1,  # but the groups
        "groups": [*client.get_group_descriptions()["groups"]],
        "corners": listed["klt__n_corners"],
        "readout": listed["camera__readout_ms"],
        "kind": listed["features__kind"]["edit_method"],
        "answers": answers,
    }


def interfere(index: int, stamp_ns: int, images: Any) -> None:
    """Set the pose, change parameters, send what is no image, reset: each once."""
    if index == 5:
        set_poses()
    if index == 10:
        tell(f"parameters {json.dumps(reconfigure())}")
    if index == 20:
        send_hostile(images, stamp_ns + 1000)
    if index == 30:
        assert rospy.ServiceProxy("/gvo/reset", Trigger)().success


def drive(recording: str) -> None:
    """Send pairs one by one, each when the last one is answered; change things in between."""
    source = gvo.open_recording(recording)
    writer, streams = Writer(), plan_streams(source, rectify=False)
    answers = Answers("/gvo/odom/odometry")
    images = list(source.images())
    pairs = [(a, b) for a, b in pairwise(images) if a.stamp_ns == b.stamp_ns]
    for stream in streams:  # who comes later is given it
        writer.open(stream.info_topic, CAMERA_INFO_TYPE, is_latched=True)
        header = Header(pairs[0][0].stamp_ns, stream.frame_id)
        write_camera_info(writer, stream.info_topic, stream.calibration, header)
    tell("introduced")
    introduce(source, streams, writer, pairs[0][0].stamp_ns)
    for index, pair in enumerate(pairs[:40]):
        interfere(index, pair[0].stamp_ns, writer.open(streams[0].topic, IMAGE_TYPE))
        for image in pair:
            stream = streams[image.stream]
            # A message without a header has the time of its arrival, which no image may have.
            writer.tick(image.stamp_ns + 1_000_000)
            header = Header(image.stamp_ns, stream.frame_id)
            write_image(writer, stream.topic, image.load(), header)
        if index == 0:
            until(lambda: answers.are_heard, "nobody announces the odometry")
        elif index != 30:
            answers.wait([pair[0].stamp_ns], 0)
        tell(f"pair {index}")
    sys.stdin.read()


def watch() -> None:
    watch = Watch()
    tell("watching")
    watch.wait_for(int(sys.stdin.readline()))
    tell(json.dumps(watch.noted))


rospy.init_node("driver", anonymous=True)
if len(sys.argv) > 1:
    drive(sys.argv[1])
else:
    watch()
