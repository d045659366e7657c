"""Which frames are kept, linked and released, decided by scores of nearness alone.

A score tells how much the current frame has in common with a kept one: 1 at the same place, 0
far away. It is the share of the view that they have in common where points are known
(`gvo.keyframes`), else `proximity`. All scores come by frame, the oldest first.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
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
    exclude: Hashable = None,
    tied: Collection[Hashable] = (),
) -> tuple[list[_Id], list[_Id]]:
    """Choose the kept frames to register the current frame against.

    Half of them are the oldest that still have enough in common with it: these hold the drift.
    The others have the most in common. A link of these pays only where it says more than the
    steps do, which are known already: over many steps, and over most of the view.

    Parameters
    ----------
    scores : mapping of frame to float
        Oldest first.
    config : WindowConfig
        `n_links`, of which one goes to the predecessor, `min_overlap` and `link_overlap`.
    exclude : hashable
        The predecessor.
    tied : collection of hashable
        Frames that a few registered steps tie to the current one.

    Returns
    -------
    chosen : list of frames
    spare : list of frames
        Those that fill up the number, for where the chosen do not bear out the steps.
    """
    n = config.n_links - 1
    usable = [
        frame for frame, score in scores.items() if score >= config.min_overlap and frame != exclude
    ]
    n_by_age = (n + 1) // 2
    nearest = sorted(usable[n_by_age:], key=lambda frame: -scores[frame])
    telling = [
        frame for frame in nearest if scores[frame] >= config.link_overlap and frame not in tied
    ]
    chosen = (usable[:n_by_age] + telling)[:n]
    return chosen, [frame for frame in nearest if frame not in chosen][: n - len(chosen)]


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
