"""An open Rerun file, and what of a run goes into it."""

from __future__ import annotations

import os
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from threading import Thread
from typing import Final

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from gvo.frontend.klt import image_of
from gvo.geometry.camera import PinholeCamera
from gvo.io.convert.bag_messages import pose_numbers
from gvo.io.images import encode_image
from gvo.runs.outputs.frames import ESTIMATES, GLOBAL, RunFrames, Track
from gvo.types import (
    Estimate,
    FloatArray,
    Frame,
    FrameLink,
    FrameResult,
    ImageArray,
    Optimum,
    RelativePose,
    Status,
)
from gvo.viz import palette
from gvo.viz.overlay import NOTHING, Colour, caption, compose_overlay, placed_matches

_N_BYTES: Final = 2**20


class FilePipe:
    """A pipe into a file that never fails: what does not fit on the disk is dropped.

    rerun's writer may wait for ever where a write fails, as on a full disk.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    OSError
        When it cannot be made.

    Attributes
    ----------
    error : OSError or None
        Why the file could not be written, once it could not.
    entrance : Path
        The path to open for writing, once.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._file = path.open("wb", buffering=0)
        self._reader, self._writer = os.pipe()
        self.entrance = Path(f"/dev/fd/{self._writer}")
        self._thread = Thread(target=self._copy, name="gvo-file-pipe", daemon=True)
        self._thread.start()

    def leave(self) -> None:
        """Close this end: the file ends when the writer closes its own."""
        os.close(self._writer)

    def join(self) -> None:
        """Wait for the end of the file."""
        self._thread.join()

    def _copy(self) -> None:
        with self._file, os.fdopen(self._reader, "rb", buffering=0) as pipe:
            while data := pipe.read(_N_BYTES):
                self._keep(data)

    def _keep(self, data: bytes) -> None:
        if self.error is not None:
            return
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self.error = error


CLOUD: Final = "world/cloud"
LOOPS: Final = "world/loops"
OVERLAY: Final = "overlay"
COUNTS: Final = "counts"
MILLISECONDS: Final = "milliseconds"
CHI2: Final = "chi2"
STATUS: Final = "status"
CONFIGURATION: Final = "configuration"

STAMP: Final = "stamp"
FRAME: Final = "frame"


def make_layout() -> rrb.Blueprint:
    """Return the scene, and beside it the overlay, the numbers and the log."""
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin=OVERLAY, name="Matches"),
        rrb.TextDocumentView(origin=CONFIGURATION, name="Configuration"),
    )
    beside = rrb.Vertical(
        pictures,
        rrb.TimeSeriesView(origin=COUNTS, name="Counts"),
        rrb.Tabs(
            rrb.TimeSeriesView(origin=MILLISECONDS, name="Milliseconds"),
            rrb.TimeSeriesView(origin=CHI2, name="Chi-square of the edges"),
        ),
        rrb.TextLogView(origin=STATUS, name="Status"),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(_scene(), beside, column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene() -> rrb.Spatial3DView:
    """Return the view of the world; points of keyframes and loops are those that came so far."""
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(name, start=start, end=now) for name in (STAMP, FRAME)]
    so_far = rrb.VisibleTimeRanges(ranges)
    return rrb.Spatial3DView(origin="world", name="Scene", overrides={CLOUD: so_far, LOOPS: so_far})


APPLICATION: Final = "gvo"
EARLIEST_DATE_NS: Final = 946_684_800 * 10**9
"""1 January 2000: stamps before that are no dates but durations since a start."""

_N_BATCHED_BYTES: Final = 2**23
_TICK_S: Final = 3600.0


class RerunStream:
    """Archetypes at the stamps of frames, on the timelines `stamp` and `frame`.

    Nothing is written by the clock: what belongs together is cut into chunks by `flush` alone,
    or where it grows large.

    Parameters
    ----------
    path : Path
        Must end in `.rrd`.
    name : str
        Of the recording in the viewer.

    Raises
    ------
    OSError, RuntimeError
        When the file cannot be made.

    Attributes
    ----------
    is_enabled : bool
        False where the environment variable RERUN switches rerun off.
    """

    def __init__(self, path: Path, name: str) -> None:
        batches = rr.ChunkBatcherConfig(flush_tick=_TICK_S, flush_num_bytes=_N_BATCHED_BYTES)
        self._recording = rr.RecordingStream(
            APPLICATION, send_properties=False, batcher_config=batches
        )
        self._is_dated: bool | None = None
        self.is_enabled = rr.is_enabled(self._recording)
        if not self.is_enabled:
            return
        self._recording.set_log_time_enabled(False)
        self._pipe = FilePipe(path)
        try:
            self._recording.save(self._pipe.entrance, default_blueprint=make_layout())
        finally:
            self._pipe.leave()
        self._recording.send_recording_name(name)

    def set_frame(self, stamp_ns: int, index: int) -> None:
        """Set the frame of what is logged next.

        The first stamp decides whether the timeline shows dates or durations.

        Parameters
        ----------
        stamp_ns : int
            Nanoseconds.
        index : int
            Of the frame, from 0.
        """
        if self._is_dated is None:
            self._is_dated = stamp_ns >= EARLIEST_DATE_NS
        self._recording.set_time(FRAME, sequence=index)
        if self._is_dated:
            self._recording.set_time(STAMP, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._recording.set_time(STAMP, duration=np.timedelta64(stamp_ns, "ns"))

    def log(self, path: str, *archetypes: rr.AsComponents, is_static: bool = False) -> None:
        """Log to an entity, at the frame that was set or for all frames."""
        self._recording.log(path, *archetypes, static=is_static, strict=True)

    def flush(self) -> None:
        """Flush what was logged, so that it is not held in memory.

        Raises
        ------
        OSError
            When some of what was handed over before could not be written.
        """
        self._recording.flush()
        self._check()

    def close(self) -> None:
        """Finish the file.

        Raises
        ------
        OSError
            When it could not be written.
        """
        self._recording.flush()
        self._recording.disconnect()
        self._pipe.join()
        self._check()

    def _check(self) -> None:
        if self._pipe.error is not None:
            raise self._pipe.error


N_SHOWN_POSES: Final = 500
"""Most poses of a path while the run goes."""

_TRACKED: Final = "world/causal/frame"
_CAMERA: Final = f"{_TRACKED}/camera"


class RerunWriter:
    """Logs frame by frame.

    Parameters
    ----------
    stream : RerunStream
        Open.
    camera : PinholeCamera or StereoCamera
        Of the rectified frames.
    frames : RunFrames
        Whose poses they are, and how the camera sits there.
    text : str
        The configuration; none is shown where it is empty.
    """

    def __init__(
        self, stream: RerunStream, camera: PinholeCamera, frames: RunFrames, text: str
    ) -> None:
        self.stream = stream
        self._camera, self._frames = camera, frames
        self._n_seen = 0
        self._stamps_ns, self._indices = array("q"), array("q")  # of the frames with a pose
        self._first_ns: int | None = None
        self._n_seconds = 0
        self._tracks = {name: Track() for name in ESTIMATES}
        self._recent: dict[str, list[FloatArray]] = {"raw": [], "causal": []}
        self._keyframes: dict[int, Estimate] = {}
        self._series: set[str] = set()
        stream.log(f"{_CAMERA}/image", make_pinhole(camera), is_static=True)
        for name in ESTIMATES:
            stream.log(f"world/{name}/frame", make_marker(name), is_static=True)
        if text:
            stream.log(CONFIGURATION, rr.TextDocument(text), is_static=True)

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Log the result of a frame."""
        image = image_of(frame)
        self._begin(result)
        self._stamps_ns.append(frame.stamp_ns)
        self._indices.append(self._n_seen)
        self.add_status(frame.stamp_ns, result.status, "; ".join(caption(result)))
        self._add_poses(result)
        overlay = compose_overlay(frame, result, self._camera, index=self._n_seen - 1)
        self.stream.log(OVERLAY, make_image(overlay))
        self.stream.log(f"{_CAMERA}/image", make_image(halve(image)))
        self._add_points(image, result)
        self._add_links(result)
        self._add_numbers(result)
        self.add_smoothed(result.finished)
        self._add_lines(frame.stamp_ns)

    def add_status(self, stamp_ns: int, status: Status, text: str) -> None:
        """Log the status line of a new frame."""
        self.stream.set_frame(stamp_ns, self._n_seen)
        self._n_seen += 1
        self.stream.log(STATUS, rr.TextLog(text, level=_LEVELS[status]))

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Log poses at their own stamps."""
        self._add_late("smoothed", estimates)

    def add_optimum(self, optimum: Optimum) -> None:
        """Log the global poses at their own stamps, and the loops between them at the end."""
        track = self._tracks.setdefault(GLOBAL, Track())
        self.stream.log(f"world/{GLOBAL}/frame", make_marker(GLOBAL), is_static=True)
        self._add_late(GLOBAL, optimum.estimates)
        self._set_frame(self._stamps_ns[-1])
        self.stream.log(f"world/{GLOBAL}/loops", make_loops(track.segments(optimum.loops)))

    def _add_late(self, name: str, estimates: Iterable[Estimate]) -> None:
        for estimate in estimates:
            self._set_frame(estimate.stamp_ns)
            self.stream.log(f"world/{name}/frame", make_transform(estimate.T_world_frame))
            self._tracks[name].add(estimate)

    def add_paths(self, n_most: int | None = None) -> None:
        """Log the paths up to now, of at most `n_most` poses, at the newest frame."""
        self._set_frame(self._stamps_ns[-1])
        for name, track in self._tracks.items():
            positions = track.poses(n_most)[1][:, :3]
            self.stream.log(f"world/{name}/path", make_path(name, positions))
        for recent in self._recent.values():
            del recent[:-1]
        self._add_recent()

    def _begin(self, result: FrameResult) -> None:
        """Log, before the first pose, what is static."""
        if self._first_ns is not None:
            return
        self._first_ns = result.stamp_ns
        is_optical = self._frames.is_world_optical or (
            # A camera in a world of its recording: one with y down, or one with z up.
            self._frames.is_camera and result.causal.T_world_frame[1, 1] > np.cos(np.pi / 4)
        )
        axes = rr.ViewCoordinates.RDF if is_optical else rr.ViewCoordinates.FLU
        self.stream.log("world", axes, is_static=True)
        if not callable(self._frames.T_base_cam):
            mount = make_transform(self._frames.mount(result.stamp_ns))
            self.stream.log(_CAMERA, mount, is_static=True)

    def _set_frame(self, stamp_ns: int) -> None:
        # A smoothed pose comes late: its frame is looked up.
        self.stream.set_frame(stamp_ns, self._indices[bisect_left(self._stamps_ns, stamp_ns)])

    def _add_poses(self, result: FrameResult) -> None:
        for name, estimate in (("raw", result.raw), ("causal", result.causal)):
            path = f"world/{name}"
            self.stream.log(f"{path}/frame", make_transform(estimate.T_world_frame))
            self.stream.log(f"{path}/covariance", make_ellipsoids(name, [estimate]))
            self._tracks[name].add(estimate)
            self._recent[name].append(estimate.T_world_frame[:3, 3])
        if callable(self._frames.T_base_cam):
            self.stream.log(_CAMERA, make_transform(self._frames.mount(result.stamp_ns)))

    def _add_points(self, image: ImageArray, result: FrameResult) -> None:
        found = result.registration or NOTHING
        self.stream.log(f"{_CAMERA}/points", make_matches(found))
        if result.stamp_ns in result.keyframes_ns and len(found.points_current) > 0:
            T_world_cam = result.causal.T_world_frame @ self._frames.mount(result.stamp_ns)
            self.stream.log(CLOUD, make_cloud(placed_matches(result), image, T_world_cam))

    def _add_links(self, result: FrameResult) -> None:
        """Log the window's keyframes and the edges that came with the frame."""
        known = {**self._keyframes, result.stamp_ns: result.causal}
        self._keyframes = {ns: known[ns] for ns in result.keyframes_ns if ns in known}
        kept = list(self._keyframes.values())
        dots = rr.Points3D(_positions(kept), colors=COLOURS[KEYFRAMES], radii=_DOT)
        self.stream.log("world/keyframes", dots)
        self.stream.log("world/keyframes/covariance", make_ellipsoids(KEYFRAMES, kept))
        here = result.causal.T_world_frame[:3, 3]
        track = self._tracks["causal"]
        ends = [(link, track.at(link.reference_ns)) for link in result.links]
        placed = [(link, np.stack([T[:3, 3], here])) for link, T in ends if T is not None]
        segments = np.array([segment for _, segment in placed]).reshape(-1, 2, 3)
        self.stream.log("world/links", make_links([link for link, _ in placed], segments))
        if result.loops:
            self.stream.log(LOOPS, make_loops(track.segments(result.loops)))

    def _add_numbers(self, result: FrameResult) -> None:
        counts = (result.n_matches, result.n_inliers, result.n_points)
        for name, count in zip(COUNT_COLOURS, counts, strict=True):
            self._add_number(f"{COUNTS}/{name}", name, count, COUNT_COLOURS[name])
        for stage, ms in result.stage_ms.items():
            colour = STAGE_COLOURS.get(stage)
            self._add_number(f"{MILLISECONDS}/{stage}", f"{stage} [ms]", ms, colour)
        chi2: dict[str, list[float]] = {}
        for link in result.links:
            if link.is_accepted and link.chi2 is not None:
                chi2.setdefault(link.kind, []).append(link.chi2)
        for kind, values in chi2.items():
            colour = LINK_COLOURS.get(kind)
            self._add_number(f"{CHI2}/{kind}", kind, float(np.mean(values)), colour)

    def _add_number(self, path: str, name: str, value: float, colour: Colour | None = None) -> None:
        if path not in self._series:
            self._series.add(path)
            series = rr.SeriesLines(names=name, colors=colour, widths=1.5)
            self.stream.log(path, series, is_static=True)
        self.stream.log(path, rr.Scalars([value]))

    def _add_lines(self, stamp_ns: int) -> None:
        """Log where it was: the paths where a new second of the recording has begun."""
        n_seconds = (stamp_ns - (self._first_ns or 0)) // 10**9
        if n_seconds > self._n_seconds:
            self._n_seconds = n_seconds
            self.add_paths(N_SHOWN_POSES)
        else:
            self._set_frame(stamp_ns)
            self._add_recent()

    def _add_recent(self) -> None:
        for name, recent in self._recent.items():
            positions = np.array(recent).reshape(-1, 3)
            self.stream.log(f"world/{name}/recent", make_path(name, positions))


