"""The kept frames, and the links to them that come with a new frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Generic

import numpy as np

from gvo.backend.gating import disagreement
from gvo.backend.keyframe_policy import choose_links, proximity
from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.frontend.protocol import ObservationsT
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.odometry.chain import RawStep
from gvo.types import Edge, FloatArray, FrameLink, LinkKind

# Enough to tell the share in view to a few percent.
_N_SAMPLES = 64
# Beyond this ratio of depths a point of one image size is not found again.
_MAX_ZOOM = 1.6


class Keyframes(Generic[ObservationsT]):
    """The kept frames and the scores by which the policy judges them.

    Where the observations hold `points_cam` and the camera is known, the score of a keyframe is
    the share of its points that the current frame sees; else it is the proximity of the poses.

    Parameters
    ----------
    camera : StereoCamera or None
    config : WindowConfig
        Distance and angle of the proximity.
    """

    def __init__(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        self._camera = camera
        self._config = config
        self._kept: dict[int, ObservationsT] = {}
        self._samples: dict[int, FloatArray | None] = {}

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the kept frames, oldest first."""
        return list(self._kept)

    def __getitem__(self, stamp_ns: int) -> ObservationsT:
        """Return the observations of a kept frame."""
        return self._kept[stamp_ns]

    def __len__(self) -> int:
        """Return the number of kept frames."""
        return len(self._kept)

    def reconfigure(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        """Score with another camera or configuration from now on; what is kept stays."""
        self._camera = camera
        self._config = config

    def add(self, observations: ObservationsT) -> None:
        """Keep a frame; of one that is kept already, other observations of it."""
        self._kept[observations.stamp_ns] = observations
        points = getattr(observations, "points_cam", None)
        self._samples[observations.stamp_ns] = None if points is None else _sample_points(points)

    def drop(self, stamp_ns: int) -> None:
        """Forget a kept frame."""
        del self._kept[stamp_ns], self._samples[stamp_ns]

    def scores(self, T_current_keyframe: Mapping[int, FloatArray]) -> dict[int, float]:
        """Return how much the current frame has in common with keyframes, 0 to 1.

        Parameters
        ----------
        T_current_keyframe : mapping of int to ndarray of float64, shape (4, 4)
            By stamp of the keyframe.
        """
        return {stamp_ns: self._score(stamp_ns, T) for stamp_ns, T in T_current_keyframe.items()}

    def _score(self, stamp_ns: int, T_current_keyframe: FloatArray) -> float:
        points = self._samples[stamp_ns]
        if points is None or self._camera is None:
            return proximity(T_current_keyframe, self._config)
        return _overlap(points, T_current_keyframe, self._camera)


def _sample_points(points_cam: FloatArray) -> FloatArray:
    """Return so many of n points, shape (n, 3), as tell the share in view; of these, all."""
    n = len(points_cam)
    chosen = np.linspace(0, n - 1, min(_N_SAMPLES, n))
    return points_cam[chosen.astype(np.int64)]


def _overlap(
    points_keyframe: FloatArray, T_current_keyframe: FloatArray, camera: StereoCamera
) -> float:
    """Return the share of points that another camera sees, at about the same distance."""
    if len(points_keyframe) == 0:
        return 0.0
    T = T_current_keyframe
    x, y, z = T[:3, :3] @ points_keyframe.T + T[:3, 3:]
    zoom = z / points_keyframe[:, 2]
    is_in_view = (zoom > 1.0 / _MAX_ZOOM) & (zoom < _MAX_ZOOM)
    # The limits of the image times z, which is positive where the zoom is right.
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    is_in_view &= (u >= 0.0) & (u < camera.width * z) & (v >= 0.0) & (v < camera.height * z)
    return float(np.count_nonzero(is_in_view)) / len(points_keyframe)


# Registered steps whose errors add up to that of a step which only goes on as before.
_N_UNKNOWN = 1000


def count_steps(step: RawStep, n_steps: Mapping[int, int]) -> int:
    """Return over how many registered steps the errors of the chain have added up.

    Parameters
    ----------
    step : RawStep
        To the current frame.
    n_steps : mapping of int to int
        The same of earlier frames, by stamp; of that which the step starts from at least.
    """
    if step.reference_ns is None:
        return 0
    return n_steps[step.reference_ns] + (1 if step.is_registered else _N_UNKNOWN)


def link_keyframes(
    measure: Callable[[int, FloatArray], Edge | None],
    scores: Mapping[int, float],
    T_frame_keyframes: Mapping[int, FloatArray],
    step: RawStep,
    config: WindowConfig,
    *,
    n_steps: Mapping[int, int],
) -> list[Edge]:
    """Register a frame against keyframes that tell more than its steps do.

    Where the step was not registered, or changes the velocity as never before, or none of these
    keyframes bears it out, others are asked, one after the other until one does.

    Parameters
    ----------
    measure : callable
        Returns the edge from a keyframe, by its stamp and the predicted T_keyframe_frame; None
        where it cannot be registered.
    scores : mapping of int to float
        What keyframes have in common with the frame, by stamp, oldest first.
    T_frame_keyframes : mapping of int to ndarray of float64, shape (4, 4)
        Their poses, as the step predicts them.
    step : RawStep
        Of the frame.
    config : WindowConfig
    n_steps : mapping of int to int
        Steps since each keyframe.
    """
    chosen, spare = choose_links(scores, config, n_steps=n_steps, exclude=step.reference_ns)
    predicted = {ns: se3.invert(T_frame_keyframes[ns]) for ns in [*chosen, *spare]}
    links = [measure(ns, predicted[ns]) for ns in chosen]
    is_borne_out = any(
        _bears_out(link, predicted[ns], step, config)
        for ns, link in zip(chosen, links, strict=True)
    )
    if not chosen and step.is_registered and step.is_steady:
        spare = []
    for ns in spare:
        if is_borne_out:
            break
        links.append(measure(ns, predicted[ns]))
        is_borne_out = _bears_out(links[-1], predicted[ns], step, config)
    return [link for link in links if link is not None]


def _bears_out(
    link: Edge | None, T_keyframe_frame: FloatArray, step: RawStep, config: WindowConfig
) -> bool:
    """Tell whether a link agrees with the step that its prediction comes from.

    What the poses of the window have drifted since counts against the step too: then another
    keyframe is asked for nothing, which is better than that one is not asked.
    """
    if link is None or not step.is_registered:
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
    known = [edge for _, edge in offered if is_there and edge.reference_id in window]
    chi2 = {id(edge): _chi2(edge, frame_id, window) for edge in known}
    return tuple(
        FrameLink(
            reference_ns=int(edge.reference_id),  # type: ignore[call-overload]
            kind=kind,
            chi2=chi2.get(id(edge)),
            is_accepted=id(edge) in accepted,
        )
        for kind, edge in offered
    )


def _chi2(edge: Edge, frame_id: int, window: SlidingWindow) -> float:
    T_reference_frame = se3.invert(window.pose(edge.reference_id)) @ window.pose(frame_id)
    residual = se3.log(se3.invert(edge.T_reference_frame) @ T_reference_frame)
    return float(se3.mahalanobis(residual, edge.covariance))
