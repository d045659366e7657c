"""The registrations of a frame against keyframes: those that say more than its steps do."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gvo.backend.gating import disagreement
from gvo.chain import RawStep
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.keyframe_policy import choose_links
from gvo.types import Edge, FloatArray

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
