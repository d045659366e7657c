"""Which keyframes are kept, linked and released."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import WindowConfig
from gvo.geometry.camera import StereoCamera
from gvo.keyframes import Keyframes
from gvo.types import FloatArray, Observations

seeds = st.integers(min_value=0, max_value=2**32 - 1)
CAMERA = StereoCamera(fx=100.0, fy=100.0, cx=50.0, cy=40.0, width=100, height=80, baseline=0.1)


def observe(stamp_ns: int, points: FloatArray) -> Observations:
    n = len(points)
    return Observations(
        stamp_ns=stamp_ns,
        keypoints=np.zeros((n, 2)),
        disparities=np.ones(n),
        points_cam=points,
        sigmas=np.ones((n, 3)),
        descriptors_left=np.zeros((n, 32), dtype=np.uint8),
    )


def wall(n: int = 2000, depth: float = 4.0) -> FloatArray:
    """Return points of a wall that fills the image, in random order."""
    rng = np.random.default_rng(0)
    rays = CAMERA.unproject(rng.uniform([0, 0], [99, 79], (n, 2)))
    return np.asarray(depth * rays)


def keyframes(*stamps: int, **changes: Any) -> Keyframes:
    values = {
        "n_recent": 3,
        "n_keyframes": 3,
        "n_links": 3,
        "min_overlap": 0.3,
        "keyframe_overlap": 0.75,
    }
    kept = Keyframes(CAMERA, WindowConfig.model_validate(values | changes))
    for stamp in stamps:
        kept.add(observe(stamp, wall()))
    return kept


def shifted(dx: float = 0.0, dz: float = 0.0) -> FloatArray:
    T = np.eye(4)
    T[0, 3], T[2, 3] = dx, dz
    return T


@pytest.mark.parametrize("n", [40, 2000])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 0.9])
def test_the_overlap_is_the_share_of_the_points_still_in_view(share: float, n: int) -> None:
    # The image shows 4 m of a wall 4 m away, so that a shift of 4 m leaves nothing.
    kept = keyframes()
    points = wall(n)
    kept.add(observe(7, points))
    shift = 4.0 * (1.0 - share)
    overlaps = kept.overlaps({7: shifted(dx=shift)})
    assert list(overlaps) == [7]
    expected = np.mean(points[:, 0] + shift < 4.0 * 50 / 100)
    assert overlaps[7] == pytest.approx(expected, abs=1e-9 if n == 40 else 0.15)


def test_the_view_that_has_not_moved_overlaps_fully() -> None:
    assert keyframes(7).overlaps({7: np.eye(4)}) == {7: 1.0}


def test_points_behind_the_camera_are_not_in_view() -> None:
    assert keyframes(7).overlaps({7: np.diag([-1.0, 1.0, -1.0, 1.0])}) == {7: 0.0}
    assert keyframes(7).overlaps({7: shifted(dz=-5.0)}) == {7: 0.0}


def test_points_at_a_quite_other_distance_are_not_counted() -> None:
    assert keyframes(7).overlaps({7: shifted(dz=8.0)}) == {7: 0.0}  # thrice as far
    assert keyframes(7).overlaps({7: shifted(dz=0.4)})[7] > 0.9


def test_a_frame_without_points_overlaps_with_nothing() -> None:
    kept = keyframes()
    kept.add(observe(3, np.zeros((0, 3))))
    assert kept.overlaps({3: np.eye(4)}) == {3: 0.0}


def test_kept_frames_are_known_by_stamp_in_their_order() -> None:
    kept = keyframes(10, 20, 30)
    assert kept.stamps_ns == [10, 20, 30]
    assert kept[20].stamp_ns == 20
    kept.drop(20)
    assert kept.stamps_ns == [10, 30]
    with pytest.raises(KeyError):
        kept[20]


@pytest.mark.parametrize(
    ("overlaps", "is_needed"),
    [({}, True), ({1: 0.74}, True), ({1: 0.2, 2: 0.76}, False), ({1: 0.75}, False)],
)
def test_a_keyframe_is_needed_where_all_others_overlap_too_little(
    overlaps: dict[int, float], is_needed: bool
) -> None:
    assert keyframes().is_needed(overlaps) == is_needed


def test_links_go_to_the_oldest_and_to_the_most_seen() -> None:
    overlaps = {10: 0.4, 20: 0.9, 30: 0.5, 40: 0.95, 50: 0.99, 5: 0.1}
    kept = keyframes(n_links=3)
    assert sorted(kept.choose_links(overlaps, exclude=50)) == [10, 40]
    assert sorted(keyframes(n_links=5).choose_links(overlaps, exclude=50)) == [10, 20, 30, 40]
    assert keyframes(n_links=1).choose_links(overlaps, exclude=50) == []
    assert keyframes(n_links=3).choose_links({}, exclude=0) == []


@settings(deadline=None)
@given(
    overlaps=st.dictionaries(st.integers(0, 50), st.floats(0.0, 1.0), max_size=12),
    n_links=st.integers(1, 8),
    exclude=st.integers(0, 50),
)
def test_links_are_in_view_once_each_and_not_to_the_predecessor(
    overlaps: dict[int, float], n_links: int, exclude: int
) -> None:
    links = keyframes(n_links=n_links).choose_links(overlaps, exclude=exclude)
    usable = {stamp for stamp, share in overlaps.items() if share >= 0.3} - {exclude}
    assert len(links) == len(set(links)) == min(n_links - 1, len(usable))
    assert set(links) <= usable


@settings(deadline=None)
@given(shares=st.lists(st.floats(0.0, 1.0), max_size=8), n_keyframes=st.integers(0, 6))
def test_released_are_those_out_of_view_and_the_least_seen_beyond_the_limit(
    shares: list[float], n_keyframes: int
) -> None:
    overlaps = dict(enumerate(shares))
    kept = keyframes(*overlaps, n_keyframes=n_keyframes)
    released = kept.choose_released(overlaps)
    assert len(released) == len(set(released))
    remaining = {stamp: share for stamp, share in overlaps.items() if stamp not in released}
    assert all(share >= 0.3 for share in remaining.values())
    n_in_view = sum(share >= 0.3 for share in shares)
    assert len(remaining) == min(n_in_view, n_keyframes)
    in_view_released = [overlaps[stamp] for stamp in released if overlaps[stamp] >= 0.3]
    assert max(in_view_released, default=0.0) <= min(remaining.values(), default=1.0)


def test_the_newest_keyframe_counts_but_is_not_released_at_once() -> None:
    kept = keyframes(1, 2, 3, 4, n_keyframes=3)
    assert kept.choose_released({1: 0.5, 2: 0.4, 3: 0.6}) == [2]
