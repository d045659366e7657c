"""The kept frames, and the links to them that come with a new frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from scipy.linalg.lapack import dposv

from gvo.backend.gating import disagreement
from gvo.backend.keyframe_policy import LINK_GAIN, MIN_OVERLAP, choose_links, proximity
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


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe(Generic[ObservationsT]):
    """A kept frame.

    Parameters
    ----------
    observations
    points_cam : ndarray of float64, shape (64, 3), or None
        A sample of its points, metres; None where the front-end tells none.
    asked_at, seen_at : int
        Numbers of steps at which it was asked for a link last, and in view last.
    is_linked : bool
        Its last registration succeeded.
    start : Estimate or None
        By the raw chain, if that was not broken since.
    """

    observations: ObservationsT
    points_cam: FloatArray | None
    asked_at: int
    seen_at: int
    is_linked: bool = True
    start: Estimate | None = None


class Keyframes(Generic[ObservationsT]):
    """The kept frames and their scores, by which the policy chooses.

    Where the observations hold `points_cam` and the camera is known, the score of a keyframe is
    the share of its points in view of the current frame; else the proximity of the poses.

    Parameters
    ----------
    camera : StereoCamera or None
    config : WindowConfig
        Distance and angle of the proximity.

    Attributes
    ----------
    kept : dict of int to Keyframe
        By stamp, oldest first.
    """

    def __init__(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        self.camera, self.config = camera, config
        self.kept: dict[int, Keyframe[ObservationsT]] = {}

    def __contains__(self, stamp_ns: object) -> bool:
        """Tell whether a frame is kept."""
        return stamp_ns in self.kept

    def add(
        self, observations: ObservationsT, *, n_steps: int = 0, start: Estimate | None = None
    ) -> None:
        """Keep a frame."""
        points = observations.points_cam if isinstance(observations, HasPoints) else None
        self.kept[observations.stamp_ns] = Keyframe(
            observations=observations,
            points_cam=None if points is None else _sample_points(points),
            asked_at=n_steps,
            seen_at=n_steps,
            start=start,
        )

    def scores(
        self, T_current_keyframes: Mapping[int, FloatArray], n_steps: int
    ) -> dict[int, float]:
        """Return how much the current frame has in common with keyframes, 0 to 1.

        Parameters
        ----------
        T_current_keyframes : mapping of int to ndarray of float64, shape (4, 4)
            By stamp of the keyframe.
        n_steps : int
            The present step, at which those that have enough in common are in view.
        """
        if not T_current_keyframes:
            return {}
        poses = list(T_current_keyframes.values())
        samples = [self.kept[stamp_ns].points_cam for stamp_ns in T_current_keyframes]
        known = [points for points in samples if points is not None]
        if self.camera is None or len(known) < len(samples):
            found = [proximity(T, self.config) for T in poses]
        else:
            found = view_overlap(np.stack(known), np.stack(poses), self.camera).tolist()
        scores = dict(zip(T_current_keyframes, found, strict=True))
        for stamp_ns, score in scores.items():
            if score >= MIN_OVERLAP:
                self.kept[stamp_ns].seen_at = n_steps
        return scores


def _sample_points(points_cam: FloatArray) -> FloatArray:
    """Return 64 of the points (n, 3), some of them twice if they are fewer."""
    if len(points_cam) == 0:
        return np.full((_N_SAMPLES, 3), np.nan)  # never in view
    return points_cam[np.linspace(0, len(points_cam) - 1, _N_SAMPLES).astype(np.int64)]


def view_overlap(
    points_keyframe: FloatArray, T_current_keyframe: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return which share of points is in view of another camera, at about the same distance.

    Parameters
    ----------
    points_keyframe : ndarray of float64, shape (..., n, 3)
        In the keyframe, metres.
    T_current_keyframe : ndarray of float64, shape (..., 4, 4)
    camera : StereoCamera

    Returns
    -------
    ndarray of float64, shape (...)
    """
    T, points = T_current_keyframe, np.swapaxes(points_keyframe, -1, -2)
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
    min_gain: float = LINK_GAIN,
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
        Steps since each keyframe was asked for a link, or kept.
    min_gain : float
        See `choose_links`.
    """
    before_ns = None if step.edge is None else step.edge.reference_id
    chosen, spare = choose_links(
        scores, config, n_unasked=n_unasked, exclude=before_ns, min_gain=min_gain
    )
    if not chosen and step.failure is None and step.is_steady:
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
    if step.edge is None or step.failure is not None:
        return False
    gate, covariance = config.gate, step.edge.covariance
    return gate is None or not disagreement(link, T_keyframe_frame, covariance, gate=gate)


def judge_links(
    offered: Sequence[tuple[LinkKind, Edge]], frame_id: int, window: SlidingWindow
) -> tuple[FrameLink, ...]:
    """Compare the edges of the newest frame, as they were offered, with the poses of the window."""
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