KEYFRAMES: Final = "keyframes"
N_SIGMAS: Final = 3.0
"""Half-axes of an ellipsoid, in standard deviations."""
SHOWN_WIDTH_PX: Final = 640
"""Images in the scene are halved until they are no wider."""

_LEVELS: Final = {
    Status.OK: rr.TextLogLevel.INFO,
    Status.RESUMED: rr.TextLogLevel.WARN,
    Status.COASTING: rr.TextLogLevel.WARN,
    Status.LOST: rr.TextLogLevel.ERROR,
    Status.SKIPPED: rr.TextLogLevel.ERROR,
}
# Of the viewer, so that they are seen from any distance.
_LINE: Final = rr.Radius.ui_points(1.5)
_THIN_LINE: Final = rr.Radius.ui_points(0.75)
_DOT: Final = rr.Radius.ui_points(4.0)
_SMALL_DOT: Final = rr.Radius.ui_points(1.5)


COLOURS: Final[Mapping[str, Colour]] = {
    **{name: palette.rgb(code) for name, code in palette.ESTIMATES.items()},
    KEYFRAMES: palette.rgb(palette.LINKS["keyframe"]),
}
COUNT_COLOURS: Final = {
    name: palette.rgb(palette.COUNTS[name]) for name in ("matches", "inliers", "points")
}
STAGE_COLOURS: Final = {name: palette.rgb(code) for name, code in palette.STAGES.items()}
LINK_COLOURS: Final = {kind: palette.rgb(code) for kind, code in palette.LINKS.items()}
_INLIER, _OUTLIER = palette.rgb(palette.INLIERS), palette.rgb(palette.OUTLIERS)


