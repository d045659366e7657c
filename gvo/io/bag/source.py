"""Bags as recordings: choose topics, find calibrations, stream images."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry.imu import ImuStream
from gvo.io.bag.calibration import (
    BagCalibration,
    calibrations_of_file,
    calibrations_of_messages,
    lookup_mount,
    of_realsense,
)
from gvo.io.bag.cameras import CameraInfoWatch, find_contradiction
from gvo.io.bag.imu import BagImu, StampOf, find_imu, read_samples
from gvo.io.bag.messages import (
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
    header_stamp,
    stamp_of,
)
from gvo.io.bag.reader import BagMessage, BagReader, MessageReader
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.topics import COMPRESSED_TYPE, CameraTopics, TopicChoice, choose_topics
from gvo.io.calibration.files import CalibrationPaths, make_imu, paths_of, with_imu
from gvo.io.calibration.forms import ImuFacts
from gvo.io.images import MILLIMETRES
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.poses.truth import (
    TRUTH_FRAMES,
    BagTruthSpec,
    Poses,
    Truth,
    find_named_truth,
    in_frame,
    read_poses,
)
from gvo.io.recording import RecordingInfo, Source, StampedImage, shown
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

CAMERA_CHANGED = (
    "the first one is used; give the right one by --calibration FILE, or cut the bag there"
)
"""What follows where a `CameraInfo` changes on the way, and what to do."""
_N_LISTED = 12
_LATEST_NS = 2**63 - 1  # in MCAP it may be later


class ImageStamps:
    """The last stamps of both streams, from which that of a damaged image is guessed."""

    def __init__(self) -> None:
        self.last_ns: tuple[deque[int], deque[int]] = (deque(maxlen=2), deque(maxlen=2))

    def of_damaged(self, message: BagMessage, stream: int) -> int:
        """Return the stamp of the header, else the next one by the period, else the log time."""
        stamp_ns, last_ns = header_stamp(message), self.last_ns[stream]
        if stamp_ns is None and last_ns:
            stamp_ns = 2 * last_ns[-1] - last_ns[0]
        return min(message.log_time_ns, _LATEST_NS) if stamp_ns is None else stamp_ns


class BagSource:
    """A stereo or RGB-D camera in a bag, or in several that are one recording.

    Parameters
    ----------
    paths : Path or sequence of Path
        `.bag`, `.mcap` or `.db3` files, or ROS 2 bag folders.
    topics : TopicChoice, optional
        What the names of the topics do not decide.
    calibration : Path or sequence of Path, optional
        Files that replace the `CameraInfo` messages, see `read_cameras`.
    config : Config, optional
        Of which `depth.scale` (otherwise that of the calibration, or 1000), `images` and
        `sync.stamps` matter.
    imu : ImuFacts, optional
        What is known of the IMU beside what the bag holds; None: it is left out.

    Raises
    ------
    ValueError
        If no path is given.
    RecordingError, CalibrationError
        When the bag cannot be read, or holds no camera or no calibration.
    """

    def __init__(
        self,
        paths: Path | Sequence[Path],
        *,
        topics: TopicChoice | None = None,
        calibration: CalibrationPaths = None,
        config: Config | None = None,
        imu: ImuFacts | None = None,
    ) -> None:
        paths = [paths] if isinstance(paths, Path) else list(paths)
        reader = BagReader(paths)
        contradiction = find_contradiction(reader, by_camera_info=not paths_of(calibration))
        if contradiction:
            raise RecordingError(_describe_parts(paths, reader, contradiction))
        where = str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
        path = paths[0].resolve()
        self._name = path.stem if path.is_file() else path.name
        found = self._open(reader, where, topics, calibration, config)
        if imu is not None:
            self._add_imu(topics, found, {**imu, **found.imu})

    def _open(
        self,
        reader: MessageReader,
        where: str,
        topics: TopicChoice | None,
        calibration: CalibrationPaths,
        config: Config | None,
    ) -> BagCalibration:
        config = config or Config()
        self._reader, self._where = reader, where
        self._tf: TfBuffer | None = None
        self._takes_log_time = config.sync.stamps == "recording"
        topics = topics or TopicChoice()
        if len(topics.camera_info) > (0 if paths_of(calibration) else 2):
            raise RecordingError(
                f"{where}: give at most two --camera-info, or --calibration instead"
            )
        self._topics = self._choose_topics(topics)
        self._watch = CameraInfoWatch()
        if paths_of(calibration):
            found = calibrations_of_file(calibration, self._topics, reader)
        else:
            found = calibrations_of_messages(reader, self._topics, where, topics.camera_info)
        self._info_names = set(found.info_names)
        self._scale = config.depth.scale or found.depth_scale or MILLIMETRES
        self._images_config, self._imu_config = config.images, config.imu
        self.info = self._describe(found)
        return found

    def _add_imu(
        self, topics: TopicChoice | None, found: BagCalibration, facts: ImuFacts
    ) -> BagImu | None:
        """Add the IMU to what is known, placed by the calibration, else by tf; return it."""
        camera, asked = self._topics.first, topics.imu if topics else None
        hint = facts.get("topic", "")
        chosen = find_imu(self._reader, camera, asked, hint, self._where, stamp_of=self._stamp_of)
        if isinstance(chosen, Failure):
            self.info.decisions.extend(f"imu: none: {each}" for each in [chosen.reason] if each)
            return None
        imu, origin = make_imu(facts, found.T_body_cam, self._imu_config), "the calibration"
        if imu.T_camera_imu is None:
            mount = self._mount(chosen)
            if not isinstance(mount, Failure):
                imu, origin = replace(imu, T_camera_imu=mount[0]), mount[1]
        samples = partial(read_samples, self._reader, chosen, self._stamp_of)
        stream = ImuStream(name=chosen.gyro.name, imu=imu, samples=samples)
        self.info = with_imu(self.info, stream, chosen.describe(), origin)
        return chosen

    @property
    def _stamp_of(self) -> StampOf:
        return attrgetter("log_time_ns") if self._takes_log_time else header_stamp

    def _mount(self, imu: BagImu) -> tuple[FloatArray, str] | Failure:
        """Return T_camera_imu by what the bag holds, and where it was found."""
        found = of_realsense(self._reader, self.image_topics[0], imu.gyro.name)
        frames = self.info.frame_id, imu.frame_id
        if not isinstance(found, Failure) or not all(frames):
            return found
        T = lookup_mount(self.transforms(frames), frames, 0)
        return T if isinstance(T, Failure) else (T, f"tf {frames[0]} -> {frames[1]}")

    @property
    def image_topics(self) -> tuple[str, str]:
        """Names of the topics of stream 0 and 1."""
        return self._topics.first.name, self._topics.second.name

    __repr__ = shown

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both topics in the order of recording.

        Raises
        ------
        RecordingError
            At the end, where a part of the bag could not be read, or a topic that announces
            messages yields none.
        """
        counts, stamps = [0, 0], ImageStamps()
        self._watch = watch = CameraInfoWatch()
        for message in self._reader.messages({*self.image_topics, *self._info_names}):
            if message.topic.name in self._info_names:
                watch.take(message)
                continue
            stream = self.image_topics.index(message.topic.name)
            counts[stream] += 1
            yield self._stamped(message, stream, stamps)
        if self._reader.damage:
            raise RecordingError(self._reader.damage)
        for topic, count in zip((self._topics.first, self._topics.second), counts, strict=True):
            if count == 0:
                raise RecordingError(
                    f"{self._where}: {topic.name} announces {topic.n_messages} messages but "
                    "yields none; record or convert the bag anew"
                )

    def transforms(self, frames: Collection[str] | None = None) -> TfBuffer:
        """Read `/tf` and `/tf_static`; of a long bag only what connects these frames."""
        if self._tf is None:
            self._tf = read_tf(self._reader, frames=frames)
        return self._tf if self._tf.is_whole else read_tf(self._reader, frames=frames)

    @property
    def camera_info_changes(self) -> dict[str, int]:
        """Of the images read last: the number of `CameraInfo` that differ from the one used."""
        return self._watch.counts

    def truth(
        self,
        spec: BagTruthSpec | None = None,
        *,
        base_frame: str = "",
        T_base_cam: FloatArray | None = None,
    ) -> Truth | Failure:
        """Return true poses of a base frame, or why there are none.

        Parameters
        ----------
        spec : TfTruth or str, optional
            What to read; omitted: what names itself ground truth.
        base_frame : str
            In tf; empty: the rectified left or colour camera.
        T_base_cam : ndarray of float64, shape (4, 4), optional
            Where the camera is mounted on it, if that does not come from tf.

        Raises
        ------
        RecordingError
            When the bag does not hold what was asked for.
        """
        whole = self.transforms(TRUTH_FRAMES)
        buffer = whole if whole.is_whole else None
        found: Poses | Failure
        if spec is None:
            found = find_named_truth(self._reader, self._where, buffer)
        else:
            found = read_poses(self._reader, spec, where=self._where, buffer=buffer)
        if isinstance(found, Failure):
            return found
        frames = [found.child_frame, base_frame, self.info.frame_id]
        return in_frame(
            found,
            self.transforms([name for name in frames if name]),
            base_frame=base_frame,
            camera_frame=self.info.frame_id,
            T_base_cam=T_base_cam,
        )

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the rectified camera, where the bag names it ground truth."""
        found = self.truth()
        return None if isinstance(found, Failure) else found.trajectory

    def _describe(self, found: BagCalibration) -> RecordingInfo:
        decisions = [*self._reader.notes, self._topics.describe(), *found.decisions]
        if self._topics.sensor == "rgbd":
            decisions.append(
                f"depth: metres where it is 32FC1, {self._scale:g} counts per metre where 16UC1"
            )
        return RecordingInfo(
            name=self._name,
            sensor=self._topics.sensor,
            calibrations=found.calibrations,
            n_images=self._topics.first.n_messages,
            decisions=decisions,
            depth_view=found.depth_view,
            frame_id=found.frame_id,
            T_body_cam=found.T_body_cam,
        )

    def _choose_topics(self, choice: TopicChoice) -> CameraTopics:
        try:
            return choose_topics(self._reader.topics, choice, self._where)
        except RecordingError as error:
            if not self._reader.damage:
                raise
            raise RecordingError(f"{error}; {self._reader.damage}") from error

    def _stamped(self, message: BagMessage, stream: int, stamps: ImageStamps) -> StampedImage:
        log_time_ns = min(message.log_time_ns, _LATEST_NS)
        try:
            content = message.decode()
        except RecordingError as error:
            stamp_ns, load = stamps.of_damaged(message, stream), partial(_fail, str(error))
        else:
            stamp_ns = stamp_of(content.header)
            load = partial(self._decoder(message.topic, stream), content)
        stamp_ns = log_time_ns if self._takes_log_time else stamp_ns
        stamps.last_ns[stream].append(stamp_ns)
        if log_time_ns != message.log_time_ns:
            reason = f"{message.topic.name}: recorded at {message.log_time_ns} ns, which is no time"
            load = partial(_fail, reason)
        return StampedImage(
            stream=stream,
            stamp_ns=stamp_ns,
            load=load,
            log_time_ns=log_time_ns,
            n_bytes=len(message.data),
        )

    def _decoder(self, topic: Channel, stream: int) -> Callable[[Any], NDArray[Any]]:
        is_compressed = topic.type == COMPRESSED_TYPE
        if stream == 1 and self._topics.sensor == "rgbd":
            decode_counts = decode_compressed_depth if is_compressed else decode_depth
            return partial(decode_counts, scale=self._scale, where=topic.name)
        decode = decode_compressed if is_compressed else decode_grey_or_color
        return partial(decode, where=topic.name, grey_range=self._images_config)


def _describe_parts(paths: Sequence[Path], reader: BagReader, reason: str) -> str:
    names = [str(file.path) for file in reader.loose_files]
    listed = ", ".join(names[:_N_LISTED]) + (", ..." if len(names) > _N_LISTED else "")
    given = " ".join(map(str, paths[:_N_LISTED]))
    return (
        f"{len(names)} bags are not one recording, {reason}: {listed}; give one of them, or those "
        f"that belong together; `gvo batch {given} --out DIR` runs each"
    )


def _fail(reason: str) -> NDArray[Any]:
    raise RecordingError(reason)


def read_transforms(source: Source, frames: Collection[str]) -> TfBuffer | None:
    """Return what a bag knows of frames; None where the recording is no bag."""
    if not isinstance(source, BagSource):
        return None
    return source.transforms([name for name in frames if name])


def describe_camera_changes(source: Source) -> str | None:
    """Say which `CameraInfo` of the images read differ from the one used; None for no bag."""
    changes: Mapping[str, int] | None = getattr(source, "camera_info_changes", None)
    return None if changes is None else ", ".join(f"{n} of {name}" for name, n in changes.items())
