"""Odometry: drives front-end and back-end, frame by frame, and keeps three trajectories."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from gvo.backend.window import SlidingWindow
from gvo.chain import RawChain, RawStep
from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.keyframes import Keyframes
from gvo.types import (
    Edge,
    Estimate,
    Failure,
    FloatArray,
    Frame,
    Observations,
    Status,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameResult:
    """What one frame gave.

    Parameters
    ----------
    raw, causal : Estimate
        The pose by the chain of frame-to-frame registrations, and by the window.
    finished : tuple of Estimate
        Smoothed poses of frames that left the window with this one.
    status : Status
        What ties the frame to earlier ones in the window; the raw chain's own is `raw.status`.
    reason : str
        Why the chain could not register the frame; empty where it could.
    n_keypoints, n_points, n_matches, n_inliers, n_links : int
        Keypoints, those measured in 3-D, matches of the chain's registration and those that it
        rests on, edges that went into the window.
    stage_ms : dict of str to float
        Milliseconds by stage.
    """

    raw: Estimate
    causal: Estimate
    finished: tuple[Estimate, ...]
    status: Status
    reason: str
    n_keypoints: int
    n_points: int
    n_matches: int
    n_inliers: int
    n_links: int
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.raw.stamp_ns


class Odometry:
    """Estimates the motion of a camera from its frames.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Of the rectified stereo pair, or of the colour image of an RGB-D sensor.
    config : Config, optional
    """

    def __init__(self, camera: StereoCamera | PinholeCamera, config: Config | None = None) -> None:
        self._config = config or Config()
        self._frontend = DescriptorFrontend(camera, self._config)
        self._chain = RawChain(self._frontend, self._config.window)
        self._window = SlidingWindow(self._config.window)
        self._keyframes = Keyframes(self._frontend.camera, self._config.window)
        self._anchor_ns: int | None = None
        self._coasting_since_ns: int | None = None

    def track(self, frame: Frame) -> FrameResult:
        """Take the next frame and return its poses.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
            Its stamp must be later than that of the frame before.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        watch = Stopwatch()
        with watch.stage("extract"):
            observations = self._frontend.extract(frame)
        with watch.stage("register"):
            step = self._chain.advance(observations)
        with watch.stage("links"):
            edges, overlaps = self._edges(observations, step)
        is_tied = step.is_registered or len(edges) > 1
        status = self._next_status(frame.stamp_ns, is_tied=is_tied)
        with watch.stage("window"):
            causal = self._window.add_pose(frame.stamp_ns, frame.stamp_ns, edges, status=status)
            self._update_keyframes(observations, overlaps, is_tied=is_tied)
            self._hold_anchor()
        return FrameResult(
            raw=replace(step.estimate, frame_id=frame.stamp_ns),
            causal=causal,
            finished=tuple(self._window.pop_finished()),
            status=status,
            reason=step.reason,
            n_keypoints=observations.n_keypoints,
            n_points=len(observations),
            n_matches=step.n_matches,
            n_inliers=step.n_inliers,
            n_links=len(edges),
            stage_ms=watch.stage_ms,
        )

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses of the frames still in the window."""
        return tuple(self._window.finish())

    def _edges(
        self, observations: Observations, step: RawStep
    ) -> tuple[list[Edge], dict[int, float]]:
        """Return the edges of a frame, to its predecessor first, and the keyframes' overlaps."""
        if step.reference_ns is None:
            return [], {}
        first = Edge(
            reference_id=step.reference_ns,
            T_reference_frame=step.T_reference_frame,
            covariance=step.covariance,
        )
        T_world_frame = self._window.pose(step.reference_ns) @ step.T_reference_frame
        T_frame_keyframes = {
            stamp_ns: se3.invert(T_world_frame) @ self._window.pose(stamp_ns)
            for stamp_ns in self._keyframes.stamps_ns
        }
        overlaps = self._keyframes.overlaps(T_frame_keyframes)
        links = [
            self._link(stamp_ns, observations, se3.invert(T_frame_keyframes[stamp_ns]))
            for stamp_ns in self._keyframes.choose_links(overlaps, exclude=step.reference_ns)
        ]
        return [first, *(link for link in links if link is not None)], overlaps

    def _link(self, stamp_ns: int, observations: Observations, prior: FloatArray) -> Edge | None:
        result = self._frontend.register(self._keyframes[stamp_ns], observations, prior)
        if isinstance(result, Failure):
            return None
        return Edge(
            reference_id=stamp_ns,
            T_reference_frame=result.T_reference_current,
            covariance=self._config.window.link_sigma_factor**2 * result.covariance,
        )

    def _next_status(self, stamp_ns: int, *, is_tied: bool) -> Status:
        since, self._coasting_since_ns = self._coasting_since_ns, None
        if is_tied:
            return Status.OK if since is None else Status.RESUMED
        self._coasting_since_ns = stamp_ns if since is None else since
        coasting_s = 1e-9 * (stamp_ns - self._coasting_since_ns)
        return Status.LOST if coasting_s > self._config.window.lost_after_s else Status.COASTING

    def _update_keyframes(
        self, observations: Observations, overlaps: dict[int, float], *, is_tied: bool
    ) -> None:
        """Keep and release keyframes; none while the pose is only a guess."""
        if not is_tied:
            return
        if self._config.window.n_keyframes > 0 and self._keyframes.is_needed(overlaps):
            self._keyframes.add(observations)
            self._window.keep(observations.stamp_ns)
        for stamp_ns in self._keyframes.choose_released(overlaps):
            self._keyframes.drop(stamp_ns)
            self._window.release(stamp_ns)

    def _hold_anchor(self) -> None:
        """Keep the frame that the chain comes back to, however long it coasts."""
        previous, self._anchor_ns = self._anchor_ns, self._chain.anchor_ns
        if previous is not None and previous not in self._keyframes.stamps_ns:
            self._window.release(previous)
        if self._anchor_ns is not None:
            self._window.keep(self._anchor_ns)


class Stopwatch:
    """Measures stages of work by name."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = 1e3 * (time.perf_counter() - start)
            self.stage_ms[name] = self.stage_ms.get(name, 0.0) + elapsed
