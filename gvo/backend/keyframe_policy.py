"""Which frames become keyframes, are linked and released, by scores alone.

A score tells how much the current frame has in common with a keyframe: 1 at the same place, 0
far away. It is the overlap of their views if points are known
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

LINK_GAIN = 2.0
"""Least number of steps since a keyframe was asked, times its score, at which it is linked: more
links to the same keyframe would repeat its errors."""
MIN_OVERLAP = 0.2
"""Least score of a keyframe that is linked: of views that share less, few corners are found."""
KEYFRAME_OVERLAP = 0.9
"""Largest score with every keyframe at which a frame becomes one: nine tenths in common say all."""


def proximity(T_a_b: FloatArray, config: WindowConfig) -> float:
    """Score how near two poses are, without knowledge of the view.

    Parameters
    ----------
    T_a_b : ndarray of float64, shape (4, 4)
        Pose of one in the other, metres.
    config : WindowConfig
        `keyframe_distance_m` and `keyframe_angle_deg`.

    Returns
    -------
    float
        1 at the same place, falling linearly to `KEYFRAME_OVERLAP` at the distance or the angle
        of a keyframe, whichever is reached first, and on to 0.

    Examples
    --------
    >>> T = np.eye(4)
    >>> T[2, 3] = 2.0
    >>> round(proximity(T, WindowConfig(keyframe_distance_m=1.0)), 6)
    0.8
    """
    distance_ratio = float(np.linalg.norm(T_a_b[:3, 3])) / config.keyframe_distance_m
    angle_ratio = float(se3.rotation_angle(T_a_b)) / np.radians(config.keyframe_angle_deg)
    ratio = max(distance_ratio, float(angle_ratio))
    return max(1.0 - (1.0 - KEYFRAME_OVERLAP) * ratio, 0.0)


def is_needed(scores: Mapping[_Id, float]) -> bool:
    """Tell whether the current frame should become a keyframe."""
    return max(scores.values(), default=0.0) < KEYFRAME_OVERLAP


def choose_links(
    scores: Mapping[_Id, float],
    config: WindowConfig,
    *,
    n_unasked: Mapping[_Id, int],
    exclude: Hashable = None,
    min_gain: float = LINK_GAIN,
) -> tuple[list[_Id], list[_Id]]:
    """Choose the keyframes to register the current frame against.

    A link adds what has become uncertain since the last one: the errors of steps accumulate with
    their number, and what is seen of it grows with the overlap. The product has to be at least
    `min_gain`; the largest come first. One that could not be registered waits for its next turn.

    Parameters
    ----------
    scores : mapping of frame to float
        Oldest first.
    config : WindowConfig
        `n_links`, of which one goes to the predecessor.
    n_unasked : mapping of frame to int
        Steps since each was asked last, or since it itself.
    exclude : hashable
        The predecessor.
    min_gain : float

    Returns
    -------
    chosen : list of frames
    spare : list of frames
        More of them up to `n_links`, highest score first, to check doubtful steps.
    """
    n = config.n_links - 1
    usable = [frame for frame, score in scores.items() if score >= MIN_OVERLAP and frame != exclude]
    gains = {frame: n_unasked[frame] * scores[frame] for frame in usable}
    telling = [frame for frame in usable if gains[frame] >= min_gain]
    chosen = sorted(telling, key=lambda frame: -gains[frame])[:n]
    rest = [frame for frame in usable if frame not in chosen]
    return chosen, sorted(rest, key=lambda frame: -scores[frame])[: n - len(chosen)]


def choose_unseen(
    scores: Mapping[_Id, float], seen_at: Mapping[_Id, int], n_released: int
) -> list[_Id]:
    """Choose keyframes of a map to release: those that were in view least recently.

    Of several that were in view at the same time, those with the lowest scores. So places are
    kept to come back to, as many as there is room for.

    Parameters
    ----------
    scores : mapping of frame to float
        Of those that may be released.
    seen_at : mapping of frame to int
        Number of the step at which each was in view last.
    n_released : int
    """
    return sorted(scores, key=lambda frame: (seen_at[frame], scores[frame]))[:n_released]


def choose_released(scores: Mapping[_Id, float], config: WindowConfig, *, n_kept: int) -> list[_Id]:
    """Choose the keyframes to release: too little overlap, and the lowest scores above the number.

    Parameters
    ----------
    scores : mapping of frame to float
        Oldest first.
    config : WindowConfig
        `n_keyframes`.
    n_kept : int
        Number of keyframes, including the current one if it is one: it has no score, and is not
        released.
    """
    far = [frame for frame, score in scores.items() if score < MIN_OVERLAP]
    near = [frame for frame, score in scores.items() if score >= MIN_OVERLAP]
    n_over = max(n_kept - len(far) - config.n_keyframes, 0)
    return far + sorted(near, key=lambda frame: scores[frame])[:n_over]
