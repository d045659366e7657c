"""Odometry: drives front-end and back-end, frame by frame, and keeps four trajectories."""

from __future__ import annotations

import time
from array import array
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from gvo.backend.inertial import InertialEstimator
from gvo.backend.keyframe_policy import LINK_GAIN, choose_unseen, is_needed
from gvo.backend.window import SlidingWindow
from gvo.config import Config
from gvo.frontend.depth_icp import DepthTrust
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.factory import find_change, frame_of, make_frontend
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.protocol import CheckedFrontend, Frontend, count_points
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.edges import NO_EFFECTS, source_ns
from gvo.geometry.imu import Imu, ImuSamples
from gvo.odometry.chain import RawChain, RawStep
from gvo.odometry.graph import RunGraph
from gvo.odometry.keyframes import Keyframes, judge_links, link_keyframes, misclosure
from gvo.odometry.map import Map
from gvo.trajectory.trajectory import Trajectory
from gvo.types import (
    Edge,
    Estimate,
    Failure,
    FloatArray,
    FrameResult,
    LinkKind,
    Loop,
    MotionPrior,
    Optimum,
    RelativePose,
    RgbdFrame,
    Stamped,
    Status,
    StereoFrame,
)

# Whatever the front-end returns.
_Observations: TypeAlias = Any
_Offer: TypeAlias = tuple[LinkKind, Edge]


class _Links(NamedTuple):
    """How a frame was measured from others: its edges, by kind, in the order they are offered.

    Parameters
    ----------
    scores : dict of int to float
        Of the keyframes, see `Keyframes.scores`.
    offered : list of (kind, Edge)
    found : tuple of Loop, or None
        See `Map.search`.
    is_joining : bool
        The last edge joins another part.
    """

    scores: dict[int, float]
    offered: list[_Offer]
    found: tuple[Loop, ...] | None = None
    is_joining: bool = False


