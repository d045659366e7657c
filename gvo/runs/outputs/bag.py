"""A run as a bag for RViz and Foxglove, written while the run goes.

Topics (frames: see `RunFrames`)

===========================  ==============================  ======================================
`/tf`, `/tf_static`          `tf2_msgs/TFMessage`            the frames and their poses
`/gvo/NAME/odometry`         `nav_msgs/Odometry`             NAME: raw, causal, smoothed, global
`/gvo/odom/odometry`         `nav_msgs/Odometry`             the pose that never jumps, REP 105
`/gvo/NAME/path`             `nav_msgs/Path`                 NAME: raw, smoothed, global
`/gvo/loops`                 `visualization_msgs/Marker`     a line for each loop, by namespace
`/gvo/points`                `sensor_msgs/PointCloud2`       matched points in `gvo/causal/CAMERA`
`/gvo/matches/compressed`    `sensor_msgs/CompressedImage`   matches drawn over the image
`/diagnostics`               `diagnostic_msgs/...Array`      status, counts, milliseconds
===========================  ==============================  ======================================

All stamps are those of the frames. The log time is the stamp of the newest frame at the time: a
smoothed pose appears when it was known, with its own, earlier stamp. Raw and causal poses,
points, pictures and diagnostics come once a frame; a frame without a registration has an empty
cloud and a picture without lines.

The frames of REP 105 stand beside those of the estimates: from the world, its `map`, to `gvo/odom`
to the base frame. The pose in `gvo/odom` is the product of the steps from frame to frame, each as
the window has it when the frame comes: it drifts and never jumps. Corrections move `gvo/odom`; both
together are the causal pose, corrected by the loops that were closed so far.

Global poses come at the end, with their own stamps. Loops are drawn when they are confirmed,
between the causal poses of their frames (namespace `causal`); at the end all that count, between
the global ones (`global`).

The velocity of an `Odometry` is that of the base frame at the stamp by the IMU, where it knows it,
for the raw and causal poses and those in `gvo/odom`, with its covariance. Otherwise it is that from
the pose before, as far as it was known, to this one; 0 where none was. Its covariance is that of
the registration between the two, for the raw poses and those in `gvo/odom`; elsewhere, and where
they coast, its diagonal is -1.

Smoothed poses of keyframes come late, when all that sees them has left the window. A tf buffer
drops what is more than its cache time (10 s by default) behind; `Odometry` and the paths hold
them all.

Paths are written at each full second of the recording and at the end. The ones in between hold
every pose, every second, every fourth ... so that there are at most 500 and the file grows with
the length of the run, not with its square; those at the end hold all poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Final

import numpy as np
from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from gvo.errors import RecordingError
from gvo.frontend.klt import image_of
from gvo.geometry import se3
from gvo.geometry.edges import NO_EFFECTS, between
from gvo.io.bag.reader import TF_TYPE
from gvo.io.bag.topics import COMPRESSED_TYPE
from gvo.io.convert.bag_messages import (
    BagWriter,
    Header,
    MessageWriter,
    write_compressed,
    write_transforms,
)
from gvo.io.run_folder.line_file import PartFile
from gvo.runs.outputs import bag_messages as messages
from gvo.runs.outputs.file import FileOutput
from gvo.runs.outputs.frames import ODOM, RunFrames, twist_of
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    InertialState,
    Optimum,
    Status,
)
from gvo.viz.overlay import draw_matches
from gvo.viz.scene import GLOBAL, History, Scene, StampedPose, grey_values, placed_matches, scene
from gvo.viz.scene import Path as PosePath

SUFFIXES: Final = (".mcap", ".bag")
_POINTS, _PICTURE = "/gvo/points", "/gvo/matches/compressed"
TOPICS: Final = {
    "/tf": TF_TYPE,
    "/tf_static": TF_TYPE,
    **{
        f"/gvo/{name}/odometry": messages.ODOMETRY_TYPE
        for name in ("raw", "causal", ODOM, "smoothed", GLOBAL)
    },
    **{f"/gvo/{name}/path": messages.PATH_TYPE for name in ("raw", "smoothed", GLOBAL)},
    "/gvo/loops": messages.MARKER_TYPE,
    _POINTS: messages.CLOUD_TYPE,
    _PICTURE: COMPRESSED_TYPE,
    "/diagnostics": messages.DIAGNOSTICS_TYPE,
}
"""All topics, with their types."""


class RunMessages:
    """The results of a run as messages, written to a bag or into a network.

    Parameters
    ----------
    writer : MessageWriter
        Where to.
    frames : RunFrames
    """

    def __init__(self, writer: MessageWriter, frames: RunFrames) -> None:
        self._writer, self._frames = writer, frames
        self._history = History()
        self._numbers = count()
        self._T_odom_base = np.eye(4)
        self._last: Estimate | None = None  # of the raw chain
        self._first_ns: int | None = None
        self._newest_ns = 0

    @property
    def has_frames(self) -> bool:
        """Whether any frame was written."""
        return self._first_ns is not None

    def restart_paths(self) -> None:
        """Forget the poses so far, as where the world is another one from now on."""
        self._history = History()

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Write the result of a frame, with poses of the base frame."""
        self._begin(frame.stamp_ns)
        self._history.add(result)
        seen = scene(result, self._history)
        self._write_odom(result)
        self._write_tf(seen.poses.items())
        covariance, inertial = self._step_covariance(result, result.raw), result.inertial
        self._write_odometry("raw", result.raw, covariance, inertial)
        self._write_odometry("causal", result.causal, None, inertial)
        self._last = result.raw
        self._write_matches(frame, result, seen)
        if "loops" in seen.lines:
            self._write_loops("causal", seen.lines["loops"])
        self._write_paths(seen.paths)
        self._write_late("smoothed", result.finished)

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses of the base frame that are final, in any order."""
        estimates = tuple(estimates)
        self._history.add_late("smoothed", estimates)
        self._write_late("smoothed", estimates)

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses of the base frame, and the loops that count."""
        self._history.add_late(GLOBAL, optimum.estimates)
        self._write_late(GLOBAL, optimum.estimates)
        self._write_loops(GLOBAL, self._history.tracks[GLOBAL].lines(optimum.loops))

    def _write_late(self, name: str, estimates: Iterable[Estimate]) -> None:
        estimates = sorted(estimates, key=lambda estimate: estimate.stamp_ns)
        self._write_tf([(name, estimate) for estimate in estimates])
        for estimate in estimates:
            self._write_odometry(name, estimate)

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write a frame without a pose to the diagnostics."""
        if self._first_ns is None:
            return
        header = Header(frame.stamp_ns, self._frames.camera)
        try:
            self._writer.header(header)
        except RecordingError:  # its stamp is what is wrong with it
            header = Header(self._newest_ns, self._frames.camera)
        messages.write_diagnostics(
            self._writer, header, Status.SKIPPED, f"skipped: {frame.reason}", {}
        )

    def _begin(self, stamp_ns: int) -> None:
        """Note the stamp of a frame; at the first, write the static transforms."""
        self._writer.header(Header(stamp_ns, ""))  # refuses a stamp that does not fit
        self._newest_ns = stamp_ns
        if self._first_ns is not None:
            return
        self._first_ns = stamp_ns
        write_transforms(self._writer, "/tf_static", self._frames.fixed(stamp_ns), is_latched=True)

    def _write_tf(self, named: Iterable[tuple[str, Estimate]]) -> None:
        poses = [self._frames.moving(name, estimate) for name, estimate in named]
        write_transforms(self._writer, "/tf", chain.from_iterable(poses))

    def _write_odom(self, result: FrameResult) -> None:
        """Go on by the step of a frame, and write where that leads and what corrects it."""
        previous = None
        if result.T_previous_frame is not None and self._last is not None:
            previous = StampedPose(self._last.stamp_ns, self._T_odom_base)
            self._T_odom_base = se3.normalize(self._T_odom_base @ result.T_previous_frame)
        frames, causal = self._frames, result.causal
        T_world_base = result.T_map_world @ causal.T_world_frame
        poses = frames.corrected(result.stamp_ns, T_world_base, self._T_odom_base)
        write_transforms(self._writer, "/tf", poses)
        estimate = replace(causal, T_world_frame=self._T_odom_base)
        covariance = self._step_covariance(result, causal)
        twist = twist_of(estimate, previous, covariance, result.inertial)
        names = frames.odom, frames.base_by(ODOM)
        messages.write_odometry(self._writer, f"/gvo/{ODOM}/odometry", estimate, names, twist)

    def _write_loops(self, name: str, lines: FloatArray) -> None:
        if len(lines) > 0:
            header, number = Header(self._newest_ns, self._frames.world), next(self._numbers)
            messages.write_lines(self._writer, header, lines, name=name, number=number)

    def _step_covariance(self, result: FrameResult, pose: Estimate) -> FloatArray | None:
        """Return the covariance (6, 6) of the last step to a pose by its registration, if known.

        After coasting, the registration is against an older frame than the pose before.
        """
        last = self._last
        is_step = last is not None and last.status == pose.status == Status.OK
        if last is None or not is_step or result.registration is None:
            return None
        mount = self._frames.mount(pose.stamp_ns)
        covariance = se3.transport_covariance(result.registration.covariance, mount)
        start, end = (NO_EFFECTS if e.effects is None else e.effects for e in (last, result.raw))
        T = se3.invert(last.T_world_frame) @ result.raw.T_world_frame
        effects = between(start, end, T)
        return np.asarray(covariance + effects @ effects.T)

    def _write_odometry(
        self,
        name: str,
        estimate: Estimate,
        step_covariance: FloatArray | None = None,
        inertial: InertialState | None = None,
    ) -> None:
        previous = self._history.tracks[name].before(estimate.stamp_ns)
        messages.write_odometry(
            self._writer,
            f"/gvo/{name}/odometry",
            estimate,
            (self._frames.world, self._frames.base_by(name)),
            twist_of(estimate, previous, step_covariance, inertial),
        )

    def _write_matches(self, frame: Frame, result: FrameResult, seen: Scene) -> None:
        """Write diagnostics, points and picture of a frame; the last two where they are wanted."""
        hardware = Header(frame.stamp_ns, self._frames.camera)
        numbers, text = _numbers(result, seen.counts), " ".join(seen.caption)
        messages.write_diagnostics(self._writer, hardware, result.status, text, numbers)
        header, image = Header(frame.stamp_ns, self._frames.camera_by("causal")), image_of(frame)
        if self._writer.is_wanted(_POINTS):
            greys = grey_values(image, seen.points.pixels)
            messages.write_points(self._writer, _POINTS, header, seen.points, greys)
        if self._writer.is_wanted(_PICTURE):
            found = placed_matches(result)
            matches = found.pixels_reference, found.pixels_current, found.inliers
            picture = draw_matches(image, *matches, lines=seen.caption)
            write_compressed(self._writer, _PICTURE, picture, header, ".jpg")

    def write_paths(self) -> None:
        """Write the paths so far, of all poses."""
        self._write_paths(self._history.paths())

    def _write_paths(self, paths: Mapping[str, PosePath]) -> None:
        header = Header(self._newest_ns, self._frames.world)
        for name in ("raw", "smoothed", GLOBAL):
            topic = f"/gvo/{name}/path"
            if name in paths and self._writer.is_wanted(topic):
                messages.write_path(self._writer, topic, header, *paths[name])


class RunBag(RunMessages, FileOutput):
    """A bag of the results of a run, see `FileOutput`.

    Parameters
    ----------
    path : Path
        `.mcap`: one file of ROS 2; `.bag`: of ROS 1. Its folder is made where it is missing.
    frames : RunFrames, optional

    Raises
    ------
    RecordingError
        When the path exists, ends otherwise or cannot be written; so do all methods.
    """

    def __init__(self, path: str | Path, frames: RunFrames | None = None) -> None:
        self.path = Path(path)
        if self.path.suffix not in SUFFIXES:
            raise RecordingError(
                f"{path}: expected a name ending in .mcap (ROS 2) or .bag (ROS 1), got "
                f"{self.path.name}"
            )
        self._file = PartFile(self.path, WriterError1, WriterError2)
        with self._file.refused_on_error():
            self._bag = _PartWriter(self._file)
            self._bag.__enter__()
        super().__init__(self._bag, frames or RunFrames())

    def _complete(self) -> None:
        """Write the whole paths and give the file its name."""
        with self._file.completed(is_kept=self.has_frames):
            try:
                if self.has_frames:
                    self.write_paths()
            finally:
                self._bag.__exit__(None, None, None)
                self._file.part = self._bag.result

    def _discard(self) -> None:
        with self._file.discarded():
            self._bag.__exit__(None, None, None)


class _PartWriter(BagWriter):
    """Writes a bag; what cannot be written is a RecordingError."""

    def __init__(self, file: PartFile) -> None:
        super().__init__(file.part)
        self._file = file

    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        """Write a message."""
        with self._file.refused_on_error():
            super().write(topic, type_, message, stamp_ns, is_latched=is_latched)


def _numbers(result: FrameResult, counts: dict[str, int]) -> dict[str, object]:
    """Return the values of the diagnostics."""
    shown = ("keypoints", "points", "matches", "inliers", "links", "refused", "loops")
    stages = {f"{stage} [ms]": f"{ms:.3f}" for stage, ms in result.stage_ms.items()}
    return {
        "status": result.status,
        "status of the raw chain": result.raw.status,
        **{"refused edges" if name == "refused" else name: counts[name] for name in shown},
        **stages,
    }
