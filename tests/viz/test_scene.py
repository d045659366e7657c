"""What is drawn of a run, and what of it is kept."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.types import Estimate
from gvo.viz.scene import (
    History,
    Track,
    ellipsoids,
    matched_points,
    scene,
)
from tests.make.results import estimate_at, loop_of
from tests.viz.view.fakes import PERIOD_NS, pose_of, registration_of, result_of


def history_of(n: int) -> History:
    history = History()
    for index in range(n):
        history.add(result_of(index))
    return history


@given(st.lists(st.integers(0, 50), max_size=60))
def test_a_track_is_sorted_and_holds_the_last_pose_of_each_stamp(stamps_ns: list[int]) -> None:
    track, expected = Track(), {}
    for number, stamp_ns in enumerate(stamps_ns):
        track.add(estimate_at(stamp_ns, pose_of(number)))
        expected[stamp_ns] = float(number)
    found_ns, poses = track.path()
    assert found_ns.tolist() == sorted(expected)
    assert dict(zip(found_ns.tolist(), poses[:, 2].tolist(), strict=True)) == expected
    for stamp_ns in range(52):
        T, before = track.at(stamp_ns), track.before(stamp_ns)
        assert (T is None) == (stamp_ns not in expected)
        assert T is None or T[2, 3] == expected[stamp_ns]
        earlier = [ns for ns in expected if ns < stamp_ns]
        assert (None if before is None else before.stamp_ns) == max(earlier, default=None)


@given(st.integers(1, 60), st.integers(2, 20))
def test_a_thinned_path_keeps_its_poses_while_it_grows(n: int, n_most: int) -> None:
    track = Track()
    for stamp_ns in range(n):
        track.add(estimate_at(stamp_ns))
    shown = track.path(n_most)[0].tolist()
    assert len(shown) <= n_most
    assert (shown[0], shown[-1]) == (0, n - 1)
    track.add(estimate_at(n))
    later = track.path(n_most)[0].tolist()
    assert set(later[:-1]) <= {*shown, n - 1}


def test_a_scene_names_what_is_drawn() -> None:
    history = history_of(5)
    result = replace(result_of(5), loops=(loop_of(5 * PERIOD_NS, PERIOD_NS),))
    history.add(result)
    seen = scene(result, history)
    np.testing.assert_array_equal(seen.lines["step"][:, :, 2], [[4.0, 5.0]])
    np.testing.assert_array_equal(seen.lines["refused"][:, :, 2], [[0.0, 5.0]])
    np.testing.assert_array_equal(seen.lines["loops"][:, :, 2], [[5.0, 1.0]])
    assert (seen.counts["matches"], seen.counts["refused"], seen.counts["loops"]) == (105, 1, 1)
    assert seen.stage_ms == {"extract": 4.0, "window": 1.5}
    assert seen.chi2 == {"step": 6.0}
    assert seen.poses["causal"] is result.causal
    first = result_of(3)  # as where a run is joined: its links lead to frames that are not known
    alone = History()
    alone.add(first)
    assert scene(first, alone).lines == {}
    assert seen.caption[0].startswith("ok: 95 of 105 matches are inliers")
    assert "loop to 0.4 s before" in seen.caption[1]


def test_points_that_are_not_finite_are_left_out_and_pixels_may_be_unknown() -> None:
    found = registration_of(4)
    points = found.points_current.copy()
    points[1, 0] = np.nan
    points[2, 2] = np.inf
    spoiled = replace(found, points_current=points)
    shown = matched_points(result_of(0, registration=spoiled))
    np.testing.assert_array_equal(shown.points_cam, points[[0, 3]])
    unseen = matched_points(
        result_of(0, registration=replace(found, pixels_current=points[:0, :2]))
    )
    assert len(unseen.points_cam) == 4
    assert np.isnan(unseen.pixels).all()
    assert len(matched_points(result_of(0, registration=None)).points_cam) == 0


def estimate_of(seed: int, scale: float = 1.0) -> Estimate:
    """A pose, and a covariance (6, 6) with correlations."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    root = rng.normal(size=(6, 6)) * rng.uniform(0.01, 3.0, size=6)
    return estimate_at(0, T, covariance=scale * root @ root.T)


@given(st.integers(0, 10_000))
def test_points_on_the_ellipsoid_have_the_mahalanobis_distance_of_its_sigmas(seed: int) -> None:
    estimate = estimate_of(seed)
    found = ellipsoids([estimate], 3.0)
    np.testing.assert_array_equal(found.centres, [estimate.T_world_frame[:3, 3]])
    axes = Rotation.from_quat(found.quaternions_xyzw[0]).as_matrix()
    directions = np.random.default_rng(seed).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = (directions * found.half_axes[0]) @ axes.T
    # by small motions exp(xi) of the camera: the position moves by R t
    R = estimate.T_world_frame[:3, :3]
    world = R @ estimate.covariance[3:, 3:] @ R.T
    distances = np.einsum("ni,ni->n", points, np.linalg.solve(world, points.T).T)
    np.testing.assert_allclose(np.sqrt(distances), 3.0, rtol=1e-6)


@pytest.mark.parametrize("n_known", [0, 1])
def test_a_covariance_that_is_not_finite_has_no_ellipsoid(n_known: int) -> None:
    unknown = estimate_at(1, covariance=np.full((6, 6), np.inf))
    found = ellipsoids([unknown, *[estimate_of(1)] * n_known], 3.0)
    assert [len(each) for each in found] == [n_known] * 3
