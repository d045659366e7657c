"""The edges that came with a frame, and how well the window's poses fit them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.geometry import se3
from gvo.types import Edge

LinkKind: TypeAlias = Literal["step", "keyframe", "standstill"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameLink:
    """An edge from an earlier frame to the newest one, after the window took it.

    Parameters
    ----------
    reference_ns : int
        Stamp of the earlier frame.
    kind : {"step", "keyframe", "standstill"}
        To the frame that the raw chain goes on from, to a keyframe, or without motion.
    chi2 : float or None
        Squared norm of the whitened residual, of 6 degrees of freedom: about 6 where the stated
        covariances are right; None where the earlier frame left the window with the update.
    is_accepted : bool
        False where the window refused the edge.
    """

    reference_ns: int
    kind: LinkKind
    chi2: float | None
    is_accepted: bool


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
    return float(residual @ np.linalg.solve(edge.covariance, residual))
