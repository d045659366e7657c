"""Bags as recordings: choose topics, find calibrations, stream images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.sources.bag_calibration import calibrations_of_file, calibrations_of_messages
from gvo.sources.bag_reader import TF_TYPE, BagMessage, BagReader
from gvo.sources.messages import (
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
    stamp_of,
)
from gvo.sources.recording import RecordingInfo, StampedImage
from gvo.sources.topics import COMPRESSED_TYPE, Topic, TopicChoice, choose_topics
from gvo.trajectory import Trajectory
from gvo.types import FloatArray

DEFAULT_SCALE = 1000.0
"""Counts per metre of integer depth in messages: millimetres, by REP 118."""

TRUTH_FRAMES = ("world", "ground_truth")
"""Parent and child frame of the ground truth in `/tf`: T_world_cam of the rectified camera."""


_NORM_TOLERANCE = 1e-2


class BagSource:
    """A stereo or RGB-D camera in a bag.

    Parameters
    ----------
    path : Path
        `.bag`, `.mcap` or `.db3` file, or a ROS 2 bag folder.
    topics : TopicChoice, optional
        What the names of the topics do not decide.
    calibration : Path, optional
        YAML that replaces the `CameraInfo` messages; `left` and `right` for stereo.
    depth_scale : float, optional
        Counts per metre of integer depth; otherwise that of the calibration file, or 1000.

    Raises
    ------
    RecordingError, CalibrationError
        When the bag cannot be read, or holds no camera or no calibration.
    """

    def __init__(
        self,
        path: Path,
        *,
        topics: TopicChoice | None = None,
        calibration: Path | None = None,
        depth_scale: float | None = None,
    ) -> None:
        self._path = path
        self._reader = BagReader(path)
        self._topics = choose_topics(self._reader.topics, topics or TopicChoice(), str(path))
        if calibration is None:
            found = calibrations_of_messages(self._reader, self._topics, str(path))
        else:
            found = calibrations_of_file(calibration, self._topics)
        self._scale = depth_scale or found.depth_scale or DEFAULT_SCALE
        decisions = [*self._reader.notes, self._topics.describe(), *found.decisions]
        if self._topics.sensor == "rgbd":
            decisions.append(
                f"depth: metres where it is 32FC1, {self._scale:g} counts per metre where 16UC1"
            )
        self._info = RecordingInfo(
            name=path.resolve().stem if path.is_file() else path.resolve().name,
            sensor=self._topics.sensor,
            calibrations=found.calibrations,
            n_images=self._topics.first.n_messages,
            decisions=decisions,
        )

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        return self._info

    @property
    def image_topics(self) -> tuple[str, str]:
        """Names of the topics of stream 0 and 1."""
        return self._topics.first.name, self._topics.second.name

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both topics in the order of recording.

        Raises
        ------
        RecordingError
            When the bag cannot be read on, or a topic that announces messages yields none.
        """
        names = self.image_topics
        counts = [0, 0]
        for message in self._reader.messages(names):
            stream = names.index(message.topic.name)
            counts[stream] += 1
            yield self._image(message, stream)
        for topic, count in zip((self._topics.first, self._topics.second), counts, strict=True):
            if count == 0:
                raise RecordingError(
                    f"{self._path}: {topic.name} announces {topic.n_messages} messages but "
                    "yields none; record or convert the bag anew"
                )

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the rectified camera: `world` to `ground_truth` in `/tf`.

        Raises
        ------
        RecordingError
            When the bag cannot be read.
        """
        if not any(topic.name == "/tf" and topic.type == TF_TYPE for topic in self._reader.topics):
            return None
        poses: dict[int, FloatArray] = {}
        for message in self._reader.messages(["/tf"]):
            transforms = message.decode().transforms if message.topic.type == TF_TYPE else []
            for transform in transforms:
                frames = (transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/"))
                if frames == TRUTH_FRAMES:
                    poses[stamp_of(transform.header)] = _pose(transform.transform, self._path)
        if not poses:
            return None
        stamps_ns = np.array(sorted(poses), dtype=np.int64)
        T_world_cam = np.stack([poses[int(stamp_ns)] for stamp_ns in stamps_ns])
        return Trajectory(stamps_ns=stamps_ns, T_world_cam=T_world_cam)

    def _image(self, message: BagMessage, stream: int) -> StampedImage:
        try:
            content = message.decode()
        except RecordingError as error:
            # Without a header there is no other stamp than that of the recording.
            return StampedImage(
                stream=stream, stamp_ns=message.log_time_ns, load=partial(_fail, str(error))
            )
        decode = self._decoder(message.topic, is_depth=self._is_depth(stream))
        return StampedImage(
            stream=stream, stamp_ns=stamp_of(content.header), load=partial(decode, content)
        )

    def _is_depth(self, stream: int) -> bool:
        return stream == 1 and self._topics.sensor == "rgbd"

    def _decoder(self, topic: Topic, *, is_depth: bool) -> Callable[[Any], NDArray[Any]]:
        is_compressed = topic.type == COMPRESSED_TYPE
        if is_depth:
            decode = decode_compressed_depth if is_compressed else decode_depth
            return partial(decode, scale=self._scale, where=topic.name)
        if is_compressed:
            return partial(decode_compressed, where=topic.name)
        return partial(decode_grey_or_color, where=topic.name)


def _pose(transform: Any, path: Path) -> FloatArray:  # noqa: ANN401 - geometry_msgs/Transform
    t = np.array([getattr(transform.translation, axis) for axis in "xyz"], dtype=np.float64)
    quaternion_xyzw = np.array([getattr(transform.rotation, axis) for axis in "xyzw"])
    norm = np.linalg.norm(quaternion_xyzw)
    if not np.all(np.isfinite(t)) or not abs(norm - 1.0) <= _NORM_TOLERANCE:
        raise RecordingError(f"{path}: /tf holds a pose of {TRUTH_FRAMES[1]} that is no transform")
    return se3.make_transform(np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix()), t)


def _fail(reason: str) -> NDArray[Any]:
    raise RecordingError(reason)