def make_transform(T_parent_child: FloatArray) -> rr.Transform3D:
    """Return a pose (4, 4) as a transform of an entity."""
    numbers = pose_numbers(T_parent_child)
    return rr.Transform3D(translation=numbers[:3], quaternion=rr.Quaternion(xyzw=numbers[3:]))


def make_marker(name: str) -> rr.Points3D:
    """Return a dot at the origin of a frame, in the colour of its estimate."""
    return rr.Points3D([np.zeros(3)], colors=COLOURS[name], radii=_DOT)


def make_path(name: str, positions: FloatArray) -> rr.LineStrips3D:
    """Return positions (n, 3) as one line in the colour of its estimate."""
    strips = [positions] if len(positions) > 1 else []
    return rr.LineStrips3D(strips, colors=COLOURS[name], radii=_LINE)


def make_links(links: Sequence[FrameLink], segments: FloatArray) -> rr.LineStrips3D:
    """Return edges as lines.

    Parameters
    ----------
    links : sequence of FrameLink
        Those that the window refused have a colour of their own.
    segments : ndarray of float64, shape (n, 2, 3)
        Where each of them begins and ends, in the world, metres.
    """
    codes = [palette.LINKS[link.kind] if link.is_accepted else palette.REFUSED for link in links]
    colours = [palette.rgb(code) for code in codes]
    return rr.LineStrips3D(list(segments), colors=colours or None, radii=_THIN_LINE)


