"""The newest frame of a run, and what led to it, for the page."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from threading import Lock
from typing import Any, NamedTuple, cast

import cv2
import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.config import DepthConfig
from gvo.frontend.klt import image_of
from gvo.geometry.camera import PinholeCamera
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult, ImageArray
from gvo.viz.overlay import compose_faulty, compose_overlay
from gvo.viz.scene import History, Path, Scene, matched_points, scene
from gvo.viz.view.clouds import MAX_POINTS, NO_CLOUD, Cloud, accumulate, frame_cloud, halve

# Newest poses of the window that are drawn; the window may hold all.
_N_POSES = 24
_N_SHOWN_POSES = 1000  # of a path, at most
_MAX_KEPT_POSES = 300_000  # some hours
_MAX_CLOUDS = 500  # of keyframes: each takes a tenth of a millisecond whenever all are drawn
_MAX_WIDTH_PX = 480


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameView:
    """All that the page shows of a frame.

    Parameters
    ----------
    index : int
        Of the frame in the recording, from 0; faulty ones count.
    stamp_ns : int
        Nanoseconds.
    result : FrameResult or None
        None for a faulty frame.
    scene : Scene or None
        Likewise.
    reason : str
        Why there is no pose, or no registration; empty where there are.
    T_world_frame : ndarray of float64, shape (4, 4)
        Causal pose; for a faulty frame that of the frame before, the identity before any.
    paths : dict of str to Path
        Of the smoothed one the poses as they are known best.
    loops : ndarray of float64, shape (n, 2, 3)
        Both ends of the loops so far, metres.
    image, overlay : ndarray of uint8, shape (height, width, 3)
        The image, small, and the image with its matches, BGR.
    cloud : tuple of ndarray
        Points that the frame measured, in the `cam` frame, and their colours.
    """

    index: int
    stamp_ns: int
    result: FrameResult | None
    scene: Scene | None
    reason: str
    T_world_frame: FloatArray
    paths: dict[str, Path]
    loops: FloatArray
    image: ImageArray
    overlay: ImageArray
    cloud: Cloud


class _Shown(NamedTuple):
    frame: Frame | FaultyFrame
    result: FrameResult | None  # none of a faulty frame
    number: int
    depth: DepthConfig


class Newest:
    """The history of a run and its newest frame; one thread adds, another draws.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
    first_index : int
        Number of the first frame.

    Attributes
    ----------
    first_index, n_done : int
        Of the first frame, and of the one that comes next.
    history : History
    n_changes : int
        Counts what is to be shown anew.
    is_due : bool
        The page will draw the next frame: it comes with the poses of the window, which cost time.
    """

    def __init__(self, camera: PinholeCamera, first_index: int = 0) -> None:
        self._camera = camera
        self.first_index = self.n_done = first_index
        self.history = History()
        self.n_changes = 0
        self.is_due = True
        self._clouds: dict[int, Cloud] = {}
        self._stamps_ns: deque[int] = deque(maxlen=_N_POSES)
        self._T_world_frame = np.eye(4)
        self._shown: _Shown | None = None
        self._view: FrameView | None = None
        self._lock = Lock()

    def add(
        self,
        frame: Frame | FaultyFrame,
        result: FrameResult | None,
        window: SlidingWindow | None,
        depth: DepthConfig,
    ) -> None:
        """Take the next frame, and what it gave: poses of the camera; None of a faulty frame.

        Without the window the frame is counted, and not shown.
        """
        with self._lock:
            shown = _Shown(frame, result, self.n_done, depth)
            self.n_done += 1
            if result is not None and not isinstance(frame, FaultyFrame):
                self._add_result(frame, result, depth)
            if window is not None:
                if self.is_due:
                    known = sorted({*self.history.keyframes, *self._stamps_ns})
                    self.history.correct(window.estimate(ns) for ns in known if ns in window)
                self._shown, self._view = shown, None
                self.n_changes += 1

    def _add_result(self, frame: Frame, result: FrameResult, depth: DepthConfig) -> None:
        # Until it is final, the pose as it came, or as the window has it, is the best there is.
        self.history.add_late("smoothed", [result.causal])
        self.history.add(result)
        self._T_world_frame = result.causal.T_world_frame
        self._stamps_ns.append(result.stamp_ns)
        if result.stamp_ns in result.keyframes_ns:
            cloud = frame_cloud(frame, matched_points(result), self._camera, depth)
            self._clouds[result.stamp_ns] = cloud
            if len(self._clouds) > _MAX_CLOUDS:
                self._clouds = dict([*self._clouds.items()][::2])
            if sum(len(points) for points, _ in self._clouds.values()) > MAX_POINTS:
                halves = {ns: halve(each) for ns, each in self._clouds.items()}
                self._clouds = {ns: each for ns, each in halves.items() if len(each[0])}
        self.history.forget(_MAX_KEPT_POSES)

    def finish(self, estimates: Iterable[Estimate]) -> None:
        """Take the smoothed poses that are known at the end."""
        with self._lock:
            self.history.add_late("smoothed", estimates)
            self._view = None
            self.n_changes += 1

    def view(self) -> FrameView | None:
        """Return the newest frame that is to be shown, drawn; None before there is any."""
        with self._lock:
            shown = self._shown
            if shown is None or self._view is not None:
                return self._view
            known = {
                "T_world_frame": self._T_world_frame,
                "paths": self.history.paths(_N_SHOWN_POSES),
                "loops": self.history.tracks["smoothed"].lines(self.history.loops),
            }
            seen = None if shown.result is None else scene(shown.result, self.history)
        view = self._drawn(shown, seen, known)
        with self._lock:
            if self._shown is shown:
                self._view = view
        return view

    def keyframe_cloud(self) -> Cloud:
        """Return the points of all keyframes in the world, metres, and their colours, RGB."""
        with self._lock:
            track = self.history.tracks["smoothed"]
            clouds = [(track.at(ns), cloud) for ns, cloud in self._clouds.items()]
        return accumulate([(T, cloud) for T, cloud in clouds if T is not None])

    def _drawn(self, shown: _Shown, seen: Scene | None, known: dict[str, Any]) -> FrameView:
        """Return a frame with its pictures; a faulty one is dark, and says why."""
        frame, result, camera = shown.frame, shown.result, self._camera
        if isinstance(frame, FaultyFrame):
            image = np.zeros((camera.height, camera.width), dtype=np.uint8)
            overlay = compose_faulty(frame, camera, index=shown.number)
            reason, cloud = frame.reason, NO_CLOUD
        else:
            found = cast("FrameResult", result)
            image, reason = image_of(frame), found.reason
            overlay = compose_overlay(frame, found, camera, index=shown.number)
            cloud = frame_cloud(frame, matched_points(found), camera, shown.depth)
        return FrameView(
            index=shown.number,
            stamp_ns=frame.stamp_ns,
            result=result,
            scene=seen,
            reason=reason,
            image=_small_picture(image),
            overlay=overlay,
            cloud=cloud,
            **known,
        )


def _small_picture(image: ImageArray) -> ImageArray:
    """Return a grey or BGR image as BGR, at most 480 pixels wide."""
    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = _MAX_WIDTH_PX, max(round(height * _MAX_WIDTH_PX / width), 1)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return image
