"""Odometry: drives front-end and back-end, frame by frame, and keeps three trajectories."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from gvo.backend.keyframe_policy import choose_released, is_needed
from gvo.backend.window import SlidingWindow
from gvo.config import Config, WindowConfig
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.factory import find_change, frame_of, make_frontend, renew_frontend
from gvo.frontend.protocol import Frontend, Stamped, register_checked, relocalize_checked
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.odometry.chain import RawChain, RawStep
from gvo.odometry.keyframes import Keyframes, count_steps, judge_links, link_keyframes
from gvo.odometry.segments import Segments, Sighting
from gvo.types import (
    Edge,
    Estimate,
    Failure,
    FloatArray,
    FrameResult,
    LinkKind,
    RelativePose,
    SegmentJoin,
    Status,
)


class Odometry:
    """Estimates the motion of a camera, or of any sensor with a front-end, from its frames.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera, optional
        Of the rectified stereo pair, or of the colour image of an RGB-D sensor. Needed without
        a front-end of one's own.
    config : Config, optional
    frontend : Frontend, optional
        Any object with `extract` and `register`, in place of what `frontend.kind` names.

    Raises
    ------
    ValueError
        When neither a camera nor a front-end is given.
    """

    def __init__(
        self,
        camera: StereoCamera | PinholeCamera | None = None,
        config: Config | None = None,
        *,
        frontend: Frontend[Any] | None = None,
    ) -> None:
        self._config = self._next_config = config or Config()
        self._frontend = _choose_frontend(camera, self._config, frontend)
        self._camera = camera
        self._is_own = frontend is not None
        # The last frame and the last registered one, in case that they are extracted again.
        self._frames: dict[int, Stamped] = {}
        self._chain: RawChain[Any] = RawChain(self._frontend, self._config.window)
        self._window = SlidingWindow(self._config.window)
        self._keyframes: Keyframes[Any] = Keyframes(self._view(), self._config.window)
        self._anchor_ns: int | None = None
        self._segments = Segments()
        # Over how many steps the errors of the chain had added up at a frame, by stamp.
        self._n_steps: dict[int, int] = {}

    @property
    def config(self) -> Config:
        """The configuration of the next frame."""
        return self._next_config

    @property
    def window(self) -> SlidingWindow:
        """The sliding window: its poses by stamp, covariances, edges and counts."""
        return self._window

    @property
    def rig_offsets(self) -> RigOffsets | None:
        """What is learnt of a stereo rig; None where nothing is."""
        offsets = getattr(self._frontend, "rig_offsets", None)
        return offsets if isinstance(offsets, RigOffsets) and offsets.is_learning else None

    def reconfigure(self, config: Config) -> None:
        """Go on with another configuration from the next frame on.

        Poses, velocity and the window go on. What takes effect, by section:

        - `temporal`, `ransac`, `registration`: with the next registration.
        - `window`: with the next update, see `SlidingWindow.reconfigure`; edges that are in keep
          their kernel.
        - `frontend`, `klt` or `features`, `stereo` or `depth`, whichever the sensor and the kind
          of front-end use: the last frame is extracted again, so that the next one is registered
          against what the new parameters find in it. Keyframes stay where they can be registered
          with new frames. They cannot after another `frontend.kind`,
          `depth.virtual_baseline_m`, or `kind`, `n_octaves`, `scale_factor` or `upright` of
          `features` (descriptor): then those of the front-end of tracks, which holds their
          images, are extracted again, and those of descriptors are released.
        - `stereo`: the offsets of the rig are learnt anew; else they go on.
        - `runtime`: with the next frame.
        - `sync`, `images`, `depth.scale`, `check`: not here, but where frames are read.

        A front-end of one's own is told at once by its method `reconfigure(config)`, where it
        has one; it must go on with the observations that it gave before.

        Parameters
        ----------
        config : Config
            One that equals the present one changes nothing.

        Raises
        ------
        ValueError
            When it is no Config.
        """
        if not isinstance(config, Config):
            raise ValueError(f"config must be a gvo.Config, got {type(config).__name__}")
        tell = getattr(self._frontend, "reconfigure", None) if self._is_own else None
        if callable(tell) and config != self._next_config:
            tell(config)
        self._next_config = config

    def track(self, frame: Stamped) -> FrameResult:
        """Take the next frame and return its poses.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame, or what the front-end takes
            Its stamp must be later than that of the frame before.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        watch = Stopwatch()
        with watch.stage("extract"):
            if self._next_config is not self._config:
                self._apply(self._next_config)
            observations = self._frontend.extract(frame)
        with watch.stage("register"):
            step = self._chain.advance(observations)
            self._n_steps[frame.stamp_ns] = count_steps(step, self._n_steps)
        with watch.stage("links"):
            offered, scores = self._edges(observations, step)
            found = self._look_around(observations, step)
            if found is not None:
                offered.append(("keyframe", found))
        with watch.stage("window"):
            edges = [edge for _, edge in offered]
            status = None if found is None else Status.RESUMED
            causal = self._window.add_pose(frame.stamp_ns, frame.stamp_ns, edges, status=status)
            joins = self._note_segments(step, causal)
            self._update_keyframes(observations, scores, causal)
            self._hold_anchor()
            self._hold_counts(frame.stamp_ns)
        if not self._is_own:
            self._hold_frame(frame)
        n_points = _count_points(observations)
        return FrameResult(
            raw=replace(step.estimate, frame_id=frame.stamp_ns),
            causal=causal,
            finished=tuple(self._window.pop_finished()),
            status=causal.status,
            reason=step.reason,
            n_keypoints=getattr(observations, "n_keypoints", n_points),
            n_points=n_points,
            n_matches=step.n_matches,
            n_inliers=step.n_inliers,
            n_links=len(edges) - len(causal.rejected),
            registration=step.registration,
            links=judge_links(offered, frame.stamp_ns, self._window),
            keyframes_ns=tuple(self._keyframes.stamps_ns),
            segment=self._segments.current,
            joins=joins,
            stage_ms=watch.stage_ms,
        )

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses of the frames still in the window."""
        return tuple(self._window.finish())

    def _view(self) -> StereoCamera | None:
        """Return the camera that tells which points of a keyframe are in view."""
        view = getattr(self._frontend, "camera", None)
        if not isinstance(view, StereoCamera | PinholeCamera):
            view = self._camera
        return None if view is None else as_stereo(view, self._config)

    def _apply(self, config: Config) -> None:
        """Take over another configuration, before a frame."""
        former, self._config = self._config, config
        if config == former:
            return
        extracted = {} if self._is_own else self._renew_frontend(former)
        self._window.reconfigure(config.window)
        self._keyframes.reconfigure(self._view(), config.window)
        self._chain.reconfigure(self._frontend, config.window, extracted)

    def _renew_frontend(self, former: Config) -> dict[int, Any]:
        """Return what a new front-end keeps of the last frames, where that has changed."""
        camera = self._camera
        if camera is None:
            return {}
        is_stereo = isinstance(camera, StereoCamera)
        change = find_change(former, self._config, is_stereo=is_stereo)
        if change.is_any:
            self._frontend = renew_frontend(
                self._frontend, camera, self._config, keeps_offsets=not change.is_of_rig
            )
        extracted = {}
        if change.is_of_extraction:
            frames = sorted(self._frames.items())
            extracted = {ns: self._frontend.extract(frame) for ns, frame in frames}
        if change.is_of_kind:
            self._renew_keyframes(extracted)
        return extracted

    def _renew_keyframes(self, extracted: dict[int, Any]) -> None:
        """Extract keyframes again, and release those of which the frames are not at hand."""
        for stamp_ns in self._keyframes.stamps_ns:
            observations = extracted.get(stamp_ns)
            frame = frame_of(self._keyframes[stamp_ns])
            if observations is None and frame is not None:
                observations = self._frontend.extract(frame)
            if observations is not None:
                self._keyframes.add(observations)
                continue
            self._keyframes.drop(stamp_ns)
            if stamp_ns in self._window:
                self._window.release(stamp_ns)

    def _edges(
        self,
        observations: Any,  # noqa: ANN401 - the front-end's own
        step: RawStep,
    ) -> tuple[list[tuple[LinkKind, Edge]], dict[int, float]]:
        """Return the edges of a frame, to its predecessor first, and the keyframes' scores."""
        if step.reference_ns is None:
            return [], {}
        # A step that only goes on as before is no measurement: the window does that by itself.
        first: list[tuple[LinkKind, Edge]] = []
        if step.is_registered:
            first.append(("step", _edge_of(step)))
        if step.reference_ns not in self._window:  # not even alone would it go in
            return first, {}
        T_world_frame = self._window.pose(step.reference_ns) @ step.T_reference_frame
        apart = self._apart()
        T_frame_keyframes = {
            stamp_ns: se3.invert(T_world_frame) @ self._window.pose(stamp_ns)
            for stamp_ns in self._keyframes.stamps_ns
            if stamp_ns in self._window and stamp_ns not in apart
        }
        scores = self._keyframes.scores(T_frame_keyframes)
        measure = partial(self._link, observations)
        n_now = self._n_steps[observations.stamp_ns]
        n_steps = {ns: n_now - self._n_steps[ns] for ns in scores}
        config = self._config.window
        links = link_keyframes(measure, scores, T_frame_keyframes, step, config, n_steps=n_steps)
        edges = first + [("keyframe", edge) for edge in links]
        still = zero_motion_edge(step, self._config.window)
        return edges if still is None else [*edges, ("standstill", still)], scores

    def _link(
        self,
        observations: Any,  # noqa: ANN401 - the front-end's own
        stamp_ns: int,
        prior: FloatArray,
    ) -> Edge | None:
        keyframe = self._keyframes[stamp_ns]
        result = register_checked(self._frontend, keyframe, observations, prior)
        return None if isinstance(result, Failure) else self._link_edge(stamp_ns, result)

    def _link_edge(self, stamp_ns: int, result: RelativePose) -> Edge:
        return Edge(
            reference_id=stamp_ns,
            T_reference_frame=result.T_reference_current,
            covariance=self._config.window.link_sigma_factor**2 * result.covariance,
        )

    def _apart(self) -> list[int]:
        """Return the keyframes of earlier segments, which wait to be seen again."""
        return self._segments.apart(self._keyframes.stamps_ns)

    def _look_around(
        self,
        observations: Any,  # noqa: ANN401 - the front-end's own
        step: RawStep,
    ) -> Edge | None:
        """Look for keyframes of earlier segments; return an edge to one that is there for sure."""
        segments = self._segments
        if not self._config.window.relocalize:
            return None
        held_ns = [ns for ns in self._apart() if ns in self._window]
        reference_ns = step.reference_ns if step.is_registered else None
        for stamp_ns in segments.to_look_for(held_ns):
            result = relocalize_checked(self._frontend, self._keyframes[stamp_ns], observations)
            if isinstance(result, Failure):
                continue
            edge = self._link_edge(stamp_ns, result)
            before = segments.sighting
            seen_ns = None if before is None else before.edge.reference_id
            known = self._window.relative_pose(seen_ns, stamp_ns) if seen_ns in held_ns else None
            if segments.confirms(edge, step.estimate, reference_ns, known):
                return edge
            segments.sighting = Sighting(raw=step.estimate, edge=edge)
            return None
        return None

    def _note_segments(self, step: RawStep, causal: Estimate) -> tuple[SegmentJoin, ...]:
        """Take what the window made of the frame; return the segments that it joins."""
        stamp_ns = causal.stamp_ns
        reference_ns = step.reference_ns if step.is_registered else None
        self._segments.note_frame(stamp_ns, reference_ns, causal.status)
        ties_ns = [int(edge.reference_id) for edge in self._window.edges(stamp_ns)]  # type: ignore[call-overload]
        joins = [self._segments.join(stamp_ns, tie_ns) for tie_ns in ties_ns]
        return tuple(join for join in joins if join is not None)

    def _update_keyframes(
        self,
        observations: Any,  # noqa: ANN401 - the front-end's own
        scores: dict[int, float],
        causal: Estimate,
    ) -> None:
        """Keep and release keyframes; none while the pose is only a guess."""
        is_tied = causal.status in (Status.OK, Status.RESUMED)
        if not is_tied or causal.frame_id not in self._window:
            return
        config = self._config.window
        if config.n_keyframes > 0 and is_needed(scores, config):
            self._keyframes.add(observations)
            self._window.keep(observations.stamp_ns)
            self._segments.note_keyframe()
        apart = self._apart()
        n_kept = len(self._keyframes) - len(apart)
        released = choose_released(scores, config, n_kept=n_kept)
        for stamp_ns in released + apart[: max(len(apart) - config.n_keyframes, 0)]:
            self._keyframes.drop(stamp_ns)
            self._window.release(stamp_ns)
        for stamp_ns in self._keyframes.stamps_ns:
            if stamp_ns not in self._window:
                self._keyframes.drop(stamp_ns)

    def _hold_anchor(self) -> None:
        """Keep the frame that the chain comes back to, however long it coasts."""
        previous, self._anchor_ns = self._anchor_ns, self._chain.anchor_ns
        if previous not in self._keyframes.stamps_ns and previous in self._window:
            self._window.release(previous)
        if self._anchor_ns in self._window:
            self._window.keep(self._anchor_ns)

    def _hold_counts(self, stamp_ns: int) -> None:
        needed = {stamp_ns, self._anchor_ns, *self._keyframes.stamps_ns}
        self._n_steps = {ns: n for ns, n in self._n_steps.items() if ns in needed}

    def _hold_frame(self, frame: Stamped) -> None:
        held = {**self._frames, frame.stamp_ns: frame}
        needed = self._anchor_ns, frame.stamp_ns
        self._frames = {stamp_ns: held[stamp_ns] for stamp_ns in held if stamp_ns in needed}