def make_loops(segments: FloatArray) -> rr.LineStrips3D:
    """Return loops as lines; where each begins and ends, shape (n, 2, 3)."""
    return rr.LineStrips3D(list(segments), colors=COLOURS[GLOBAL], radii=_LINE)


def make_ellipsoids(name: str, estimates: Sequence[Estimate]) -> rr.Ellipsoids3D:
    """Return the 3-sigma ellipsoids of positions, in the world.

    Those that are not known to be finite are left out.

    Parameters
    ----------
    name : str
        A key of `COLOURS`.
    estimates : sequence of Estimate
    """
    known = [e for e in estimates if np.isfinite(e.covariance).all()]
    axes = [_axes(estimate) for estimate in known]
    return rr.Ellipsoids3D(
        centers=_positions(known),
        half_sizes=np.array([half_sizes for half_sizes, _ in axes]).reshape(-1, 3),
        quaternions=np.array([quaternion for _, quaternion in axes]).reshape(-1, 4),
        colors=COLOURS[name],
        line_radii=_THIN_LINE,
    )


def _axes(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return half-axes (3,) in metres and the quaternion (x, y, z, w) that turns them."""
    # The covariance is stated along the axes of the frame: the pose turns it into the world.
    variances, directions = np.linalg.eigh(estimate.covariance[3:, 3:])
    if np.linalg.det(directions) < 0:
        directions = -directions
    R = estimate.T_world_frame[:3, :3] @ directions
    half_sizes = N_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    return half_sizes, np.asarray(Rotation.from_matrix(R).as_quat())


def _positions(estimates: Sequence[Estimate]) -> FloatArray:
    return np.array([e.T_world_frame[:3, 3] for e in estimates]).reshape(-1, 3)


def make_matches(found: RelativePose) -> rr.Points3D:
    """Return the matched points in the camera's frame, inliers and outliers coloured."""
    points = found.points_current
    is_finite = np.isfinite(points).all(axis=1)
    is_inlier = found.inliers[: len(points)]
    colours = np.where(is_inlier[:, np.newaxis], _INLIER, _OUTLIER)
    return _points(points[is_finite], colours[is_finite])


def make_cloud(found: RelativePose, image: ImageArray, T_world_cam: FloatArray) -> rr.Points3D:
    """Return the inliers' points in the world, as grey as the image is there.

    Parameters
    ----------
    found : RelativePose
        See `placed_matches`.
    image : ndarray of uint8, shape (height, width)
        The current one.
    T_world_cam : ndarray of float64, shape (4, 4)
        Maps camera coordinates to the world, metres.
    """
    points, pixels = found.points_current, found.pixels_current
    is_finite = np.isfinite(np.column_stack([points, pixels])).all(axis=1)
    is_shown = found.inliers & is_finite
    height, width = image.shape
    u, v = np.rint(pixels[is_shown]).astype(np.int64).T
    greys = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    points_world = points[is_shown] @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return _points(points_world, np.repeat(greys[:, np.newaxis], 3, axis=1))


def _points(points: FloatArray, colours: FloatArray | ImageArray) -> rr.Points3D:
    # No colour for no point: an empty array would be taken for one of a shape it has not.
    kept = colours.astype(np.uint8) if len(points) > 0 else None
    return rr.Points3D(points.reshape(-1, 3), colors=kept, radii=_SMALL_DOT)


def make_image(image: ImageArray) -> rr.EncodedImage:
    """Return an image, grey or BGR, as a JPEG file."""
    return rr.EncodedImage(contents=encode_image(image, ".jpg"), media_type="image/jpeg")


def halve(image: ImageArray) -> ImageArray:
    """Return an image (height, width) for the scene, at most `SHOWN_WIDTH_PX` wide."""
    n = shrinkage(image.shape[1])
    if n == 1:
        return image
    height, width = (size // n for size in image.shape)
    cropped = image[: height * n, : width * n]
    return np.asarray(cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA))


def make_pinhole(camera: PinholeCamera) -> rr.Pinhole:
    """Return the camera of what `halve` returns."""
    n = shrinkage(camera.width)
    # Pixel (0, 0) is the centre of the first pixel: its corner is where sizes are scaled about.
    return rr.Pinhole(
        focal_length=[camera.fx / n, camera.fy / n],
        principal_point=[(camera.cx + 0.5) / n - 0.5, (camera.cy + 0.5) / n - 0.5],
        resolution=[camera.width // n, camera.height // n],
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def shrinkage(width: int) -> int:
    """Return the factor that shrinks an image of this width for the scene: 1, 2, 4, ..."""
    n = 1
    while width // n > SHOWN_WIDTH_PX:
        n *= 2
    return n
