"""What of a run goes into which entity of a Rerun file.

`rerun` is imported with this module: import it where a file is written, no earlier.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable
from typing import Final

import numpy as np
import rerun as rr

from gvo.geometry.camera import PinholeCamera
from gvo.outputs import rerun_layout as place
from gvo.outputs import rerun_scene as scene
from gvo.outputs.rerun_stream import RerunStream
from gvo.outputs.run_frames import ESTIMATES, RunFrames
from gvo.outputs.run_tracks import Track
from gvo.types import (
    Estimate,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    RelativePose,
    Status,
    StereoFrame,
)
from gvo.viz.overlay import compose_overlay

N_SHOWN_POSES: Final = 500
"""Most poses of a path while the run goes."""

_SECOND_NS: Final = 10**9
_TRACKED: Final = "world/causal/frame"
_CAMERA: Final = f"{_TRACKED}/camera"
_NOTHING: Final = RelativePose(T_reference_current=np.eye(4), covariance=np.zeros((6, 6)))


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
        stream.log(f"{_CAMERA}/image", scene.make_pinhole(camera), is_static=True)
        for name in ESTIMATES:
            stream.log(f"world/{name}/frame", scene.make_marker(name), is_static=True)
        if text:
            document = rr.TextDocument(text)
            stream.log(place.CONFIGURATION, document, is_static=True)

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Log what one frame gave."""
        image = frame.left if isinstance(frame, StereoFrame) else frame.image
        self._begin(result)
        self._stamps_ns.append(frame.stamp_ns)
        self._indices.append(self._n_seen)
        self.add_status(frame.stamp_ns, result.status, _caption(result))
        self._add_poses(result)
        self._add_picture(frame, image, result)
        self._add_points(image, result)
        self._add_links(result)
        self._add_numbers(result)
        self.add_smoothed(result.finished)
        self._add_lines(frame.stamp_ns)

    def add_status(self, stamp_ns: int, status: Status, text: str) -> None:
        """Log a line that tells of a new frame."""
        self.stream.set_frame(stamp_ns, self._n_seen)
        self._n_seen += 1
        self.stream.log(place.STATUS, scene.make_status(status, text))

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Log poses at their own stamps."""
        for estimate in estimates:
            self._set_frame(estimate.stamp_ns)
            transform = scene.make_transform(estimate.T_world_cam)
            self.stream.log("world/smoothed/frame", transform)
            self._tracks["smoothed"].add(estimate)

    def add_paths(self, n_most: int | None = None) -> None:
        """Log the paths up to now, of at most `n_most` poses, at the newest frame."""
        self._set_frame(self._stamps_ns[-1])
        for name, track in self._tracks.items():
            positions = track.poses(n_most)[1][:, :3]
            self.stream.log(f"world/{name}/path", scene.make_path(name, positions))
        for recent in self._recent.values():
            del recent[:-1]
        self._add_recent()

    def _begin(self, result: FrameResult) -> None:
        """Log, before the first pose, what never changes."""
        if self._first_ns is not None:
            return
        self._first_ns = result.stamp_ns
        is_optical = self._frames.is_world_optical or (
            # A camera in a world of its recording: one with y down, or one with z up.
            self._frames.is_camera and result.causal.T_world_cam[1, 1] > np.cos(np.pi / 4)
        )
        self.stream.log("world", scene.make_axes(is_optical=is_optical), is_static=True)
        if not callable(self._frames.T_tracked_cam):
            mount = scene.make_transform(self._frames.mount(result.stamp_ns))
            self.stream.log(_CAMERA, mount, is_static=True)

    def _set_frame(self, stamp_ns: int) -> None:
        # A smoothed pose comes late: its frame is looked up.
        index = bisect_left(self._stamps_ns, stamp_ns)
        self.stream.set_frame(stamp_ns, self._indices[index])

    def _add_poses(self, result: FrameResult) -> None:
        for name, estimate in (("raw", result.raw), ("causal", result.causal)):
            path = f"world/{name}"
            self.stream.log(f"{path}/frame", scene.make_transform(estimate.T_world_cam))
            self.stream.log(f"{path}/covariance", scene.make_ellipsoids(name, [estimate]))
            self._tracks[name].add(estimate)
            self._recent[name].append(estimate.T_world_cam[:3, 3])
        if callable(self._frames.T_tracked_cam):
            self.stream.log(_CAMERA, scene.make_transform(self._frames.mount(result.stamp_ns)))

    def _add_picture(self, frame: Frame, image: ImageArray, result: FrameResult) -> None:
        overlay = compose_overlay(frame, result, self._camera, index=self._n_seen - 1)
        self.stream.log(place.OVERLAY, scene.make_image(overlay))
        self.stream.log(f"{_CAMERA}/image", scene.make_image(scene.halve(image)))

    def _add_points(self, image: ImageArray, result: FrameResult) -> None:
        found = result.registration or _NOTHING
        self.stream.log(f"{_CAMERA}/points", scene.make_matches(found))
        if result.stamp_ns in result.keyframes_ns and len(found.points_current) > 0:
            T_world_cam = result.causal.T_world_cam @ self._frames.mount(result.stamp_ns)
            self.stream.log(place.CLOUD, scene.make_cloud(found, image, T_world_cam))

    def _add_links(self, result: FrameResult) -> None:
        """Log the window's keyframes and the edges that came with the frame."""
        known = {**self._keyframes, result.stamp_ns: result.causal}
        self._keyframes = {ns: known[ns] for ns in result.keyframes_ns if ns in known}
        kept = list(self._keyframes.values())
        self.stream.log("world/keyframes", scene.make_keyframes(kept))
        ellipsoids = scene.make_ellipsoids(scene.KEYFRAMES, kept)
        self.stream.log("world/keyframes/covariance", ellipsoids)
        here = result.causal.T_world_cam[:3, 3]
        ends = [(link, self._position(link.reference_ns)) for link in result.links]
        placed = [(link, np.stack([end, here])) for link, end in ends if end is not None]
        segments = np.array([segment for _, segment in placed]).reshape(-1, 2, 3)
        self.stream.log("world/links", scene.make_links([link for link, _ in placed], segments))

    def _position(self, stamp_ns: int) -> FloatArray | None:
        """Return where a frame was placed when it came, shape (3,)."""
        pose = self._tracks["causal"].before(stamp_ns + 1)
        if pose is None or pose.stamp_ns != stamp_ns:
            return None
        return np.asarray(pose.T_world_frame[:3, 3])

    def _add_numbers(self, result: FrameResult) -> None:
        counts = (result.n_matches, result.n_inliers, result.n_points)
        for name, count in zip(scene.COUNT_COLOURS, counts, strict=True):
            self._add_number(f"{place.COUNTS}/{name}", name, count, scene.COUNT_COLOURS[name])
        for stage, ms in result.stage_ms.items():
            colour = scene.STAGE_COLOURS.get(stage)
            self._add_number(f"{place.MILLISECONDS}/{stage}", f"{stage} [ms]", ms, colour)
        chi2: dict[str, list[float]] = {}
        for link in result.links:
            if link.is_accepted and link.chi2 is not None:
                chi2.setdefault(link.kind, []).append(link.chi2)
        for kind, values in chi2.items():
            colour = scene.LINK_COLOURS.get(kind)
            self._add_number(f"{place.CHI2}/{kind}", kind, float(np.mean(values)), colour)

    def _add_number(
        self, path: str, name: str, value: float, colour: scene.Colour | None = None
    ) -> None:
        if path not in self._series:
            self._series.add(path)
            self.stream.log(path, scene.make_series(name, colour), is_static=True)
        self.stream.log(path, rr.Scalars([value]))

    def _add_lines(self, stamp_ns: int) -> None:
        """Log where it was: the paths where a new second of the recording has begun."""
        n_seconds = (stamp_ns - (self._first_ns or 0)) // _SECOND_NS
        if n_seconds > self._n_seconds:
            self._n_seconds = n_seconds
            self.add_paths(N_SHOWN_POSES)
        else:
            self._set_frame(stamp_ns)
            self._add_recent()

    def _add_recent(self) -> None:
        for name, recent in self._recent.items():
            positions = np.array(recent).reshape(-1, 3)
            self.stream.log(f"world/{name}/recent", scene.make_path(name, positions))


def _caption(result: FrameResult) -> str:
    counts = f"{result.n_inliers} of {result.n_matches} matches are inliers"
    text = f"{result.status}: {counts}, {result.n_links} links"
    return f"{text}; {result.reason}" if result.reason else text
