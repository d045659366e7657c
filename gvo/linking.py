"""The registrations of a frame against keyframes: those that say more than its steps do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from gvo.backend.gating import disagreement
from gvo.chain import RawStep
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.keyframe_policy import choose_links
from gvo.types import Edge, FloatArray

# Over so many steps the sum of their noise stays below that of a link, which sees the current
# frame through the same noisy pixels as the last step.
_N_TIED = 4


def tie(tied_ns: Sequence[int], step: RawStep) -> list[int]:
    """Return the frames that a few registered steps tie to the current one, newest last.

    Parameters
    ----------
    tied_ns : sequence of int
        Those of the frame before.
    step : RawStep
        To the current frame.
    """
    if step.reference_ns is None or not step.is_registered:
        return []
    return [*tied_ns, step.reference_ns][-_N_TIED:]


def link_keyframes(
    measure: Callable[[int, FloatArray], Edge | None],
    scores: Mapping[int, float],
    T_frame_keyframes: Mapping[int, FloatArray],
    step: RawStep,
    config: WindowConfig,
    *,
    tied_ns: Sequence[int],
) -> list[Edge]:
    """Register a frame against keyframes; more of them where the first do not bear out its step.

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
    tied_ns : sequence of int
        Frames that a few registered steps tie to it.
    """
    chosen, spare = choose_links(scores, config, exclude=step.reference_ns, tied=tied_ns)
    predicted = {ns: se3.invert(T_frame_keyframes[ns]) for ns in [*chosen, *spare]}
    links = {ns: measure(ns, predicted[ns]) for ns in chosen}
    if not any(_bears_out(link, predicted[ns], step, config) for ns, link in links.items()):
        links |= {ns: measure(ns, predicted[ns]) for ns in spare}
    return [link for link in links.values() if link is not None]


def _bears_out(
    link: Edge | None, T_keyframe_frame: FloatArray, step: RawStep, config: WindowConfig
) -> bool:
    """Tell whether a link agrees with the step that its prediction comes from."""
    if link is None or not step.is_registered:
        return False
    return config.gate is None or not disagreement(
        link, T_keyframe_frame, step.covariance, gate=config.gate
    )
