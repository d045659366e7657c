"""A run as a file for the Rerun viewer, written while the run goes.

Entities

===========================================  ======================================================
`world`                                      x right, y down, z forward, or x forward, z up
`world/NAME/frame`                           poses; NAME: raw, causal, smoothed, global
`world/NAME/path`                            where it was up to the last full second
`world/NAME/covariance`                      3-sigma ellipsoid of the position; NAME: raw, causal
`world/causal/frame/camera`                  how the camera sits in the frame
`world/causal/frame/camera/image`            its pinhole model and the image
`world/causal/frame/camera/points`           matched points: inliers blue, outliers orange
`world/keyframes`, `.../covariance`          the kept frames as they were placed when they came
`world/links`                                the edges that came with the frame
`world/loops`                                lines between causal poses, when confirmed
`world/global/loops`                         lines between global poses, at the end
`world/cloud`                                points of each keyframe, placed when it came
`overlay`                                    matches drawn over the image
`counts/...`, `milliseconds/...`             matches, inliers, points; time by stage
`chi2/...`                                   of the accepted edges by kind, their mean
`status`, `configuration`                    a line per frame; what was set
===========================================  ======================================================

All is logged on two timelines: `stamp`, and `frame`, the number of the frame, faulty ones counted.
Stamps before the year 2000 are durations, others dates. A pose has its own stamp, a smoothed one
too; lines, ellipsoids and numbers have that of the frame with which they were known.

Whole paths are written at each full second of the recording and at the end. The ones in between
hold every pose, every second, every fourth ... so that there are at most 500 and the file grows
with the length of the run, not with its square; those at the end hold all poses. The viewer keeps
positions in single precision.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from gvo.config import Config, describe_configuration
from gvo.errors import ConfigurationError, RecordingError, missing_extra
from gvo.frontend.klt import image_of
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.io.convert.bag_messages import pose_numbers
from gvo.io.images import encode_image
from gvo.io.run_folder.line_file import PartFile
from gvo.runs.outputs.file import FileOutput
from gvo.runs.outputs.frames import RunFrames
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    Optimum,
    Status,
)
from gvo.viz import palette
from gvo.viz.overlay import compose_overlay
from gvo.viz.scene import ESTIMATES, GLOBAL, History, Scene, ellipsoids, grey_values, scene
from gvo.viz.scene import Path as PosePath

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise missing_extra("--rerun needs rerun-sdk", "rerun") from error

SUFFIX: Final = ".rrd"
N_FRAMES_HELD: Final = 20
"""Frames after which what was logged must be in the file."""
N_SIGMAS: Final = 3.0
"""Half-axes of an ellipsoid, in standard deviations."""
EARLIEST_DATE_NS: Final = 946_684_800 * 10**9
"""1 January 2000: stamps before that are no dates but durations since a start."""

_STAMP, _FRAME = "stamp", "frame"
_TRACKED, _CAMERA = "world/causal/frame", "world/causal/frame/camera"
_CLOUD, _LOOPS = "world/cloud", "world/loops"
_OVERLAY, _COUNTS, _MILLISECONDS, _CHI2 = "overlay", "counts", "milliseconds", "chi2"
_STATUS, _CONFIGURATION = "status", "configuration"
_COUNTED = ("matches", "inliers", "points")
_LEVELS: Final = {
    Status.OK: rr.TextLogLevel.INFO,
    Status.RESUMED: rr.TextLogLevel.WARN,
    Status.COASTING: rr.TextLogLevel.WARN,
    Status.LOST: rr.TextLogLevel.ERROR,
    Status.SKIPPED: rr.TextLogLevel.ERROR,
}
# Sizes on the screen, so that they are seen from any distance.
_LINE: Final = rr.Radius.ui_points(1.5)
_THIN_LINE: Final = rr.Radius.ui_points(0.75)
_DOT: Final = rr.Radius.ui_points(4.0)
_SMALL_DOT: Final = rr.Radius.ui_points(1.5)


class RunRerun(FileOutput):
    """A Rerun file of the results of a run, see `FileOutput`; no viewer is started.

    Parameters
    ----------
    path : Path
        Ends in `.rrd`. Its folder is made where it is missing.
    camera : PinholeCamera or StereoCamera
        Of the rectified frames.
    frames : RunFrames, optional
        Whose poses they are, and how the camera sits there.
    config : Config, optional
        Shown beside the scene.

    Raises
    ------
    ConfigurationError
        When the environment variable RERUN switches rerun off.
    RecordingError
        When the path exists, ends otherwise or cannot be written; so do all methods.
    """

    def __init__(
        self,
        path: str | Path,
        camera: PinholeCamera,
        frames: RunFrames | None = None,
        *,
        config: Config | None = None,
    ) -> None:
        self.path = Path(path)
        self._camera, self._frames = camera, frames or RunFrames()
        self._history = History()
        self._n_seen = 0  # frames, faulty ones too
        self._stamps_ns, self._indices = array("q"), array("q")  # of the frames with a pose
        self._is_dated: bool | None = None
        self._series: set[str] = set()
        if self.path.suffix != SUFFIX:
            raise RecordingError(
                f"{path}: expected a name ending in {SUFFIX}, got {self.path.name}"
            )
        self._open(config)

    def _open(self, config: Config | None) -> None:
        self._recording = rr.RecordingStream("gvo", send_properties=False)
        if not rr.is_enabled(self._recording):
            raise ConfigurationError(
                "--rerun: the environment variable RERUN switches rerun off; unset it"
            )
        self._recording.set_log_time_enabled(False)
        self._part = PartFile(self.path)
        with self._part.refused_on_error():
            self._file = self._part.part.open("wb")
        self._stream = rr.binary_stream(self._recording)
        self._recording.send_blueprint(_layout())
        self._recording.send_recording_name(self.path.stem)
        self._log(f"{_CAMERA}/image", _pinhole(self._camera), is_static=True)
        for name in ESTIMATES:
            self._log(f"world/{name}/frame", _marker(name), is_static=True)
        if config is not None:
            text = rr.TextDocument(describe_configuration(config))
            self._log(_CONFIGURATION, text, is_static=True)

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Write the result of a frame, with poses of the base frame."""
        if not self._stamps_ns:
            self._add_world(result)
        self._stamps_ns.append(frame.stamp_ns)
        self._indices.append(self._n_seen)
        self._history.add(result)
        seen = scene(result, self._history)
        self._add_status(frame.stamp_ns, result.status, "; ".join(seen.caption))
        image = image_of(frame)
        overlay = compose_overlay(frame, result, self._camera, index=self._n_seen - 1)
        self._log(_OVERLAY, _picture(overlay))
        self._log(f"{_CAMERA}/image", _picture(image))
        self._add_poses(seen)
        self._add_points(image, seen, is_keyframe=result.stamp_ns in result.keyframes_ns)
        self._add_lines(seen)
        self._add_numbers(seen)
        self._add_late("smoothed", result.finished)
        if len(self._stamps_ns) % N_FRAMES_HELD == 0:
            self._write()

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses of the base frame that are final, in any order."""
        estimates = tuple(estimates)
        self._history.add_late("smoothed", estimates)
        self._add_late("smoothed", estimates)

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses of the base frame, and the loops that count."""
        self._history.add_late(GLOBAL, optimum.estimates)
        self._log(f"world/{GLOBAL}/frame", _marker(GLOBAL), is_static=True)
        self._add_late(GLOBAL, optimum.estimates)
        self._set_frame(self._stamps_ns[-1])
        loops = self._history.tracks[GLOBAL].lines(optimum.loops)
        self._log(f"world/{GLOBAL}/loops", _lines({"loops": loops}, _LINE))

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write a frame without a pose to the log."""
        self._add_status(frame.stamp_ns, Status.SKIPPED, f"skipped: {frame.reason}")

    def _complete(self) -> None:
        """Write the whole paths and give the file its name."""
        with self._part.completed(is_kept=len(self._stamps_ns) > 0), self._file:
            if self._stamps_ns:
                self._set_frame(self._stamps_ns[-1])
                self._add_paths(self._history.paths())
            self._write()

    def _discard(self) -> None:
        with self._part.discarded():
            self._file.close()

    def _write(self) -> None:
        """Write to the file what was logged since the last time."""
        with self._part.refused_on_error():
            self._file.write(self._stream.read() or b"")

    def _log(self, entity: str, archetype: rr.AsComponents, *, is_static: bool = False) -> None:
        """Log to an entity, at the frame that was set or for all frames."""
        self._recording.log(entity, archetype, static=is_static, strict=True)

    def _set_frame(self, stamp_ns: int) -> None:
        """Set the frame of what is logged next; of a pose that comes late it is looked up."""
        row = bisect_left(self._stamps_ns, stamp_ns)
        self._set_time(stamp_ns, self._indices[row])

    def _set_time(self, stamp_ns: int, index: int) -> None:
        if self._is_dated is None:  # the first stamp decides
            self._is_dated = stamp_ns >= EARLIEST_DATE_NS
        self._recording.set_time(_FRAME, sequence=index)
        if self._is_dated:
            self._recording.set_time(_STAMP, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._recording.set_time(_STAMP, duration=np.timedelta64(stamp_ns, "ns"))

    def _add_world(self, result: FrameResult) -> None:
        """Log the axes of the world, and how the camera is mounted."""
        is_optical = self._frames.is_world_optical or (
            # A camera in a world of its recording: one with y down, or one with z up.
            self._frames.is_camera and result.causal.T_world_frame[1, 1] > np.cos(np.pi / 4)
        )
        axes = rr.ViewCoordinates.RDF if is_optical else rr.ViewCoordinates.FLU
        self._log("world", axes, is_static=True)
        if not callable(self._frames.T_base_cam):
            mount = _transform(self._frames.mount(result.stamp_ns))
            self._log(_CAMERA, mount, is_static=True)

    def _add_status(self, stamp_ns: int, status: Status, text: str) -> None:
        """Log the status line of a new frame."""
        self._set_time(stamp_ns, self._n_seen)
        self._n_seen += 1
        self._log(_STATUS, rr.TextLog(text, level=_LEVELS[status]))

    def _add_poses(self, seen: Scene) -> None:
        for name, estimate in seen.poses.items():
            self._log(f"world/{name}/frame", _transform(estimate.T_world_frame))
            self._log(f"world/{name}/covariance", _ellipsoids(name, [estimate]))
        if callable(self._frames.T_base_cam):
            self._log(_CAMERA, _transform(self._frames.mount(seen.stamp_ns)))
        dots = _positions(seen.keyframes)
        colour = palette.rgb(palette.DRAWN["keyframes"])
        self._log("world/keyframes", rr.Points3D(dots, colors=colour, radii=_DOT))
        self._log("world/keyframes/covariance", _ellipsoids("keyframes", seen.keyframes))

    def _add_late(self, name: str, estimates: Iterable[Estimate]) -> None:
        """Log poses at their own stamps."""
        for estimate in estimates:
            self._set_frame(estimate.stamp_ns)
            self._log(f"world/{name}/frame", _transform(estimate.T_world_frame))

    def _add_points(self, image: ImageArray, seen: Scene, *, is_keyframe: bool) -> None:
        """Log the matched points, and the inliers of a keyframe in the world."""
        points = seen.points
        found = np.where(
            points.inliers[:, np.newaxis],
            palette.rgb(palette.INLIERS),
            palette.rgb(palette.OUTLIERS),
        )
        self._log(f"{_CAMERA}/points", _dots(points.points_cam, found))
        if not is_keyframe or len(points.points_cam) == 0:
            return
        is_shown = points.inliers & np.isfinite(points.pixels).all(axis=1)
        greys = grey_values(image, points.pixels[is_shown])
        mount = self._frames.mount(seen.stamp_ns)
        T_world_cam = seen.poses["causal"].T_world_frame @ mount
        points_world = se3.transform_points(T_world_cam, points.points_cam[is_shown])
        self._log(_CLOUD, _dots(points_world, np.repeat(greys[:, np.newaxis], 3, axis=1)))

    def _add_lines(self, seen: Scene) -> None:
        """Log links and loops; whole paths where a new second of the recording has begun."""
        links = {name: lines for name, lines in seen.lines.items() if name != "loops"}
        self._log("world/links", _lines(links, _THIN_LINE))
        if "loops" in seen.lines:
            self._log(_LOOPS, _lines({"loops": seen.lines["loops"]}, _LINE))
        self._add_paths(seen.paths)

    def _add_paths(self, paths: Mapping[str, PosePath]) -> None:
        for name, (_, poses) in paths.items():
            self._log(f"world/{name}/path", _strip(name, poses[:, :3]))

    def _add_numbers(self, seen: Scene) -> None:
        for name in _COUNTED:
            self._add_number(f"{_COUNTS}/{name}", name, seen.counts[name], palette.COUNTS)
        for stage, ms in seen.stage_ms.items():
            self._add_number(f"{_MILLISECONDS}/{stage}", f"{stage} [ms]", ms, palette.STAGES)
        for kind, mean in seen.chi2.items():
            self._add_number(f"{_CHI2}/{kind}", kind, mean, palette.LINKS)

    def _add_number(self, entity: str, name: str, value: float, colours: dict[str, str]) -> None:
        if entity not in self._series:
            self._series.add(entity)
            code = colours.get(entity.rpartition("/")[2])
            colour = None if code is None else palette.rgb(code)
            series = rr.SeriesLines(names=name, colors=colour, widths=1.5)
            self._log(entity, series, is_static=True)
        self._log(entity, rr.Scalars([value]))


def _layout() -> rrb.Blueprint:
    """Return the scene, and beside it the overlay, the numbers and the log."""
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(name, start=start, end=now) for name in (_STAMP, _FRAME)]
    so_far = rrb.VisibleTimeRanges(ranges)  # of keyframes' points and loops
    world = rrb.Spatial3DView(
        origin="world", name="Scene", overrides={_CLOUD: so_far, _LOOPS: so_far}
    )
    beside = rrb.Vertical(
        rrb.Tabs(
            rrb.Spatial2DView(origin=_OVERLAY, name="Matches"),
            rrb.TextDocumentView(origin=_CONFIGURATION, name="Configuration"),
        ),
        rrb.TimeSeriesView(origin=_COUNTS, name="Counts"),
        rrb.Tabs(
            rrb.TimeSeriesView(origin=_MILLISECONDS, name="Milliseconds"),
            rrb.TimeSeriesView(origin=_CHI2, name="Chi-square of the edges"),
        ),
        rrb.TextLogView(origin=_STATUS, name="Status"),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(world, beside, column_shares=[3, 2]),
        rrb.TimePanel(timeline=_STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _transform(T_parent_child: FloatArray) -> rr.Transform3D:
    numbers = pose_numbers(T_parent_child)
    return rr.Transform3D(translation=numbers[:3], quaternion=rr.Quaternion(xyzw=numbers[3:]))


def _marker(name: str) -> rr.Points3D:
    """Return a dot at the origin of a frame, in the colour of its estimate."""
    return rr.Points3D([np.zeros(3)], colors=palette.rgb(palette.DRAWN[name]), radii=_DOT)


def _strip(name: str, positions: FloatArray) -> rr.LineStrips3D:
    """Return positions (n, 3) as one line in the colour of its estimate."""
    strips = [positions] if len(positions) > 1 else []
    return rr.LineStrips3D(strips, colors=palette.rgb(palette.DRAWN[name]), radii=_LINE)


def _lines(lines: dict[str, FloatArray], width: ArrayLike) -> rr.LineStrips3D:
    """Return lines (n, 2, 3) by name in their colours."""
    strips = [ends for found in lines.values() for ends in found]
    colours = [palette.rgb(palette.DRAWN[name]) for name, found in lines.items() for _ in found]
    return rr.LineStrips3D(strips, colors=colours or None, radii=width)


def _ellipsoids(name: str, estimates: Sequence[Estimate]) -> rr.Ellipsoids3D:
    found = ellipsoids(estimates, N_SIGMAS)
    return rr.Ellipsoids3D(
        centers=found.centres,
        half_sizes=found.half_axes,
        quaternions=found.quaternions_xyzw,
        colors=palette.rgb(palette.DRAWN[name]),
        line_radii=_THIN_LINE,
    )


def _positions(estimates: Sequence[Estimate]) -> FloatArray:
    return np.array([e.T_world_frame[:3, 3] for e in estimates]).reshape(-1, 3)


def _dots(points: FloatArray, colours: FloatArray | ImageArray) -> rr.Points3D:
    # Rerun cannot tell the shape of an empty array of colours.
    kept = colours.astype(np.uint8) if len(points) > 0 else None
    return rr.Points3D(points.reshape(-1, 3), colors=kept, radii=_SMALL_DOT)


def _picture(image: ImageArray) -> rr.EncodedImage:
    return rr.EncodedImage(contents=encode_image(image, ".jpg"), media_type="image/jpeg")


def _pinhole(camera: PinholeCamera) -> rr.Pinhole:
    return rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
