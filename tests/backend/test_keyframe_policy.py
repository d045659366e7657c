"""The policy of keyframes over scores."""

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.backend.keyframe_policy import (
    MIN_OVERLAP,
    choose_links,
    choose_released,
    choose_unseen,
    is_needed,
    proximity,
)
from gvo.config import WindowConfig
from gvo.geometry import se3

twists = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


def configure(**changes: Any) -> WindowConfig:
    values = {
        "n_keyframes": 3,
        "n_links": 3,
        "keyframe_distance_m": 2.0,
        "keyframe_angle_deg": 20.0,
    }
    return WindowConfig.model_validate(values | changes)


def moved(distance_m: float, angle_deg: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    T = se3.exp(np.radians([0.0, angle_deg, 0.0, 0.0, 0.0, 0.0]))
    T[:3, 3] = np.array([0.6, 0.0, -0.8]) * distance_m
    return T


@pytest.mark.parametrize(
    ("distance_m", "angle_deg", "score"),
    [
        (0.0, 0.0, 1.0),
        (2.0, 0.0, 0.9),
        (0.0, 20.0, 0.9),
        (2.0, 20.0, 0.9),
        (1.0, 20.0, 0.9),
        (2.0, 5.0, 0.9),
        (1.0, 5.0, 0.95),
        (4.0, 0.0, 0.8),
        (20.0, 0.0, 0.0),
        (80.0, 0.0, 0.0),
        (0.0, 170.0, 0.15),
    ],
)
def test_the_score_falls_linearly_with_the_larger_ratio(
    distance_m: float, angle_deg: float, score: float
) -> None:
    assert proximity(moved(distance_m, angle_deg), configure()) == pytest.approx(score, abs=1e-9)


@given(twist=twists)
def test_two_poses_are_as_near_from_either_side(twist: np.ndarray[Any, Any]) -> None:
    T = se3.exp(twist)
    there, back = proximity(T, configure()), proximity(se3.invert(T), configure())
    assert there == pytest.approx(back, abs=1e-9)
    assert 0.0 <= there <= 1.0


@pytest.mark.parametrize(
    ("scores", "expected"),
    [({}, True), ({1: 0.89}, True), ({1: 0.2, 2: 0.91}, False), ({1: 0.9}, False)],
)
def test_a_keyframe_is_needed_far_from_others(scores: dict[int, float], expected: bool) -> None:
    assert is_needed(scores) == expected


def choose(
    scores: Mapping[Any, float], n_steps: int = 100, *, exclude: Hashable = None, **changes: Any
) -> tuple[list[Any], list[Any]]:
    unlinked = dict.fromkeys(scores, n_steps)
    return choose_links(scores, configure(**changes), n_unasked=unlinked, exclude=exclude)


def test_of_keyframes_linked_as_long_ago_those_most_in_view_are_linked() -> None:
    scores = {5: 0.1, 10: 0.4, 20: 0.9, 30: 0.5, 40: 0.95, 50: 0.99}
    assert choose(scores, n_links=3, exclude=50) == ([40, 20], [])
    assert choose(scores, n_links=5, exclude=50) == ([40, 20, 30, 10], [])
    assert choose(scores, n_links=3) == ([50, 40], [])
    assert choose(scores, n_links=1, exclude=50) == ([], [])
    assert choose({}, n_links=3, exclude=0) == ([], [])


def test_links_go_where_many_unlinked_steps_or_many_points_lie_between() -> None:
    scores = {10: 0.4, 20: 0.5, 30: 0.9}
    # Of products of 2 and more the two largest.
    for unlinked, expected in (
        ({10: 8, 20: 5, 30: 2}, ([10, 20], [])),
        ({10: 8, 20: 4, 30: 2}, ([10, 20], [])),
        ({10: 8, 20: 3, 30: 2}, ([10], [30])),
        ({10: 4, 20: 3, 30: 2}, ([], [30, 20])),
    ):
        assert choose_links(scores, configure(), n_unasked=unlinked) == expected


def test_those_seen_least_recently_are_released_and_of_these_the_least_in_view() -> None:
    scores = {1: 0.9, 2: 0.0, 3: 0.1, 4: 0.2}
    seen_at = {1: 12, 2: 5, 3: 0, 4: 5}
    assert choose_unseen(scores, seen_at, 0) == []
    assert choose_unseen(scores, seen_at, 3) == [3, 2, 4]


@given(
    scores=st.dictionaries(st.integers(0, 50), st.floats(0.0, 1.0), max_size=12),
    n_links=st.integers(1, 8),
    exclude=st.integers(0, 50),
    n_steps=st.integers(1, 20),
)
def test_links_are_near_once_each_and_not_to_the_predecessor(
    scores: dict[int, float], n_links: int, exclude: int, n_steps: int
) -> None:
    chosen, spare = choose(scores, n_steps, n_links=n_links, exclude=exclude)
    usable = {frame for frame, score in scores.items() if score >= MIN_OVERLAP} - {exclude}
    assert len(chosen + spare) == len({*chosen, *spare}) == min(n_links - 1, len(usable))
    assert {*chosen, *spare} <= usable
    assert all(n_steps * scores[frame] >= 2.0 for frame in chosen)
    worth_it = [frame for frame in usable if n_steps * scores[frame] >= 2.0]
    assert len(chosen) == min(n_links - 1, len(worth_it))


@given(
    shares=st.lists(st.floats(0.0, 1.0), max_size=8),
    n_keyframes=st.integers(0, 6),
    n_new=st.integers(0, 1),
)
def test_far_and_surplus_are_released(shares: list[float], n_keyframes: int, n_new: int) -> None:
    scores = dict(enumerate(shares))
    released = choose_released(
        scores, configure(n_keyframes=n_keyframes), n_kept=len(scores) + n_new
    )
    assert len(released) == len(set(released))
    remaining = {frame: score for frame, score in scores.items() if frame not in released}
    assert all(score >= MIN_OVERLAP for score in remaining.values())
    n_near = sum(score >= MIN_OVERLAP for score in shares)
    assert len(remaining) == min(n_near, max(n_keyframes - n_new, 0))
    near_released = [scores[frame] for frame in released if scores[frame] >= MIN_OVERLAP]
    assert max(near_released, default=0.0) <= min(remaining.values(), default=1.0)


def test_the_newest_keyframe_counts_but_is_not_released_at_once() -> None:
    assert choose_released({1: 0.5, 2: 0.4, 3: 0.6}, configure(n_keyframes=3), n_kept=4) == [2]
