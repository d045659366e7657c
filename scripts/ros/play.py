"""Play a recording into ROS 1, with a simulated clock: at its rate, or as fast as it is answered.

Example: rosparam set use_sim_time true; gvo live ros1 & python scripts/ros/play.py RECORDING

Any recording that gvo reads is sent as `gvo convert` would write it: images, their CameraInfo, how
the cameras sit, the samples of an IMU up to 0.2 s ahead, and `/clock` before each image, as soon as
somebody listens to both cameras.
Without --rate at most --ahead pairs are on their way: the next one is sent when the odometry of an
earlier one has come, so that nothing is dropped however slow the machine is.
"""

import argparse
import sys
import threading
import time
import warnings
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

sys.path.append("/usr/lib/python3/dist-packages")  # Debian's rospy, beside a virtual environment

import roslib.message
import rospy

import gvo
from gvo.config import SyncConfig
from gvo.geometry.imu import ImuSamples
from gvo.io.bag.topics import IMAGE_TYPE, IMU_TYPE
from gvo.io.convert.bag import IMU_FRAME, BagStream, BagStreams, plan_streams, static_poses
from gvo.io.convert.bag_messages import (
    Header,
    ImuSample,
    MessageWriter,
    write_camera_info,
    write_image,
    write_imu,
    write_transforms,
)
from gvo.io.frames import paired
from gvo.io.recording import Source, StampedImage
from gvo.runs.loop import ImuFeed
from gvo.types import FaultyFrame

PATIENCE_S = 60.0
LAST_S = 5.0


def main() -> None:
    """Parse the arguments and play."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, help="of the recorded one, whatever is answered")
    parser.add_argument("--ahead", type=int, default=5, help="pairs that wait for an answer")
    parser.add_argument("--answers", default="/gvo/odom/odometry", help="topic of the answers")
    arguments = parser.parse_args(rospy.myargv()[1:])
    rospy.init_node("player", anonymous=True, disable_signals=True)
    source = gvo.open_recording(arguments.recording)
    try:
        play(source, Answers(arguments.answers), arguments.rate, arguments.ahead)
    except (KeyboardInterrupt, TimeoutError) as error:
        sys.exit(f"stopped: {error}")
    finally:
        rospy.signal_shutdown("the end")


class Writer(MessageWriter):
    """Publishes messages, one after the other: a slow listener is waited for."""

    def __init__(self) -> None:
        super().__init__("ROS 1", is_ros1=True)
        self._publishers: dict[str, Any] = {}

    def open(self, topic: str, type_: str, *, is_latched: bool = False) -> Any:  # noqa: ANN401
        """Return the publisher of a topic."""
        if topic not in self._publishers:
            message_class = roslib.message.get_message_class(type_.replace("/msg/", "/"))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # rospy warns of publishers without a queue
                made = rospy.Publisher(topic, message_class, latch=is_latched)
            self._publishers[topic] = made
        return self._publishers[topic]

    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        """Publish a message."""
        publisher = self.open(topic, type_, is_latched=is_latched)
        publisher.publish(publisher.data_class().deserialize(self.serialize(message, type_)))

    def send(self, image: StampedImage, stream: BagStream) -> None:
        """Publish an image and its CameraInfo."""
        header = Header(image.stamp_ns, stream.frame_id)
        write_camera_info(self, stream.info_topic, stream.calibration, header)
        write_image(self, stream.topic, image.load(), header)

    def send_samples(self, samples: ImuSamples) -> None:
        """Publish samples of the IMU."""
        for row in zip(samples.stamps_ns.tolist(), samples.gyro, samples.acceleration, strict=True):
            write_imu(self, "/imu", ImuSample(*row), IMU_FRAME)

    def tick(self, stamp_ns: int) -> None:
        """Set the clock."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        clock = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        type_ = "rosgraph_msgs/msg/Clock"
        self.write("/clock", type_, self.make(type_, clock=clock), stamp_ns)