def _edge_of(step: RawStep) -> Edge:
    return Edge(
        reference_id=step.reference_ns,
        T_reference_frame=step.T_reference_frame,
        covariance=step.covariance,
    )


def zero_motion_edge(step: RawStep, config: WindowConfig) -> Edge | None:
    """Return the edge that holds a frame where its predecessor was, if it stands still.

    Both must hold: the image hardly moves, and the motion is insignificant against its own
    covariance, so that a slow motion that the registration can tell is not frozen.
    """
    if not config.zero_motion or not step.is_registered or step.flow_px is None:
        return None
    twist = se3.log(step.T_reference_frame)
    significance = np.sqrt(se3.mahalanobis(twist, step.covariance))
    if step.flow_px > config.zero_motion_flow_px or significance > config.zero_motion_gate:
        return None
    return Edge(
        reference_id=step.reference_ns,
        T_reference_frame=np.eye(4),
        covariance=config.zero_motion_sigma_factor**2 * step.covariance,
    )


def _choose_frontend(
    camera: StereoCamera | PinholeCamera | None, config: Config, frontend: Frontend[Any] | None
) -> Frontend[Any]:
    if frontend is not None:
        return frontend
    if camera is None:
        raise ValueError("Odometry needs a camera, or a front-end of your own (frontend=...)")
    return make_frontend(camera, config)


def _count_points(observations: object) -> int:
    return len(observations) if isinstance(observations, Sized) else 0


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
