"""Association and alignment against brute force and known motions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import (
    MAX_GAP_NS,
    AlignMode,
    Similarity,
    alignment,
    associate,
    clock_offset,
    pair,
)
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from tests.trajectory.paths import random_trajectory, seeds, still, unturned

stamp_lists = st.lists(st.integers(0, 200), min_size=1, max_size=30, unique=True).map(sorted)


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(T_a_b=se3.exp(rng.normal(size=6)), scale=float(rng.uniform(0.2, 5.0)))


@given(stamp_lists, stamp_lists, st.integers(0, 20))
def test_each_pose_of_the_shorter_takes_the_nearest_that_no_nearer_one_takes(
    reference: list[int], estimate: list[int], limit: int
) -> None:
    is_swapped = len(estimate) > len(reference)
    longer, shorter = (estimate, reference) if is_swapped else (reference, estimate)
    taken: dict[int, tuple[int, int]] = {}
    for index, stamp in enumerate(shorter):
        difference, nearest = min((abs(stamp - other), k) for k, other in enumerate(longer))
        if difference <= limit:
            taken[nearest] = min(taken.get(nearest, (limit + 1, 0)), (difference, index))
    expected = [(nearest, index) for nearest, (_, index) in sorted(taken.items())]
    if is_swapped:
        expected = [(index, nearest) for nearest, index in expected]
    if not expected:
        with pytest.raises(TrajectoryError, match="share no stamps"):
            associate(still(reference), still(estimate), max_difference_ns=limit)
        return
    rows, columns = associate(still(reference), still(estimate), max_difference_ns=limit)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == expected


def test_where_nothing_associates_both_ranges_are_named() -> None:
    with pytest.raises(TrajectoryError) as caught:
        associate(still([0, 10**9]), still([3 * 10**9, 4 * 10**9]), name="raw")
    message = str(caught.value)
    assert "raw 3.000000000 to 4.000000000 s, reference 0.000000000 to 1.000000000 s" in message
    assert "within 10 ms" in message


@pytest.mark.parametrize(
    "origins", [("rows", "rows"), ("times", "rows"), ("rows", "times")], ids="-".join
)
def test_poses_without_stamps_are_joined_by_row(origins: tuple[StampsFrom, StampsFrom]) -> None:
    reference = still([7 * k for k in range(5)], origins[0])
    rows, columns = associate(reference, still([10**9 * k for k in range(5)], origins[1]))
    assert rows.tolist() == columns.tolist() == list(range(5))


@pytest.mark.parametrize(
    ("n_reference", "n_estimate", "origins", "match"),
    [
        # One row missing in the middle would shift all after it.
        (5, 3, ("rows", "rows"), "3 poses without.*5:"),
        (3, 5, ("rows", "rows"), "5 poses without.*3:"),
        # An equal number of poses does not make up for missing stamps.
        (2, 2, ("file", "rows"), "^raw holds rows of poses without stamps.*with the reference"),
        (3, 2, ("rows", "file"), "^the reference holds rows of poses without stamps.*with raw"),
        (3, 2, ("times", "rows"), "^raw holds rows.*times.txt"),
    ],
)
def test_poses_without_stamps_meet_neither_more_nor_fewer_nor_stamped_ones(
    n_reference: int, n_estimate: int, origins: tuple[StampsFrom, StampsFrom], match: str
) -> None:
    reference = still([*range(n_reference)], origins[0])
    estimate = still([*range(n_estimate)], origins[1])
    with pytest.raises(TrajectoryError, match=match):
        associate(reference, estimate, name="raw")


@given(seeds)
def test_a_known_motion_is_found_again(seed: int) -> None:
    estimate, truth = random_trajectory(seed), random_similarity(seed + 1)
    found = alignment(truth.apply(estimate), estimate, "sim3")
    np.testing.assert_allclose(found.T_a_b, truth.T_a_b, atol=1e-7)
    assert found.scale == pytest.approx(truth.scale, rel=1e-7)
    rigid = Similarity(T_a_b=truth.T_a_b)
    np.testing.assert_allclose(
        alignment(rigid.apply(estimate), estimate, "se3").T_a_b, truth.T_a_b, atol=1e-7
    )


@given(seeds)
def test_the_first_pose_lies_on_the_first_after_alignment_of_the_origin(seed: int) -> None:
    reference, estimate = random_trajectory(seed), random_trajectory(seed + 1)
    aligned = alignment(reference, estimate, "origin").apply(estimate)
    np.testing.assert_allclose(aligned.T_world_frame[0], reference.T_world_frame[0], atol=1e-12)


@pytest.mark.parametrize(("mode", "is_scaled"), [("se3", False), ("sim3", True)])
def test_an_optimiser_has_no_better_alignment(mode: AlignMode, is_scaled: bool) -> None:
    reference, estimate = random_trajectory(0), random_trajectory(100)
    aligned = alignment(reference, estimate, mode).apply(estimate)
    cost = np.sum((aligned.positions - reference.positions) ** 2)

    def residuals(x: np.ndarray) -> np.ndarray:
        R = np.asarray(Rotation.from_rotvec(x[:3]).as_matrix())
        scale = np.exp(x[6]) if is_scaled else 1.0
        return np.ravel(scale * estimate.positions @ R.T + x[3:6] - reference.positions)

    starts = np.random.default_rng(0).normal(size=(8, 7)) * [2, 2, 2, 1, 1, 1, 0.3]
    best = min(2.0 * least_squares(residuals, start).cost for start in starts)
    assert cost == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize(
    ("n", "across_m", "mode"),
    [(1, 0.0, "se3"), (2, 0.0, "se3"), (5, 0.0, "se3"), (50, 1e-3, "se3"), (50, 1e-3, "sim3")],
)
def test_poses_almost_on_a_line_are_aligned(n: int, across_m: float, mode: AlignMode) -> None:
    """A drive of 100 m that leaves its line by millimetres still tells which side is up."""
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(n, 3)) * [100.0, across_m, 2.0 * across_m]
    path = Trajectory(stamps_ns=np.arange(n), T_world_frame=unturned(positions))
    reference = Similarity(T_a_b=random_similarity(4).T_a_b).apply(path)
    aligned = alignment(reference, path, mode).apply(path)
    np.testing.assert_allclose(aligned.positions, reference.positions, atol=1e-6)


def test_a_scale_needs_motion() -> None:
    pair_of = [random_trajectory(0, 3), still([0, 1, 2])]
    for reference, estimate in (pair_of, pair_of[::-1]):
        with pytest.raises(TrajectoryError, match="no scale"):
            alignment(reference, estimate, "sim3")


def test_wrong_use_of_alignment_is_refused() -> None:
    with pytest.raises(ValueError, match="3 reference poses and 2"):
        alignment(still([0, 1, 2]), still([0, 1]), "se3")
    with pytest.raises(ValueError, match="mode must be one of"):
        alignment(still([0]), still([0]), "affine")  # type: ignore[arg-type]


def test_covariances_scale_with_the_positions() -> None:
    covariance = np.diag([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    covariance[0, 3] = covariance[3, 0] = 0.5
    trajectory = Trajectory(
        stamps_ns=np.array([0]), T_world_frame=np.eye(4)[None], covariances=covariance[None]
    )
    scaled = Similarity(T_a_b=np.eye(4), scale=3.0).apply(trajectory).covariances
    assert scaled is not None
    assert np.diag(scaled[0]).tolist() == [1.0, 1.0, 1.0, 18.0, 18.0, 18.0]
    assert scaled[0, 0, 3] == scaled[0, 3, 0] == 1.5


def circle(stamps_ns: np.ndarray, stamps_from: StampsFrom = "topic") -> Trajectory:
    angles = 2.0 * np.pi * stamps_ns / 20e9
    R = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    t = 10.0 * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    return Trajectory(
        stamps_ns=stamps_ns, T_world_frame=se3.make_transform(R, t), stamps_from=stamps_from
    )


@given(
    st.integers(20_000_000, 120_000_000),
    st.integers(200_000_000, 2_000_000_000),
    st.integers(0, 10**9),
    st.booleans(),
)
def test_trajectories_of_topics_meet_at_the_stamps_of_the_sparser_one(
    step_ns: int, sparse_step_ns: int, phase_ns: int, is_estimate_dense: bool
) -> None:
    """Both show one motion at other stamps: interpolated they agree to the sagitta of a step."""
    dense = circle(np.arange(0, 10**10, step_ns))
    sparse = circle(np.arange(phase_ns, 9 * 10**9, sparse_step_ns), "file")
    if is_estimate_dense:
        stamped, interpolated = pair(sparse, dense)
    else:
        interpolated, stamped = pair(dense, sparse)
    np.testing.assert_array_equal(stamped.stamps_ns, sparse.stamps_ns)
    np.testing.assert_array_equal(interpolated.stamps_ns, sparse.stamps_ns)
    sagitta = 10.0 * (1.0 - np.cos(np.pi * step_ns / 20e9))
    apart = np.linalg.norm(interpolated.positions - stamped.positions, axis=1)
    assert apart.max() <= sagitta + 1e-9
    np.testing.assert_allclose(
        interpolated.T_world_frame[:, :3, :3], stamped.T_world_frame[:, :3, :3], atol=1e-9
    )


def test_nothing_is_interpolated_over_a_gap_or_outside() -> None:
    step = MAX_GAP_NS
    dense = circle(np.array([0, step, 2 * step + 1, *range(3 * step, 3 * step + 9)]))
    stamps_ns = np.array([-step, 0, step // 2, step + 5, 2 * step + 1, 3 * step - 9, 9 * step])
    found, _ = pair(dense, circle(stamps_ns))
    assert found.stamps_ns.tolist() == [0, step // 2, 2 * step + 1, 3 * step - 9]


def test_files_are_associated_as_ever_and_single_poses_as_well() -> None:
    reference = circle(np.arange(0, 10**9, 50_000_000), "file")
    estimate = circle(np.arange(3_000_000, 10**9, 100_000_000), "times")
    indices, others = associate(reference, estimate)
    first, second = pair(reference, estimate)
    np.testing.assert_array_equal(first.stamps_ns, reference.stamps_ns[indices])
    np.testing.assert_array_equal(second.stamps_ns, estimate.stamps_ns[others])
    one = circle(np.array([5]))
    assert [len(found) for found in pair(one, one)] == [1, 1]
    first, second = pair(reference, circle(np.array([75_000_000])))
    assert first.stamps_ns.tolist() == second.stamps_ns.tolist() == [75_000_000]


def test_topics_of_other_clocks_are_refused() -> None:
    with pytest.raises(TrajectoryError, match=r"^raw and the reference .* 250 ms apart"):
        pair(circle(np.arange(5)), circle(np.arange(5) + 10**12), name="raw")
    for other, match in ((still([]), "holds no poses"), (still([0], "rows"), "without stamps")):
        with pytest.raises(TrajectoryError, match=match):
            pair(circle(np.arange(5)), other)


def test_positions_without_rotations_are_aligned_but_not_by_their_first_pose() -> None:
    poses = random_trajectory(1)
    points = Trajectory.of_positions(poses.stamps_ns, poses.positions)
    moved = random_similarity(3)
    moved = Similarity(T_a_b=moved.T_a_b)
    for reference, estimate in ((moved.apply(points), poses), (moved.apply(poses), points)):
        aligned = alignment(reference, estimate, "se3").apply(estimate)
        np.testing.assert_allclose(aligned.positions, reference.positions, atol=1e-9)
        assert aligned.has_rotations == estimate.has_rotations
        with pytest.raises(TrajectoryError, match=r"positions without rotations.*align by se3"):
            alignment(reference, estimate, "origin")


@pytest.mark.parametrize("offset_s", [0.0, 0.037, -12.3, 1000.5])
def test_the_offset_of_another_clock_is_found(offset_s: float) -> None:
    phases = np.outer(np.arange(400) * 0.05, [0.9, 0.5, 0.31, 1.3, 0.7, 1.1])
    swaying = np.sin(phases) + 0.5 * np.sin(2.3 * phases)
    stamps_ns = 10**18 + np.arange(400) * 50_000_000
    reference = Trajectory(stamps_ns=stamps_ns, T_world_frame=se3.exp(0.3 * swaying))
    # a part of it, at other times, seen from another world
    part = reference.interpolate(stamps_ns[60:300:2] + 13_000_000).moved(se3.exp(swaying[3]))
    estimate = replace(part, stamps_ns=part.stamps_ns - round(1e9 * offset_s))
    found_ns = clock_offset(reference, estimate)
    assert found_ns == pytest.approx(1e9 * offset_s, abs=5e6)


def test_no_offset_is_found_of_what_moves_otherwise() -> None:
    rng = np.random.default_rng(0)
    stamps_ns = np.arange(100) * 100_000_000
    walks = [se3.exp(rng.normal(size=(100, 6)).cumsum(axis=0) * 0.01) for _ in range(2)]
    first, second = (Trajectory(stamps_ns=stamps_ns, T_world_frame=T) for T in walks)
    with pytest.raises(TrajectoryError, match="no offset of the clocks"):
        clock_offset(first, second)
