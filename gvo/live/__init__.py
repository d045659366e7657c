"""Odometry of a running camera: topics of ROS, standard input, or a device."""

from gvo.config import Parameters as Parameters
from gvo.live.odometry import LiveOdometry as LiveOdometry
from gvo.live.odometry import LiveRun as LiveRun
from gvo.live.sources import Device as Device
from gvo.live.sources import StandardInput as StandardInput
from gvo.live.topics import NetworkReader as NetworkReader
from gvo.live.topics import TopicSource as TopicSource
from gvo.live.topics import wait_for as wait_for
from gvo.live.transport import Publisher as Publisher
from gvo.live.transport import Service as Service
from gvo.live.transport import Sink as Sink
from gvo.live.transport import Transport as Transport
