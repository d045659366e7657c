"""Which frames are kept, linked and released, decided by scores of nearness alone.

A score tells how much the current frame has in common with a kept one: 1 at the same place, 0
far away. It is the share of the view that they have in common where points are known
(`gvo.odometry.keyframes`), else `proximity`. All scores come by frame, the oldest first.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import TypeVar

import numpy as np

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import FloatArray

_Id = TypeVar("_Id", bound=Hashable)


def proximity(T_a_b: FloatArray, config: WindowConfig) -> float:
    """Score how near two poses are, where nothing is known of what is seen from them.

    Parameters
    ----------
    T_a_b : ndarray of float64, shape (4, 4)
        Pose of one in the other, metres.
    config : WindowConfig
        `keyframe_distance_m`, `keyframe_angle_deg` and `keyframe_overlap`.

    Returns
    -------
    float
        1 at the same place; `keyframe_overlap` at the distance or the turn of a keyframe, the
        larger of the two ratios counting; falling linearly, not below 0.

    Examples
    --------
    >>> T = np.eye(4)
    >>> T[2, 3] = 2.0
    >>> round(proximity(T, WindowConfig(keyframe_distance_m=1.0, keyframe_overlap=0.9)), 6)
    0.8
    """
    distance_ratio = float(np.linalg.norm(T_a_b[:3, 3])) / config.keyframe_distance_m
    angle_ratio = float(se3.rotation_angle(T_a_b)) / np.radians(config.keyframe_angle_deg)
    ratio = max(distance_ratio, float(angle_ratio))
    return max(1.0 - (1.0 - config.keyframe_overlap) * ratio, 0.0)


def is_needed(scores: Mapping[_Id, float], config: WindowConfig) -> bool:
    """Tell whether the current frame holds so much new that it should be kept."""
    return max(scores.values(), default=0.0) < config.keyframe_overlap


def choose_links(
    scores: Mapping[_Id, float],
    config: WindowConfig,
    *,
    n_steps: Mapping[_Id, int],
    exclude: Hashable = None,
) -> tuple[list[_Id], list[_Id]]:
    """Choose the kept frames to register the current frame against.

    Of those that are worth it, half are the oldest, which hold the drift, and the others have the
    most in common with it. What a link tells beyond the steps, which are known already, grows
    with the number of these, whose errors add up, and with the points that both frames see: the
    product has to be at least `link_gain`.

    Parameters
    ----------
    scores : mapping of frame to float
        Oldest first.
    config : WindowConfig
        `n_links`, of which one goes to the predecessor, `min_overlap` and `link_gain`.
    n_steps : mapping of frame to int
        Steps from each to the current frame.
    exclude : hashable
        The predecessor.

    Returns
    -------
    chosen : list of frames
    spare : list of frames
        Those that fill up the number, nearest first, for where the steps are in doubt.
    """
    n = config.n_links - 1
    usable = [
        frame for frame, score in scores.items() if score >= config.min_overlap and frame != exclude
    ]
    telling = [frame for frame in usable if n_steps[frame] * scores[frame] >= config.link_gain]
    by_age, others = telling[: (n + 1) // 2], telling[(n + 1) // 2 :]
    chosen = (by_age + _nearest_first(others, scores))[:n]
    rest = [frame for frame in usable if frame not in chosen]
    return chosen, _nearest_first(rest, scores)[: n - len(chosen)]


def _nearest_first(frames: list[_Id], scores: Mapping[_Id, float]) -> list[_Id]:
    return sorted(frames, key=lambda frame: -scores[frame])


def choose_released(scores: Mapping[_Id, float], config: WindowConfig, *, n_kept: int) -> list[_Id]:
    """Choose the kept frames to let go: too far off, and the farthest beyond the limit.

    Parameters
    ----------
    scores : mapping of frame to float
        Oldest first.
    config : WindowConfig
        `n_keyframes` and `min_overlap`.
    n_kept : int
        Number of kept frames, the current one included where it is kept: it has no score, and
        is not let go.
    """
    far = [frame for frame, score in scores.items() if score < config.min_overlap]
    near = [frame for frame, score in scores.items() if score >= config.min_overlap]
    n_over = max(n_kept - len(far) - config.n_keyframes, 0)
    return far + sorted(near, key=lambda frame: scores[frame])[:n_over]
