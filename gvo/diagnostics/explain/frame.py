"""Odometry up to a frame, then what happened with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from gvo._trace import Trace, watched
from gvo.config import Config
from gvo.diagnostics.explain import steps
from gvo.diagnostics.explain.steps import Registration, describe, registrations_of
from gvo.diagnostics.explain.values import FrameExplanation, Step
from gvo.errors import RecordingError
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.klt import image_of
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.types import Failure, FaultyFrame, Frame, FrameResult, Progress, RelativePose, Status


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


class _Drive:
    """Odometry that keeps the frames which the next one may be registered against."""

    def __init__(self, source: Source, config: Config) -> None:
        # Only this thread is watched; results do not depend on the number of threads.
        runtime = config.runtime.model_copy(update={"threads": 1})
        watchable = config.model_copy(update={"runtime": runtime})
        self._odometry = Odometry(source.info.camera, watchable)
        self._camera = as_stereo(source.info.camera)
        self._name, self._config = source.info.name, config
        self._frames: dict[int, Frame] = {}
        self._indices: dict[int, int] = {}
        self._anchor_ns: int | None = None

    def track(self, frame: Frame, index: int) -> FrameResult:
        """Track a frame as a run does."""
        result = self._odometry.track(frame)
        if result.registration is not None or self._anchor_ns is None:
            self._anchor_ns = frame.stamp_ns
        held = {**self._frames, frame.stamp_ns: frame}
        needed = {frame.stamp_ns, self._anchor_ns, *result.keyframes_ns}
        self._frames = {ns: held[ns] for ns in held if ns in needed}
        self._indices[frame.stamp_ns] = index
        return result

    def explain(self, frame: Frame, index: int) -> FrameExplanation:
        """Track a frame and tell what happened with it."""
        with watched() as trace:
            result = self._odometry.track(frame)
        config, offsets = self._config, trace.find("rig.offsets")
        row_px = offsets.get("row_px", 0.0)
        measured = steps.explain_measured(trace, config, row_px)
        n_chain = len(chain := registrations_of(trace.before("odometry.step")))
        reference_ns = chain[-1].reference_ns if chain else None
        tried = chain[-1].attempts if chain else []
        last = tried[-1] if tried else Trace()
        scores = trace.find("odometry.scores").get("scores", {})
        return FrameExplanation(
            recording=self._name,
            index=index,
            config=config,
            camera=self._camera,
            frame=frame,
            reference=None if reference_ns is None else self._frames[reference_ns],
            reference_index=None if reference_ns is None else self._indices[reference_ns],
            result=result,
            offset_px=offsets.get("disparity_px", 0.0),
            row_offset_px=row_px,
            readout_ms=offsets.get("readout_ms", 0.0),
            row_motion_px=steps.explain_rows(last),
            keypoints=steps.explain_keypoints(trace),
            measured=measured,
            depth_pixels=steps.explain_depth_pixels(frame, config.depth),
            subpixel=steps.explain_subpixel(trace, frame, measured, config.stereo, row_px),
            matches=steps.explain_matches(last, config),
            consensus=steps.explain_consensus(last, self._camera, config),
            refinement=steps.explain_refinement(last, self._camera, config),
            attempt=last,
            attempts=tuple(line for each in chain for line in describe(each, self._indices)),
            links=tuple(self._links(registrations_of(trace)[n_chain:], scores, result)),
        )

    def _links(
        self, tried: Sequence[Registration], scores: Mapping[int, float], result: FrameResult
    ) -> Iterator[Step]:
        """Tell what each earlier frame contributed."""
        registrations = {each.reference_ns: each.result for each in tried}
        keyframes = {link.reference_ns: link for link in result.links if link.kind == "keyframe"}
        before = [link for link in result.links if link.kind == "step"]
        others = sorted({*scores} - {link.reference_ns for link in before} | {*registrations})
        refusals = {each.reference_id: each.reason for each in reversed(result.causal.rejected)}
        for ns, link, registration in [
            *((link.reference_ns, link, result.registration) for link in before),
            *((ns, keyframes.get(ns), registrations.get(ns)) for ns in others),
            *((link.reference_ns, link, None) for link in result.links if link.kind == "depth"),
        ]:
            is_accepted = link is not None and link.is_accepted
            unused = "keyframe" if registration is not None else "not linked"
            reason = refusals.get(ns, "not taken by the window")
            if link is None:
                reason = self._why_unlinked(registration, scores.get(ns, 0.0))
            yield Step(
                frame=self._indices[ns],
                stamp_ns=ns,
                kind=unused if link is None else link.kind,
                overlap=scores.get(ns),
                chi2=None if link is None else link.chi2,
                is_accepted=is_accepted,
                reason="" if is_accepted else reason,
                n_matches=0 if registration is None else registration.n_matches,
                n_inliers=0 if registration is None else registration.n_inliers,
                drawn=Step(image=image_of(self._frames[ns]), registration=registration),
            )

    def _why_unlinked(self, registration: RelativePose | Failure | None, overlap: float) -> str:
        if isinstance(registration, Failure):
            return registration.reason
        if registration is not None:
            return "another frame must confirm it first"
        if overlap < self._config.window.min_overlap:
            return "too little overlap"
        return "other links add more, or the view has not changed since the last one"
