"""Odometry up to a frame, then what happened with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from gvo.backend.keyframe_policy import MIN_OVERLAP
from gvo.config import Config
from gvo.diagnostics.explain.extraction import explain_corner, explain_measured
from gvo.diagnostics.explain.motion import Asked, OwnFrontend, explain_registration
from gvo.diagnostics.explain.values import FrameExplanation, Link
from gvo.errors import RecordingError
from gvo.frontend.descriptor import is_step
from gvo.frontend.factory import make_frontend
from gvo.frontend.klt import KltFrontend, image_of
from gvo.geometry import se3
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames
from gvo.io.recording import Source
from gvo.odometry.keyframes import view_overlap
from gvo.odometry.odometry import Odometry
from gvo.types import (
    Failure,
    FaultyFrame,
    Frame,
    FrameResult,
    MotionPrior,
    Progress,
    RelativePose,
    Status,
)


def explain_frame(
    source: Source,
    index: int,
    *,
    config: Config | None = None,
    excerpt: Excerpt | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> FrameExplanation:
    """Run up to one frame of a recording and explain what happened with it.

    Parameters
    ----------
    source : Source
        The recording.
    index : int
        Of the frame, from 0: its row in `frames.csv` of a run. Faulty frames count, images of
        an RGB-D camera without partner do not.
    config : Config, optional
    excerpt : Excerpt, optional
        Which frames are read; the index counts those.
    on_progress : callable, optional
        Called after each frame.

    Returns
    -------
    FrameExplanation

    Raises
    ------
    ValueError
        For an index below 0.
    RecordingError
        When the recording has no such frame, or it is faulty.
    """
    if index < 0:
        raise ValueError(f"index must be 0 or more, got {index}")
    config = config or Config()
    drive = _Drive(source, config)
    n = n_tracked = 0
    for item in frames(source, config, excerpt, with_unpaired=False):
        if isinstance(item, FaultyFrame):
            if n == index:
                raise RecordingError(
                    f"{source.info.name}: frame {index} is faulty: {item.reason}; choose another"
                )
        elif n == index:
            return drive.explain(item, index)
        else:
            n_tracked += drive.track(item, n).status in (Status.OK, Status.RESUMED)
        n += 1
        if on_progress is not None:
            on_progress(Progress(n_done=n, n_total=index + 1, n_tracked=n_tracked))
    raise RecordingError(
        f"{source.info.name}: there is no frame {index}: "
        + (f"there are {n}, counted from 0; choose one up to {n - 1}" if n else "no frame was read")
    )


class _Watched:
    """A front-end that keeps what it was asked to register."""

    def __init__(self, frontend: OwnFrontend) -> None:
        self.own = frontend
        self.asked: list[Asked] = []
        self.extracted: dict[int, Any] = {}

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever else a front-end offers
        return getattr(self.own, name)

    def extract(self, frame: Frame) -> Any:  # noqa: ANN401 - the front-end's own observations
        self.extracted[frame.stamp_ns] = self.own.extract(frame)
        return self.extracted[frame.stamp_ns]

    def register(
        self,
        reference: Any,  # noqa: ANN401
        current: Any,  # noqa: ANN401
        prior: MotionPrior | None,
    ) -> RelativePose | Failure:
        result = self.own.register(reference, current, prior)
        self.asked.append(Asked(reference, current, prior, result))
        return result


class _Drive:
    """Odometry that keeps the frames which the next one may be registered with."""

    def __init__(self, source: Source, config: Config) -> None:
        camera = source.info.camera
        self._frontend = _Watched(make_frontend(camera, config))
        self._odometry = Odometry(camera, config, frontend=self._frontend)
        self._name, self._config = source.info.name, config
        self._frames: dict[int, Frame] = {}
        self._indices: dict[int, int] = {}
        self._anchor_ns: int | None = None

    def track(self, frame: Frame, index: int) -> FrameResult:
        """Track a frame as a run does."""
        self._frontend.asked.clear()
        result = self._odometry.track(frame)
        if result.registration is not None or self._anchor_ns is None:
            self._anchor_ns = frame.stamp_ns
        held = {**self._frames, frame.stamp_ns: frame}
        needed = {frame.stamp_ns, self._anchor_ns, *result.keyframes_ns}
        extracted = self._frontend.extracted
        self._frontend.extracted = {ns: extracted[ns] for ns in extracted if ns in needed}
        self._frames = {ns: held[ns] for ns in held if ns in needed}
        self._indices[frame.stamp_ns] = index
        return result

    def explain(self, frame: Frame, index: int) -> FrameExplanation:
        """Track a frame, then repeat its steps one by one."""
        before, extracted = {**self._frames}, {**self._frontend.extracted}
        result = self.track(frame, index)
        self._frontend.extracted |= extracted
        own, config = self._frontend.own, self._config
        asked = [*self._frontend.asked]
        offsets = own.rig_offsets
        measured = explain_measured(frame, own.camera, config, offsets)
        steps = [each for each in asked if is_step(each.prior)]
        links = tuple(self._links(asked, result, before))
        reference_ns = steps[-1].reference.stamp_ns if steps else None
        reference = None if reference_ns is None else before[reference_ns]
        registration = explain_registration(own, steps[-1], config) if steps else None
        corner = None
        if isinstance(own, KltFrontend):
            near_m = config.stereo.min_depth_m
            seen = frame, reference, measured, registration, own.camera
            corner = explain_corner(*seen, min_depth_m=near_m)
        return FrameExplanation(
            recording=self._name,
            index=index,
            config=config,
            camera=own.camera,
            frame=frame,
            reference=reference,
            reference_index=None if reference_ns is None else self._indices[reference_ns],
            result=result,
            offsets=offsets,
            measured=measured,
            corner=corner,
            registration=registration,
            links=links,
        )

    def _links(
        self, asked: list[Asked], result: FrameResult, frames: dict[int, Frame]
    ) -> Iterator[Link]:
        """Yield what each earlier frame contributed."""
        registered = {each.reference.stamp_ns: each for each in asked}
        edges = {link.reference_ns: link for link in reversed(result.links)}
        known = sorted({*result.keyframes_ns, *edges} & {*frames})
        steps_ns = [link.reference_ns for link in result.links if link.kind == "step"]
        refusals = {each.reference_id: each.reason for each in reversed(result.causal.rejected)}
        for ns in sorted(known, key=lambda ns: ns not in steps_ns):
            edge = edges.get(ns)
            answer = registered[ns].result if ns in registered else None
            overlap = self._overlap(ns, result)
            reason = refusals.get(ns, "the window did not take it")
            if edge is None:
                reason = self._why_unlinked(answer, overlap)
            is_accepted = edge is not None and edge.is_accepted
            unused = "not linked" if answer is None else "keyframe"
            yield Link(
                frame=self._indices[ns],
                stamp_ns=ns,
                image=image_of(frames[ns]),
                kind=unused if edge is None else edge.kind,
                overlap=overlap,
                chi2=None if edge is None else edge.chi2,
                is_accepted=is_accepted,
                reason="" if is_accepted else reason,
                registration=answer,
            )

    def _overlap(self, stamp_ns: int, result: FrameResult) -> float:
        """Return the share of the points of an earlier frame in view, by the poses found."""
        if stamp_ns not in self._odometry.window:
            return 0.0
        T_frame_world = se3.invert(result.causal.T_world_frame)
        T_frame_earlier = T_frame_world @ self._odometry.window.pose(stamp_ns)
        points = self._frontend.extracted[stamp_ns].points_cam
        return float(view_overlap(points, T_frame_earlier, self._frontend.own.camera))

    def _why_unlinked(self, answer: RelativePose | Failure | None, overlap: float) -> str:
        if isinstance(answer, Failure):
            return answer.reason
        if answer is not None:
            return "another frame must confirm it first"
        if overlap < MIN_OVERLAP:
            return "too little overlap"
        return "other links add more, or the view has not changed since the last one"
