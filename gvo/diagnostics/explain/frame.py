"""Drive the odometry up to a frame, then tell what happened with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gvo.config import Config
from gvo.diagnostics.explain.attempts import attempts_of, describe, n_chain_calls
from gvo.diagnostics.explain.extraction import explain_depth, explain_keypoints, explain_stereo
from gvo.diagnostics.explain.links import Before, explain_links
from gvo.diagnostics.explain.matching import explain_temporal
from gvo.diagnostics.explain.motion import explain_consensus, explain_refinement
from gvo.diagnostics.explain.subpixel import explain_subpixel
from gvo.diagnostics.explain.values import FrameExplanation
from gvo.diagnostics.explain.watch import Registration, WatchedFrontend
from gvo.errors import RecordingError
from gvo.frontend.protocol import Stamped
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames
from gvo.io.recording import Source
from gvo.odometry.keyframes import Keyframes
from gvo.odometry.odometry import Odometry
from gvo.types import FaultyFrame, Frame, FrameResult, Progress, Status


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
    """Odometry, with all that is needed to tell what it does with the next frame."""

    def __init__(self, source: Source, config: Config) -> None:
        self._name = source.info.name
        self._config = config
        self._frontend = WatchedFrontend(source.info.camera, config)
        self._odometry = Odometry(source.info.camera, config, frontend=self._frontend)
        self._keyframes: Keyframes[Stamped] = Keyframes(self._frontend.camera, config.window)
        self._frames: dict[int, Frame] = {}
        self._indices: dict[int, int] = {}
        self._anchor_ns: int | None = None
        self._previous: FrameResult | None = None

    def track(self, frame: Frame, index: int) -> FrameResult:
        """Take a frame as a run does."""
        result = self._odometry.track(frame)
        self._frames[frame.stamp_ns], self._indices[frame.stamp_ns] = frame, index
        if result.registration is not None or self._previous is None:
            self._anchor_ns = frame.stamp_ns
        self._follow_keyframes(result)
        kept = {frame.stamp_ns, self._anchor_ns, *result.keyframes_ns}
        self._frames = {ns: self._frames[ns] for ns in self._frames if ns in kept}
        self._previous = result
        return result

    def _follow_keyframes(self, result: FrameResult) -> None:
        """Keep what the odometry keeps."""
        for stamp_ns in self._keyframes.stamps_ns:
            if stamp_ns not in result.keyframes_ns:
                self._keyframes.drop(stamp_ns)
        if result.stamp_ns in result.keyframes_ns:
            self._keyframes.add(self._frontend.latest.observations)

    def explain(self, frame: Frame, index: int) -> FrameExplanation:
        """Take a frame and tell what happened with it."""
        before = Before(
            T_world_frames={
                ns: self._odometry.window.pose(ns)
                for ns in self._frames
                if ns in self._odometry.window
            },
            keyframes=self._keyframes,
            frames=dict(self._frames),
            indices=dict(self._indices),
            previous=self._previous,
            min_overlap=self._config.window.min_overlap,
        )
        self._frontend.is_watching = True
        result = self._odometry.track(frame)
        calls = self._frontend.latest.registrations
        chain = calls[: n_chain_calls(calls, result.registration)]
        reference_ns = chain[-1].reference_ns if chain else None
        return FrameExplanation(
            recording=self._name,
            index=index,
            config=self._config,
            camera=self._frontend.camera,
            frame=frame,
            reference=None if reference_ns is None else before.frames[reference_ns],
            reference_index=None if reference_ns is None else before.indices[reference_ns],
            result=result,
            rig_offsets=self._odometry.rig_offsets,
            attempts=tuple(line for call in chain for line in describe(call, before.indices)),
            links=explain_links(calls, len(chain), result, before),
            became_keyframe=frame.stamp_ns in result.keyframes_ns,
            **self._steps(chain[-1] if chain else None),
        )

    def _steps(self, call: Registration | None) -> dict[str, Any]:
        """Return what was found in the frame, and the last attempt to register it."""
        watch, camera, config = self._frontend.latest, self._frontend.camera, self._config
        stereo = explain_stereo(watch, camera, config)
        attempts = [] if call is None else attempts_of(call.events)
        last = attempts[-1] if attempts else None
        return {
            "offset_px": watch.offset_px,
            "row_offset_px": watch.row_offset_px,
            "keypoints": explain_keypoints(watch, config),
            "stereo": stereo,
            "depth": explain_depth(watch, config),
            "subpixel": explain_subpixel(watch, stereo, config),
            "temporal": None if last is None else explain_temporal(last, watch.frame, config),
            "consensus": None if last is None else explain_consensus(last, camera, config),
            "refinement": None if last is None else explain_refinement(last, camera, config),
        }
