"""The kept frames, and the links to them that come with a new frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from scipy.linalg.lapack import dposv

from gvo.backend.gating import disagreement
from gvo.backend.keyframe_policy import MIN_OVERLAP, choose_links, proximity
from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.frontend.protocol import HasPoints, ObservationsT
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.edges import chi2
from gvo.odometry.chain import RawStep
from gvo.types import Edge, Estimate, FloatArray, FrameLink, LinkKind

# Points of a keyframe that its view overlap is estimated from.
_N_SAMPLES = 64
# Beyond this ratio of depths a point is not matched again by patches of one size.
_MAX_ZOOM = 1.6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Keyframe(Generic[ObservationsT]):
    """A kept frame, and a sample of its points."""

    observations: ObservationsT
    points_cam: FloatArray | None


class Keyframes(Generic[ObservationsT]):
    """The kept frames and their scores, by which the policy chooses.

    Where the observations hold `points_cam` and the camera is known, the score of a keyframe is
    the share of its points in view of the current frame; else the proximity of the poses.

    Parameters
    ----------
    camera : StereoCamera or None
    config : WindowConfig
        Distance and angle of the proximity.
    """

    def __init__(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        self._camera, self._config = camera, config
        self._kept: dict[int, _Keyframe[ObservationsT]] = {}
        # Those whose last registration failed.
        self._unlinked: set[int] = set()
        # Numbers of steps at which keyframes were asked for a link last, and in view last.
        self._asked_at: dict[int, int] = {}
        self._seen_at: dict[int, int] = {}

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the kept frames, oldest first."""
        return list(self._kept)

    def __getitem__(self, stamp_ns: int) -> ObservationsT:
        """Return the observations of a kept frame."""
        return self._kept[stamp_ns].observations

    def __len__(self) -> int:
        """Return the number of kept frames."""
        return len(self._kept)

    def n_unasked(self, n_steps: int) -> dict[int, int]:
        """Return the number of steps since each keyframe was asked for a link, or kept."""
        return {stamp_ns: n_steps - asked_at for stamp_ns, asked_at in self._asked_at.items()}

    def note_attempt(self, stamp_ns: int, n_steps: int, *, is_linked: bool) -> None:
        """Remember that a keyframe was asked for a link, and whether it gave one."""
        self._asked_at[stamp_ns] = n_steps
        if is_linked:
            self._unlinked.discard(stamp_ns)
        else:
            self._unlinked.add(stamp_ns)

    def registrable(self, scores: Mapping[int, float]) -> dict[int, float]:
        """Return the scores without keyframes whose last registration failed."""
        return {ns: score for ns, score in scores.items() if ns not in self._unlinked}

    def note_seen(self, scores: Mapping[int, float], n_steps: int) -> None:
        """Remember which keyframes are in view of the current frame."""
        for stamp_ns, score in scores.items():
            if score >= MIN_OVERLAP:
                self._seen_at[stamp_ns] = n_steps

    def n_unseen(self, n_steps: int) -> dict[int, int]:
        """Return the number of steps since each keyframe was in view."""
        return {stamp_ns: n_steps - seen_at for stamp_ns, seen_at in self._seen_at.items()}

    def reconfigure(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        """Score with another camera or configuration from now on; what is kept stays."""
        self._camera, self._config = camera, config

    def add(self, observations: ObservationsT, *, n_steps: int = 0) -> None:
        """Keep a frame."""
        points = observations.points_cam if isinstance(observations, HasPoints) else None
        self._kept[observations.stamp_ns] = _Keyframe(
            observations=observations, points_cam=None if points is None else _sample_points(points)
        )
        self._asked_at[observations.stamp_ns] = self._seen_at[observations.stamp_ns] = n_steps

    def replace(self, observations: ObservationsT) -> None:
        """Keep other observations of a frame that is kept already."""
        self.add(observations, n_steps=self._asked_at[observations.stamp_ns])

    def drop(self, stamp_ns: int) -> None:
        """Forget a kept frame."""
        del self._kept[stamp_ns]
        del self._asked_at[stamp_ns], self._seen_at[stamp_ns]
        self._unlinked.discard(stamp_ns)

    def scores(self, T_current_keyframe: Mapping[int, FloatArray]) -> dict[int, float]:
        """Return how much the current frame has in common with keyframes, 0 to 1.

        Parameters
        ----------
        T_current_keyframe : mapping of int to ndarray of float64, shape (4, 4)
            By stamp of the keyframe.
        """
        kept = [self._kept[stamp_ns].points_cam for stamp_ns in T_current_keyframe]
        samples = [points for points in kept if points is not None]
        is_uniform = len(samples) == len(kept) and len({*map(len, samples)}) == 1
        # Samples of one size, as of most frames, are looked at together.
        if is_uniform and self._camera is not None:
            poses = np.stack(list(T_current_keyframe.values()))
            overlaps = view_overlaps(np.stack(samples), poses, self._camera)
            return dict(zip(T_current_keyframe, overlaps.tolist(), strict=True))
        return {stamp_ns: self._score(stamp_ns, T) for stamp_ns, T in T_current_keyframe.items()}

    def _score(self, stamp_ns: int, T_current_keyframe: FloatArray) -> float:
        points = self._kept[stamp_ns].points_cam
        if points is None or self._camera is None:
            return proximity(T_current_keyframe, self._config)
        return view_overlap(points, T_current_keyframe, self._camera)


def _sample_points(points_cam: FloatArray) -> FloatArray:
    """Subsample at most 64 points of shape (n, 3)."""
    n = len(points_cam)
    chosen = np.linspace(0, n - 1, min(_N_SAMPLES, n))
    return points_cam[chosen.astype(np.int64)]


def view_overlap(
    points_keyframe: FloatArray, T_current_keyframe: FloatArray, camera: StereoCamera
) -> float:
    """Return the share of points (n, 3) in view of another camera, at about the same distance."""
    return float(view_overlaps(points_keyframe, T_current_keyframe, camera))


def view_overlaps(
    points_keyframes: FloatArray, T_current_keyframes: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return these shares, shape (...), of points (..., n, 3) by poses (..., 4, 4)."""
    T, points = T_current_keyframes, np.swapaxes(points_keyframes, -1, -2)
    moved = T[..., :3, :3] @ points + T[..., :3, 3:]
    x, y, z = moved[..., 0, :], moved[..., 1, :], moved[..., 2, :]
    zoom = z / points[..., 2, :]
    is_in_view = (zoom > 1.0 / _MAX_ZOOM) & (zoom < _MAX_ZOOM)
    # The limits of the image times z, which is positive where the zoom is right.
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    is_in_view &= (u >= 0.0) & (u < camera.width * z) & (v >= 0.0) & (v < camera.height * z)
    n_in_view = np.count_nonzero(is_in_view, axis=-1)
    return np.asarray(n_in_view / max(points.shape[-1], 1))


def link_keyframes(
    measure: Callable[[int, FloatArray], Edge | None],
    scores: Mapping[int, float],
    T_frame_keyframes: Mapping[int, FloatArray],
    step: RawStep,
    config: WindowConfig,
    *,
    n_unasked: Mapping[int, int],
) -> list[Edge]:
    """Register a frame against the keyframes that add information to its steps.

    Where the step was not registered, or its velocity is not steady, or no link confirms it,
    spare keyframes are tried one by one until a link does.

    Parameters
    ----------
    measure : callable
        Returns the edge from a keyframe, by its stamp and the predicted T_keyframe_frame; None
        where the registration fails.
    scores : mapping of int to float
        What keyframes have in common with the frame, by stamp, oldest first.
    T_frame_keyframes : mapping of int to ndarray of float64, shape (4, 4)
        Their poses, as predicted by the step.
    step : RawStep
        Of the frame.
    config : WindowConfig
    n_unasked : mapping of int to int
        See `Keyframes.n_unasked`.
    """
    chosen, spare = choose_links(scores, config, n_unasked=n_unasked, exclude=step.reference_ns)
    if not chosen and step.is_registered and step.is_steady:
        spare = []
    links: list[Edge] = []
    is_confirmed = False
    for index, stamp_ns in enumerate([*chosen, *spare]):
        if is_confirmed and index >= len(chosen):
            break
        T_keyframe_frame = se3.invert(T_frame_keyframes[stamp_ns])
        link = measure(stamp_ns, T_keyframe_frame)
        if link is not None:
            links.append(link)
            is_confirmed = is_confirmed or _confirms(link, T_keyframe_frame, step, config)
    return links


def _confirms(
    link: Edge, T_keyframe_frame: FloatArray, step: RawStep, config: WindowConfig
) -> bool:
    """Tell whether a link agrees with the step that its prediction comes from.

    The drift of the window's poses counts against the step too: then another keyframe is tried
    in vain, which is better than one not tried.
    """
    if not step.is_registered:
        return False
    gate = config.gate
    return gate is None or not disagreement(link, T_keyframe_frame, step.covariance, gate=gate)


def judge_links(
    offered: Sequence[tuple[LinkKind, Edge]], frame_id: int, window: SlidingWindow
) -> tuple[FrameLink, ...]:
    """Compare the edges of the newest frame with the poses of the window.

    Parameters
    ----------
    offered : sequence of (kind, Edge)
        As they were offered to the window; frames are named by their stamps.
    frame_id : int
        The newest frame.
    window : SlidingWindow
        After it took the frame.
    """
    accepted = {id(edge) for edge in window.edges(frame_id)}
    is_there = frame_id in window
    return tuple(
        FrameLink(
            reference_ns=int(edge.reference_id),  # type: ignore[call-overload]
            kind=kind,
            chi2=chi2(edge, se3.invert(window.pose(edge.reference_id)) @ window.pose(frame_id))
            if is_there and edge.reference_id in window
            else None,
            is_accepted=id(edge) in accepted,
        )
        for kind, edge in offered
    )


def misclosure(link: Edge, start: Estimate, end: Estimate) -> float:
    """Return the squared misclosure of a link and the steps since, per degree of freedom.

    Parameters
    ----------
    link : Edge
        From the keyframe to the frame.
    start, end : Estimate
        Keyframe and frame by the chain of steps.

    Returns
    -------
    float
        In sigmas of both; NaN where the covariances of the chain are too large to be subtracted.
    """
    T_start_end = se3.invert(start.T_world_frame) @ end.T_world_frame
    moved = se3.transport_covariance(start.covariance, se3.invert(T_start_end))
    covariance = link.covariance + end.covariance - moved
    residual = se3.log(se3.invert(link.T_reference_frame) @ T_start_end)
    _, solved, info = dposv(covariance, residual)
    return float(residual @ solved) / len(residual) if info == 0 else math.nan
