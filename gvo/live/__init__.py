"""Odometry of a running camera: topics of ROS, standard input, or a device."""

from gvo.live.odometry import LiveOdometry, LiveRun
from gvo.live.sources import Device, StandardInput
from gvo.live.topics import NetworkReader, TopicSource, wait_for
from gvo.live.transport import Parameters, Publisher, Service, Sink, Transport

__all__ = [
    "Device",
    "LiveOdometry",
    "LiveRun",
    "NetworkReader",
    "Parameters",
    "Publisher",
    "Service",
    "Sink",
    "StandardInput",
    "TopicSource",
    "Transport",
    "wait_for",
]