class Answers:
    """Stamps of the odometry that came."""

    def __init__(self, topic: str) -> None:
        self._changed = threading.Condition()
        self._stamps_ns: set[int] = set()
        odometry = roslib.message.get_message_class("nav_msgs/Odometry")
        self._subscriber = rospy.Subscriber(topic, odometry, self._take)

    def _take(self, message: Any) -> None:  # noqa: ANN401
        with self._changed:
            self._stamps_ns.add(message.header.stamp.to_nsec())
            self._changed.notify_all()

    @property
    def are_heard(self) -> bool:
        """Whether who answers sends to this node, which is connected a moment before."""
        if self._stamps_ns:  # it has sent already
            return bool(self._subscriber.get_num_connections() > 0)
        name, own = self._subscriber.resolved_name, rospy.get_name()
        links: list[Any] = []
        for connection in self._subscriber.impl.connections:
            with suppress(OSError), ServerProxy(connection.endpoint_id) as node:
                info: Any = node.getBusInfo(own)
                links += info[2]
        return any((link[1], link[2], link[4]) == (own, "o", name) for link in links)

    def n_of(self, stamps_ns: list[int]) -> int:
        """Return how many of these stamps were answered."""
        return len(self._stamps_ns.intersection(stamps_ns))

    def wait(self, stamps_ns: list[int], n_open: int, patience_s: float = PATIENCE_S) -> None:
        """Wait until no more than `n_open` of these stamps are not answered."""
        with self._changed:
            is_answered = self._changed.wait_for(
                lambda: len(stamps_ns) - self.n_of(stamps_ns) <= n_open, patience_s
            )
        if not is_answered:
            raise TimeoutError(f"no odometry for {patience_s:.0f} s; --rate waits for none")


def until(is_true: Any, what: str) -> None:  # noqa: ANN401
    """Wait for something that says nothing when it comes."""
    end_s = time.monotonic() + PATIENCE_S
    while not is_true():
        if time.monotonic() > end_s:
            raise TimeoutError(f"{what} for {PATIENCE_S:.0f} s")
        time.sleep(0.01)


def play(source: Source, answers: Answers, rate: float | None, n_ahead: int) -> None:
    """Send all images in their order."""
    found = paired(source.images(), source.info.sensor, SyncConfig())
    pairs = deque(
        (pair[0].stamp_ns, pair[1].stamp_ns) for pair in found if not isinstance(pair, FaultyFrame)
    )
    first_ns, n_pairs = min(map(min, pairs)), len(pairs)
    writer, streams = Writer(), plan_streams(source, rectify=False)
    introduce(source, streams, writer, first_ns)
    imu = source.info.imu
    feed = ImuFeed((lambda _: iter(())) if imu is None else imu.samples)
    begin_s = time.monotonic()
    sent: set[tuple[int, int]] = set()
    awaited: list[int] = []
    for image in source.images():
        if rate:
            due_s = begin_s + 1e-9 * (image.stamp_ns - first_ns) / rate
            time.sleep(max(due_s - time.monotonic(), 0.0))
        writer.tick(image.stamp_ns)
        for samples in feed.until(image.stamp_ns):
            writer.send_samples(samples)
        writer.send(image, streams[image.stream])
        sent.add((image.stream, image.stamp_ns))
        while pairs and {(0, pairs[0][0]), (1, pairs[0][1])} <= sent:
            awaited.append(pairs.popleft()[0])
        if not rate and len(awaited) > n_ahead:
            if not answers.are_heard:
                until(lambda: answers.are_heard, "nobody announces the odometry")
                awaited = []  # may have been answered before
            answers.wait(awaited, n_ahead)
    with suppress(TimeoutError):  # the last one may wait for a better partner
        answers.wait(awaited, 0, LAST_S)
    print(f"{n_pairs} pairs sent, {len(awaited)} waited for, {answers.n_of(awaited)} answered")


def introduce(source: Source, streams: BagStreams, writer: Writer, stamp_ns: int) -> None:
    """Say what the cameras are, until somebody listens to both."""
    writer.tick(stamp_ns)
    frame_ids = streams[0].frame_id, streams[1].frame_id
    poses = static_poses(source, frame_ids, stamp_ns)
    write_transforms(writer, "/tf_static", poses, is_latched=True)
    made = [writer.open(stream.topic, IMAGE_TYPE) for stream in streams]
    if source.info.imu is not None:
        made.append(writer.open("/imu", IMU_TYPE))
    for stream in streams:
        write_camera_info(
            writer, stream.info_topic, stream.calibration, Header(stamp_ns, stream.frame_id)
        )
    until(
        lambda: all(publisher.get_num_connections() for publisher in made),
        f"nobody listens to {streams[0].topic} and {streams[1].topic}",
    )


if __name__ == "__main__":
    main()
