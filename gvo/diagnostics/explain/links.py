"""What earlier frames contributed to the pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gvo.diagnostics.explain.values import KeyframeLink
from gvo.diagnostics.explain.watch import Registration
from gvo.frontend.klt import image_of
from gvo.frontend.protocol import Stamped
from gvo.geometry import se3
from gvo.odometry.keyframes import Keyframes
from gvo.types import Failure, FloatArray, Frame, FrameLink, FrameResult, RelativePose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Before:
    """What was known when the frame came.

    Parameters
    ----------
    T_world_frames : mapping of int to ndarray of float64, shape (4, 4)
        The window's poses by stamp.
    keyframes : Keyframes
    frames : mapping of int to Frame
        The frames that may be linked, by stamp.
    indices : mapping of int to int
        Of all frames, by stamp.
    previous : FrameResult or None
        Of the frame before.
    min_overlap : float
        `window.min_overlap`.
    """

    T_world_frames: Mapping[int, FloatArray]
    keyframes: Keyframes[Stamped]
    frames: Mapping[int, Frame]
    indices: Mapping[int, int]
    previous: FrameResult | None
    min_overlap: float

    def scores(self, result: FrameResult, chain: Registration | None) -> dict[int, float]:
        """Return the view overlap of the keyframes, by stamp, as the odometry scores them."""
        if self.previous is None:
            return {}
        if isinstance(result.registration, RelativePose) and chain is not None:
            reference_ns, T_step = chain.reference_ns, result.registration.T_reference_current
        else:
            reference_ns = self.previous.stamp_ns
            T_step = se3.invert(self.previous.raw.T_world_cam) @ result.raw.T_world_cam
        if reference_ns not in self.T_world_frames:
            return {}
        T_frame_world = se3.invert(self.T_world_frames[reference_ns] @ T_step)
        return self.keyframes.scores(
            {
                ns: T_frame_world @ self.T_world_frames[ns]
                for ns in self.keyframes.stamps_ns
                if ns in self.T_world_frames
            }
        )


def explain_links(
    calls: Sequence[Registration], n_chain: int, result: FrameResult, before: Before
) -> tuple[KeyframeLink, ...]:
    """Tell of each earlier frame what it contributed.

    Parameters
    ----------
    calls : sequence of Registration
        All of the frame.
    n_chain : int
        How many of them were the raw chain's.
    result : FrameResult
    before : Before
    """
    chain = calls[n_chain - 1] if n_chain else None
    scores = before.scores(result, chain)
    tried = {call.reference_ns: call.result for call in calls[n_chain:]}
    links: list[KeyframeLink] = []
    for link in result.links:
        if link.kind != "keyframe":
            links.append(_step(link, result, before, scores))
    step_ns = {link.reference_ns for link in links}
    for ns in sorted({*scores, *tried}):
        offered = next(
            (each for each in result.links if each.kind == "keyframe" and each.reference_ns == ns),
            None,
        )
        if offered is None and ns not in tried and ns in step_ns:
            continue  # the predecessor, which is linked by the step
        links.append(_keyframe(ns, tried.get(ns), offered, result, before, scores.get(ns)))
    return tuple(links)


def _step(
    link: FrameLink, result: FrameResult, before: Before, scores: Mapping[int, float]
) -> KeyframeLink:
    ns = link.reference_ns
    return KeyframeLink(
        reference_ns=ns,
        index=before.indices[ns],
        kind=link.kind,
        image=image_of(before.frames[ns]),
        score=scores.get(ns),
        registration=result.registration,
        chi2=link.chi2,
        is_accepted=link.is_accepted,
        reason=_refusal(ns, result) if not link.is_accepted else "",
    )


def _keyframe(
    ns: int,
    registration: RelativePose | Failure | None,
    offered: FrameLink | None,
    result: FrameResult,
    before: Before,
    score: float | None,
) -> KeyframeLink:
    is_accepted = offered is not None and offered.is_accepted
    reason = "" if is_accepted else "steps, or other keyframes, tell as much"
    if score is not None and score < before.min_overlap:
        reason = "too little overlap"
    if isinstance(registration, Failure):
        reason = registration.reason
    elif offered is not None and not is_accepted:
        reason = _refusal(ns, result)
    return KeyframeLink(
        reference_ns=ns,
        index=before.indices[ns],
        kind="keyframe" if registration is not None else "not linked",
        image=image_of(before.frames[ns]),
        score=score,
        registration=registration,
        chi2=None if offered is None else offered.chi2,
        is_accepted=is_accepted,
        reason=reason,
    )


def _refusal(ns: int, result: FrameResult) -> str:
    reasons = [each.reason for each in result.causal.rejected if each.reference_id == ns]
    return reasons[0] if reasons else "the window did not take it"