# Of another part so many times fewer keyframes wait to be seen again: each costs time.
_WAITING = 2
# Of the misclosures that a variance factor is averaged over: errors that last do not show at once.
_MIN_LOOP_NS = 300_000_000


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
    imu : Imu, optional
        An IMU beside the camera, whose samples `add_imu` takes: it carries the camera where it sees
        nothing, and changes nothing elsewhere.

    Attributes
    ----------
    link_gain : float
        A keyframe is linked when so many steps have passed since it was asked, times the share of
        it in view. With a smaller one more links measure what is learnt of the camera.

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
        imu: Imu | None = None,
    ) -> None:
        self._config = self._next_config = config or Config()
        self._camera = camera
        self._is_own = frontend is not None
        if frontend is None:
            if camera is None:
                raise ValueError(
                    "Odometry needs a camera, or a front-end of your own (frontend=...)"
                )
            frontend = make_frontend(camera, self._config)
        self._frontend = CheckedFrontend(frontend)
        self._chain: RawChain[Any] = RawChain(self._frontend)
        self._window = SlidingWindow(self._config.window)
        self._keyframes: Keyframes[Any] = Keyframes(self._view(), self._config.window)
        self._is_broken = False  # the raw chain, by a guess
        self._anchor_ns: int | None = None
        self._previous: Estimate | None = None  # by the raw chain
        self._imu = imu or Imu()
        self._inertial: InertialEstimator | None = None
        if imu is not None and self._config.imu.enabled:
            self._use_imu()
        self._map = Map(self._config, self._frontend.recognizer, self._window, self._keyframes)
        self._trust = DepthTrust()
        self._poses = array("d")  # raw and causal ones, upper three rows
        self.link_gain = LINK_GAIN

    def _use_imu(self) -> None:
        config = self._config.imu
        known = self._imu.with_settings(config)
        self._inertial = InertialEstimator(known, max_coast_s=config.max_coast_s)

    @property
    def config(self) -> Config:
        """The configuration of the next frame."""
        return self._next_config

    @property
    def window(self) -> SlidingWindow:
        """The sliding window: its poses by stamp, covariances, edges and counts."""
        return self._window

    @property
    def graph(self) -> RunGraph:
        """The graph of all frames so far, and its loops."""
        return self._map.graph

    @property
    def T_map_world(self) -> FloatArray:  # noqa: N802 - the field's name
        """What loops correct the newest poses by, shape (4, 4): T_map_world @ T_world_frame.

        Optimized in a thread while the run goes, some keyframes behind; the identity until then.
        """
        return self._map.graph.T_map_world

    @property
    def rig_offsets(self) -> RigOffsets | None:
        """What is learnt of the camera, calibrated online; None where nothing is."""
        offsets = self._frontend.rig_offsets
        return offsets if offsets is not None and offsets.learnt else None

    @property
    def inertial(self) -> InertialEstimator | None:
        """What is learnt by the IMU, and of it; None without one."""
        return self._inertial

    def reconfigure(self, config: Config) -> None:
        """Change the configuration from the next frame on.

        Poses, velocity and the window are kept. What takes effect, by section:

        - `temporal`, `ransac`, `registration`: with the next registration.
        - `window`: with the next update, see `SlidingWindow.reconfigure`; edges in the window
          keep their kernel.
        - `frontend`, `klt` or `features`, `stereo` or `depth`, as the sensor and the front-end
          use them: the last frame is extracted again. Keyframes stay where they can be registered
          with new frames. They cannot after another `frontend.kind`, or `kind`, `n_octaves`,
          `scale_factor` or `upright` of `features` (descriptor): then KLT keyframes, which hold
          their images, are extracted again, and those of descriptors are released.
        - `camera`, `stereo`: what was learnt of the camera is estimated anew.
        - `imu`: `max_coast_s` with the next frame, and it carries no more once it is not `enabled`;
          the rest with the next run.
        - `loops`, `runtime`: with the next frame. Where loops were not enabled, places are kept
          from it on.
        - `sync`, `images`, `depth.scale`, `check`: not here, but where frames are read.

        A front-end of one's own is told at once where it is `Reconfigurable`.

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
        if config != self._next_config:
            self._frontend.reconfigure(config)
        self._next_config = config

    def add_imu(self, stamps_ns: ArrayLike, gyro: ArrayLike, acceleration: ArrayLike) -> None:
        """Take samples of the IMU: all up to the next frame, before it.

        Those that are no numbers, absurd, or not later than all before are passed over. Of an IMU
        that was not given at construction, how it sits and how late it is are learnt.

        Parameters
        ----------
        stamps_ns : array_like of int, shape (n,)
            By the clock of the IMU, nanoseconds.
        gyro : array_like of float, shape (n, 3)
            Angular velocity in the axes of the IMU, rad/s.
        acceleration : array_like of float, shape (n, 3)
            Specific force there, m/s^2: at rest 9.81 upwards.

        Raises
        ------
        ValueError
            Where stamps are no whole numbers, as seconds are, or shapes do not fit.
        """
        samples = ImuSamples.of(stamps_ns, gyro, acceleration)
        if self._inertial is None and self._config.imu.enabled:
            self._use_imu()
        if self._inertial is not None:
            self._inertial.add(samples)

    def track(self, frame: Stamped) -> FrameResult:
        """Take the next frame and return its poses.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame, or what the front-end takes
            Its stamp must be later than that of the frame before.

        Raises
        ------
        ValueError
            For a stamp that does not advance, and a frame of another kind or size than the
            camera's; a front-end of one's own judges its frames itself. Nothing is changed then.
        """
        if self._camera is not None and not self._is_own:
            _check_frame(frame, self._camera)
        watch = Stopwatch()
        self._take_over_configuration()
        observations = self._frontend.extract(frame)
        watch.lap("extract")
        step = self._step(frame, observations)
        watch.lap("register")
        carried = None if self._inertial is None else self._carry(self._inertial, step)
        links = self._link(observations, step, carried)
        watch.lap("links")
        causal, T_previous_frame = self._smooth(step, links, carried)
        if self._inertial is not None:
            self._tell_inertial(self._inertial, step, causal)
        self._select_keyframes(observations, step, links.scores, causal)
        watch.lap("window")
        joins, loops = self._map.add(observations, causal, links.found, self._chain.anchor)
        watch.lap("loops")
        result = self._result(observations, step, links.offered, causal, watch.stage_ms)
        return replace(
            result,
            joins=joins,
            loops=loops,
            T_previous_frame=T_previous_frame,
            is_carried=carried is not None and causal.status is Status.COASTING,
        )

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses of the frames still in the window."""
        finished = tuple(self._window.finish())
        self._map.graph.settle(finished)
        return finished

    def optimize(self) -> Optimum:
        """Return the poses of all frames so far that fit all that was measured best.

        Loops are closed; without any that counts, they are the smoothed poses.

        Raises
        ------
        SmoothingError
            When GTSAM fails, and before the first frame.
        """
        return self.snapshot().optimize()

    def snapshot(self) -> RunGraph:
        """Return the graph as it is now, to be optimized in another thread."""
        graph = self._map.graph
        graph.settle(self._window.estimate(frame_id) for frame_id in self._window.poses())
        return graph.snapshot()

    def trajectories(self) -> dict[str, Trajectory]:
        """Return the poses of all frames so far as "raw", "causal", "smoothed" and "global".

        Call it after the last frame, or between two. Raw and causal poses come without their
        covariances, which each `FrameResult` holds. See `optimize` for the global ones.

        Raises
        ------
        SmoothingError
            As `optimize`.
        """
        optimum, path = self.optimize(), self._map.graph.path
        T = np.tile(np.eye(4), (len(path), 2, 1, 1))
        T[:, :, :3] = np.reshape(self._poses, (-1, 2, 3, 4))
        stamps_ns = np.array(path.stamps_ns)
        raw, causal = (Trajectory(stamps_ns=stamps_ns, T_world_frame=T[:, k]) for k in (0, 1))
        smoothed, best = map(Trajectory.of, (path.estimates(), optimum.estimates))
        return {"raw": raw, "causal": causal, "smoothed": smoothed, "global": best}

    def __repr__(self) -> str:
        """Return one line: the camera, the frames so far, and the keyframes."""
        n, n_kept = len(self._map.graph.path), len(self._keyframes.kept)
        seen = self._camera or "a front-end of your own"
        return f"Odometry({seen}, {n} frames, {n_kept} keyframes)"

    def _result(
        self,
        observations: _Observations,
        step: RawStep,
        offered: list[_Offer],
        causal: Estimate,
        stage_ms: dict[str, float],
    ) -> FrameResult:
        n_keypoints, n_points = count_points(observations)
        answer = step.registration or step.failure
        effects = NO_EFFECTS if step.effects is None else step.effects
        finished = tuple(self._window.pop_finished())
        self._map.graph.settle(finished)
        for estimate in (step.estimate, causal):
            self._poses.extend(estimate.T_world_frame[:3].ravel())
        return FrameResult(
            raw=replace(
                step.estimate,
                frame_id=step.estimate.stamp_ns,
                covariance=step.covariance + effects @ effects.T,
                effects=step.effects,
            ),
            causal=causal,
            finished=finished,
            status=causal.status,
            reason="" if step.failure is None else step.failure.reason,
            n_keypoints=n_keypoints,
            n_points=n_points,
            n_matches=0 if answer is None else answer.n_matches,
            n_inliers=0 if answer is None else answer.n_inliers,
            n_links=len(offered) - len(causal.rejected),
            registration=step.registration,
            links=judge_links(offered, step.estimate.stamp_ns, self._window),
            keyframes_ns=tuple(self._keyframes.kept),
            segment=self._map.segment,
            T_map_world=self.T_map_world,
            inertial=None if self._inertial is None else self._inertial.state,
            stage_ms=stage_ms,
        )

    def _view(self) -> StereoCamera | None:
        """Return the camera of the view overlap."""
        view = self._frontend.camera or self._camera
        return None if view is None else as_stereo(view)

    def _take_over_configuration(self) -> None:
        """Take over another configuration before a frame."""
        former, self._config = self._config, self._next_config
        if self._config is former or self._config == former:
            return
        if self._camera is not None and not self._is_own:
            self._renew_frontend(former, self._camera)
        self._window.reconfigure(self._config.window)
        if self._inertial is not None:
            imu = self._config.imu
            self._inertial.max_coast_s = imu.max_coast_s if imu.enabled else 0.0
        self._keyframes.camera, self._keyframes.config = self._view(), self._config.window
        self._map.reconfigure(self._config, self._frontend.recognizer)

    def _renew_frontend(self, former: Config, camera: StereoCamera | PinholeCamera) -> None:
        """Make another front-end and extract the last frames again, where that has changed."""
        change = find_change(former, self._config, is_stereo=isinstance(camera, StereoCamera))
        if not change.is_any:
            return
        offsets = None if change.is_of_rig else self._frontend.rig_offsets
        if offsets is not None:
            offsets.reconfigure(self._config)
        self._frontend = CheckedFrontend(make_frontend(camera, self._config, rig_offsets=offsets))
        self._chain.reconfigure(self._frontend, is_renewed=change.is_of_extraction)
        if change.is_of_kind:
            self._map.forget_places()
            self._renew_keyframes()

    def _renew_keyframes(self) -> None:
        """Extract keyframes again, and release those whose images are not at hand."""
        for stamp_ns, keyframe in [*self._keyframes.kept.items()]:
            frame = frame_of(keyframe.observations)
            if frame is not None:
                again, start = self._frontend.extract(frame), keyframe.start
                self._keyframes.add(again, n_steps=keyframe.asked_at, start=start)
                continue
            del self._keyframes.kept[stamp_ns]
            if stamp_ns in self._window:
                self._window.release(stamp_ns)

    def _step(self, frame: Stamped, observations: _Observations) -> RawStep:
        """Register a frame against the one before, in the raw chain."""
        offsets = self._frontend.rig_offsets
        step = self._chain.advance(
            frame,
            observations,
            variance_factor=1.0 if offsets is None else offsets.chain_factor.value,
            effects_factor=1.0 if offsets is None else offsets.calibration.size_px,
            seeks_places=self._map.seeks_places,
            inertial=self._inertial,
        )
        self._map.follow(step)
        if step.failure is not None:  # covariances are what edges state once a pose is a guess
            self._is_broken = True
            for keyframe in self._keyframes.kept.values():
                keyframe.start = None
        self._window.variance_factor = 1.0
        if offsets is not None:
            size_px = offsets.calibration.size_px
            self._window.effects_factor = self._map.graph.effects_factor = size_px
        if offsets is not None and not self._is_broken:
            self._window.variance_factor = offsets.window_factor.value
        return step

    def _carry(self, inertial: InertialEstimator, step: RawStep) -> Edge | None:
        """Return how the IMU says that a frame moved since the one before, if vision does not.

        The first frame after a gap is measured from others: with it, those of the gap follow.
        """
        if step.edge is None or self._previous is None:
            return None
        previous_ns = self._previous.stamp_ns
        was_carried = inertial.carried_ns == previous_ns
        is_followed = source_ns(step.edge) == previous_ns or not was_carried
        if step.registration is not None and is_followed:
            return None
        return inertial.carry(previous_ns, step.estimate.stamp_ns)

    def _tell_inertial(self, inertial: InertialEstimator, step: RawStep, causal: Estimate) -> None:
        """Let the IMU follow, by poses as they were given out: keyframes keep these from drifting.

        But by the raw step where a gap ends, and the pose is corrected.
        """
        edge = step.edge if step.registration is not None else None
        if edge is not None and causal.status is Status.OK:
            start = 24 * self._map.graph.path.index(source_ns(edge)) + 12
            T_world_reference = np.eye(4)
            T_world_reference[:3] = np.reshape(self._poses[start : start + 12], (3, 4))
            edge = replace(
                edge,
                T_reference_frame=se3.invert(T_world_reference) @ causal.T_world_frame,
                covariance=self._window.variance_factor * edge.covariance,
            )
        inertial.follow(step.estimate.stamp_ns, edge)

    def _link(self, observations: _Observations, step: RawStep, carried: Edge | None) -> _Links:
        """Measure a frame from its predecessor, from keyframes, and after a gap from places."""
        offered: list[_Offer] = []
        # A coasted step is no measurement: the window predicts by itself.
        if step.edge is not None and step.registration is not None:
            offered.append(("step", step.edge))
        if step.edge is None or step.edge.reference_id not in self._window:  # which would refuse it
            return _Links(scores={}, offered=offered)
        T_frame_keyframes = self._predict_keyframes(carried or step.edge)
        scores = self._keyframes.scores(T_frame_keyframes, step.n_steps)
        links = self._link_keyframes(observations, step, scores, T_frame_keyframes)
        offered += [("keyframe", edge) for edge in links]
        offered += [("depth", edge) for edge in self._align_depths(observations, links)]
        is_needed = self._is_keyframe_needed(scores)
        found = self._map.search(observations, step, links, is_keyframe=is_needed)
        joining = self._map.joining(found)
        offered += [] if joining is None else [("keyframe", joining)]
        offered += [] if carried is None or not offered else [("imu", carried)]
        return _Links(scores=scores, offered=offered, found=found, is_joining=joining is not None)

    def _predict_keyframes(self, edge: Edge) -> dict[int, FloatArray]:
        """Return T_frame_keyframe by stamp, of joined segments, as predicted by the step."""
        T_world_frame = self._window.pose(edge.reference_id) @ edge.T_reference_frame
        T_frame_world = se3.invert(T_world_frame)
        poses, hidden_ns = self._window.poses(self._keyframes.kept), self._map.hidden_ns
        visible_ns = [ns for ns in self._keyframes.kept if ns in poses and ns not in hidden_ns]
        return {ns: T_frame_world @ poses[ns] for ns in visible_ns}

    def _link_keyframes(
        self,
        observations: _Observations,
        step: RawStep,
        scores: dict[int, float],
        T_frame_keyframes: dict[int, FloatArray],
    ) -> list[Edge]:
        kept = self._keyframes.kept
        return link_keyframes(
            partial(self._register_keyframe, observations, step),
            scores,
            T_frame_keyframes,
            step,
            self._config.window,
            n_unasked={ns: step.n_steps - kept[ns].asked_at for ns in scores},
            min_gain=self.link_gain,
        )

    def _register_keyframe(
        self,
        observations: _Observations,
        step: RawStep,
        stamp_ns: int,
        T_keyframe_frame: FloatArray,
    ) -> Edge | None:
        keyframe, is_registered = self._keyframes.kept[stamp_ns], step.failure is None
        prior = MotionPrior(T_predicted=T_keyframe_frame, is_confirmed=is_registered)
        result = self._frontend.register(keyframe.observations, observations, prior)
        keyframe.asked_at, keyframe.is_linked = step.n_steps, isinstance(result, RelativePose)
        if isinstance(result, Failure):
            return None
        T, covariance = result.T_reference_current, result.covariance
        link = Edge(
            reference_id=stamp_ns,
            T_reference_frame=T,
            covariance=covariance,
            effects=result.shared,
        )
        if keyframe.start is not None:
            self._note_misclosure(link, keyframe.start, step.estimate)
        return link

    def _note_misclosure(self, link: Edge, start: Estimate, end: Estimate) -> None:
        """Tell the front-end how well a link agrees with the raw chain since its keyframe."""
        offsets = self._frontend.rig_offsets
        if offsets is not None and end.stamp_ns - start.stamp_ns >= _MIN_LOOP_NS:
            offsets.chain_factor.note(misclosure(link, start, end))

    def _align_depths(self, observations: _Observations, links: list[Edge]) -> list[Edge]:
        """Return what depth alone measured beside links, where colour contradicts it."""
        if not links or not self._trust.is_due():
            return []
        edges = []
        for link in links:
            T, keyframe = link.T_reference_frame, self._keyframes.kept[source_ns(link)]
            depth = self._frontend.align_depth(keyframe.observations, observations, T)
            if isinstance(depth, Failure):
                continue
            by_colour = RelativePose(T_reference_current=T, covariance=link.covariance)
            self._trust.note(by_colour, depth)
            if self._trust.is_on:
                covariance = self._trust.variance_factor * depth.covariance
                T = depth.T_reference_current
                edges.append(replace(link, T_reference_frame=T, covariance=covariance))
        self._map.variance_factor = self._trust.variance_factor
        return edges

    def _smooth(
        self, step: RawStep, links: _Links, carried: Edge | None
    ) -> tuple[Estimate, FloatArray | None]:
        """Add a frame to the window; return its causal pose, and that in the frame before."""
        raw, offsets = step.estimate, self._frontend.rig_offsets
        edges = [edge for _, edge in links.offered]
        status = Status.RESUMED if links.is_joining else None
        causal = self._window.add_pose(
            raw.stamp_ns, raw.stamp_ns, edges, status=status, coasting=carried
        )
        if carried is not None and self._inertial is not None and causal.status is Status.COASTING:
            self._inertial.carried_ns = causal.stamp_ns
        if offsets is not None:
            offsets.window_factor.note(self._window.misfit)
        previous, self._previous = self._previous, raw
        if previous is None:
            return causal, None
        # Of one state of the window; by the raw chain where it has not both.
        T_world_previous, T_world_frame = previous.T_world_frame, raw.T_world_frame
        if previous.stamp_ns in self._window:
            T_world_previous = self._window.pose(previous.stamp_ns)
            T_world_frame = causal.T_world_frame
        return causal, np.asarray(se3.invert(T_world_previous) @ T_world_frame)

    def _select_keyframes(
        self, observations: _Observations, step: RawStep, scores: dict[int, float], causal: Estimate
    ) -> None:
        """Keep and release keyframes; none while the pose is only a guess."""
        is_tied = causal.status in (Status.OK, Status.RESUMED)
        if is_tied and causal.frame_id in self._window:
            if self._is_keyframe_needed(scores):
                self._keyframes.add(observations, n_steps=step.n_steps, start=step.estimate)
                self._window.keep(causal.stamp_ns)
            self._release_keyframes(scores)
        self._keep_anchor()

    def _is_keyframe_needed(self, scores: dict[int, float]) -> bool:
        # A keyframe that cannot be registered stands for nothing that is in view.
        kept = self._keyframes.kept
        linked = {ns: score for ns, score in scores.items() if kept[ns].is_linked}
        return self._config.window.n_keyframes > 0 and is_needed(linked)

    def _release_keyframes(self, scores: dict[int, float]) -> None:
        kept, unjoined = self._keyframes.kept, self._map.unjoined_ns
        n_keyframes = self._config.window.n_keyframes
        n_over = max(len(kept) - len(unjoined) - n_keyframes, 0)
        seen_at = {ns: keyframe.seen_at for ns, keyframe in kept.items()}
        n_waiting = max(n_keyframes // _WAITING, 1)
        too_many = unjoined[: max(len(unjoined) - n_waiting, 0)]
        for stamp_ns in choose_unseen(scores, seen_at, n_over) + too_many:
            del kept[stamp_ns]
            self._window.release(stamp_ns)
        for stamp_ns in [ns for ns in kept if ns not in self._window]:
            del kept[stamp_ns]

    def _keep_anchor(self) -> None:
        """Keep the frame that the chain comes back to, however long it coasts."""
        anchor, previous = self._chain.anchor, self._anchor_ns
        self._anchor_ns = None if anchor is None else anchor.stamp_ns
        if previous not in self._keyframes and previous in self._window:
            self._window.release(previous)
        if self._anchor_ns in self._window:
            self._window.keep(self._anchor_ns)


def _check_frame(frame: Stamped, camera: StereoCamera | PinholeCamera) -> None:
    """Refuse what is no frame of a camera; images of another size would be tracked to nonsense."""
    kind = StereoFrame if isinstance(camera, StereoCamera) else RgbdFrame
    if not isinstance(frame, kind):
        raise ValueError(
            f"{type(camera).__name__}: expected a {kind.__name__}, got {type(frame).__name__}"
        )
    height, width = (frame.left if isinstance(frame, StereoFrame) else frame.image).shape
    if (width, height) != (camera.width, camera.height):
        raise ValueError(
            f"the images are {width}x{height} pixels, the camera is {camera.width}x{camera.height}"
        )


class Stopwatch:
    """Measures stages of work that follow each other, by name."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}
        self._last_s = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a stage."""
        last_s, self._last_s = self._last_s, time.perf_counter()
        self.stage_ms[name] = 1e3 * (self._last_s - last_s)
