"""The sliding window against the chain itself and against GTSAM's batch optimiser."""

from collections.abc import Callable
from typing import Literal

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, Status

seeds = st.integers(min_value=0, max_value=2**32 - 1)
STEP_NS = 100_000_000
Kernel = Literal["huber", "none"]


def wander(rng: np.random.Generator, n: int) -> list[FloatArray]:
    """Return n poses of a camera on a winding way, the first the identity."""
    poses = [np.eye(4)]
    for _ in range(n - 1):
        twist = np.concatenate(
            [0.05 * rng.normal(size=3), [0.0, 0.0, 0.3] + 0.1 * rng.normal(size=3)]
        )
        poses.append(poses[-1] @ se3.exp(twist))
    return poses


def random_covariance(rng: np.random.Generator, sigma: float) -> FloatArray:
    sigmas = sigma * rng.uniform(0.5, 2.0, size=6)
    factor = np.eye(6) + 0.2 * rng.normal(size=(6, 6))
    return np.asarray((sigmas[:, None] * (factor @ factor.T)) * sigmas)


def measure(
    poses: list[FloatArray], i: int, j: int, rng: np.random.Generator, sigma: float
) -> Edge:
    """Return a noisy edge from pose i to the later pose j."""
    covariance = random_covariance(rng, sigma)
    noise = rng.multivariate_normal(np.zeros(6), covariance)
    T = np.linalg.inv(poses[i]) @ poses[j] @ se3.exp(noise)
    return Edge(reference_id=i, T_reference_frame=se3.normalize(T), covariance=covariance)


def run(edges: list[list[Edge]], config: WindowConfig) -> tuple[list[Estimate], list[Estimate]]:
    """Return the causal and the smoothed estimates of all frames."""
    window = SlidingWindow(config)
    causal: list[Estimate] = []
    finished: list[Estimate] = []
    for frame, frame_edges in enumerate(edges):
        causal.append(window.add_pose(frame, frame * STEP_NS, frame_edges))
        finished += window.pop_finished()
    finished += window.finish()
    assert [estimate.frame_id for estimate in finished] == list(range(len(edges)))
    return causal, finished


def number(frame_id: FrameId) -> int:
    assert isinstance(frame_id, int)
    return frame_id


def batch(edges: list[list[Edge]]) -> tuple[gtsam.Values, gtsam.Marginals]:
    """Optimise all edges at once, from the chain of the first edges."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)))
    values.insert(0, gtsam.Pose3())
    for frame, frame_edges in enumerate(edges[1:], start=1):
        first = frame_edges[0]
        start = values.atPose3(number(first.reference_id)).matrix() @ first.T_reference_frame
        values.insert(frame, gtsam.Pose3(start))
        for edge in frame_edges:
            noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
            measured = gtsam.Pose3(edge.T_reference_frame)
            reference = number(edge.reference_id)
            graph.add(gtsam.BetweenFactorPose3(reference, frame, measured, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return optimum, gtsam.Marginals(graph, optimum)


def redundant_edges(seed: int, n: int, sigma: float) -> tuple[list[FloatArray], list[list[Edge]]]:
    """Return poses and, for each, edges to its predecessor and two of the five before that."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, n)
    edges: list[list[Edge]] = [[]]
    for frame in range(1, n):
        older = rng.permutation(np.arange(max(frame - 6, 0), frame - 1))[:2].tolist()
        edges.append([measure(poses, i, frame, rng, sigma) for i in (frame - 1, *older)])
    return poses, edges


def assert_equal_covariances(found: FloatArray, expected: FloatArray) -> None:
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-3)


@settings(deadline=None, max_examples=8)
@given(seed=seeds, kernel=st.sampled_from(["huber", "none"]), size=st.sampled_from([2, 5, 60]))
def test_smoothing_a_chain_of_consecutive_edges_returns_the_chain(
    seed: int, kernel: Kernel, size: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = wander(rng, 60)
    edges = [[], *([measure(poses, i, i + 1, rng, 0.02)] for i in range(59))]
    config = WindowConfig(size=size, kernel=kernel, kernel_threshold=3.0)
    causal, smoothed = run(edges, config)
    chained = np.eye(4)
    for frame, frame_edges in enumerate(edges):
        if frame_edges:
            chained = chained @ frame_edges[0].T_reference_frame
        np.testing.assert_allclose(causal[frame].T_world_cam, chained, atol=1e-6)
        np.testing.assert_allclose(smoothed[frame].T_world_cam, chained, atol=1e-6)


@settings(deadline=None, max_examples=6)
@given(seed=seeds, kernel=st.sampled_from(["huber", "none"]))
def test_a_window_that_holds_everything_gives_the_batch_optimum(seed: int, kernel: Kernel) -> None:
    # Edges so good that the kernel keeps out and one linearization is as good as many.
    _, edges = redundant_edges(seed, 30, sigma=2e-5)
    config = WindowConfig(size=100, kernel=kernel, kernel_threshold=1e3)
    causal, smoothed = run(edges, config)
    optimum, marginals = batch(edges)
    chained = np.eye(4)
    largest_correction = 0.0
    for frame in range(30):
        if frame:
            chained = chained @ edges[frame][0].T_reference_frame
        expected = optimum.atPose3(frame).matrix()
        largest_correction = max(largest_correction, np.abs(chained - expected).max())
        np.testing.assert_allclose(smoothed[frame].T_world_cam, expected, atol=1e-7)
        assert_equal_covariances(smoothed[frame].covariance, marginals.marginalCovariance(frame))
    assert largest_correction > 3e-5  # there was something to smooth
    np.testing.assert_array_equal(causal[-1].T_world_cam, smoothed[29].T_world_cam)


def test_the_causal_pose_is_the_batch_optimum_of_what_was_known() -> None:
    _, edges = redundant_edges(3, 15, sigma=2e-5)
    causal, _ = run(edges, WindowConfig(size=100, kernel="none"))
    for n in (2, 7, 12):
        optimum, marginals = batch(edges[: n + 1])
        expected = optimum.atPose3(n).matrix()
        np.testing.assert_allclose(causal[n].T_world_cam, expected, atol=1e-6)
        assert_equal_covariances(causal[n].covariance, marginals.marginalCovariance(n))


def test_marginals_carry_on_what_left_the_window() -> None:
    # The last pose hangs on everything before it, though only three poses are left.
    rng = np.random.default_rng(7)
    poses = wander(rng, 40)
    edges: list[list[Edge]] = [[]]
    for frame in range(1, 40):
        references = [frame - 1] if frame == 1 else [frame - 1, frame - 2]
        edges.append([measure(poses, i, frame, rng, 2e-4) for i in references])
    causal, _ = run(edges, WindowConfig(size=3, kernel="none"))
    optimum, marginals = batch(edges)
    np.testing.assert_allclose(causal[-1].T_world_cam, optimum.atPose3(39).matrix(), atol=1e-5)
    ratio = np.diag(causal[-1].covariance) / np.diag(marginals.marginalCovariance(39))
    np.testing.assert_allclose(ratio, 1.0, atol=0.01)


def random_soak(
    seed: int, n: int, n_kept_limit: int
) -> tuple[list[FloatArray], list[list[Edge]], list[Estimate], int]:
    """Drive a window of five with keyframes kept and released at random."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, n)
    window = SlidingWindow(WindowConfig(size=5, kernel="none"))
    edges: list[list[Edge]] = []
    kept: list[int] = []
    finished: list[Estimate] = []
    largest = 0
    for frame in range(n):
        references = [frame - 1] if frame else []
        candidates = [number(i) for i in window.poses() if i != frame - 1]
        references += rng.permutation(np.array(candidates, dtype=int))[:2].tolist()
        edges.append([measure(poses, i, frame, rng, 2e-3) for i in references])
        estimate = window.add_pose(frame, frame * STEP_NS, edges[-1])
        assert np.isfinite(estimate.T_world_cam).all()
        assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
        finished += window.pop_finished()
        if rng.random() < 0.4:
            window.keep(frame)
            kept.append(frame)
        while len(kept) > n_kept_limit or (kept and rng.random() < 0.1):
            window.release(kept.pop(int(rng.integers(len(kept)))))
        largest = max(largest, len(window))
        assert all(i in window for i in kept)
    finished += window.finish()
    return poses, edges, finished, largest


@pytest.mark.parametrize("seed", [0, 1])
def test_keyframes_may_come_and_go_for_hundreds_of_poses(seed: int) -> None:
    n = 300
    _, edges, finished, largest = random_soak(seed, n, n_kept_limit=6)
    # Each pose is handed over exactly once.
    assert sorted(number(estimate.frame_id) for estimate in finished) == list(range(n))
    assert all(e.stamp_ns == number(e.frame_id) * STEP_NS for e in finished)
    assert largest <= 5 + 6 + 1
    optimum, _ = batch(edges)
    windowed = np.array([e.T_world_cam[:3, 3] for e in sorted(finished, key=lambda e: e.stamp_ns)])
    batched = np.array([optimum.atPose3(i).matrix()[:3, 3] for i in range(n)])
    length = np.linalg.norm(np.diff(batched, axis=0), axis=1).sum()
    assert np.abs(windowed - batched).max() < 0.002 * length
    chained = [np.eye(4)]
    for frame_edges in edges[1:]:
        chained.append(chained[-1] @ frame_edges[0].T_reference_frame)
    drift = np.abs(np.array(chained)[:, :3, 3] - batched).max()
    assert np.abs(windowed - batched).max() < 0.7 * drift


def test_the_window_holds_the_recent_and_the_kept_alone() -> None:
    rng = np.random.default_rng(0)
    poses = wander(rng, 12)
    window = SlidingWindow(WindowConfig(size=3))
    for frame in range(12):
        edges = [measure(poses, frame - 1, frame, rng, 1e-3)] if frame else []
        window.add_pose(frame, frame, edges)
        if frame in (2, 4):
            window.keep(frame)
        if frame == 8:
            window.release(2)
        assert list(window.poses()) == sorted(
            {i for i in (2, 4) if i <= frame and not (i == 2 and frame > 8)}
            | set(range(max(frame - 2, 0), frame + 1))
        )
    assert len(window) == 4
    assert (4 in window, 3 in window) == (True, False)


def test_the_first_pose_has_no_edge() -> None:
    edge = Edge(reference_id="a", T_reference_frame=np.eye(4), covariance=np.eye(6))
    with pytest.raises(ValueError, match="'b'"):
        SlidingWindow().add_pose("b", 0, [edge])


@pytest.mark.parametrize(
    "ask",
    [
        lambda window: window.pose("z"),
        lambda window: window.covariance("z"),
        lambda window: window.keep("z"),
        lambda window: window.release("z"),
    ],
)
def test_poses_that_are_not_in_the_window_cannot_be_asked_for(
    ask: Callable[[SlidingWindow], object],
) -> None:
    window = SlidingWindow()
    window.add_pose("a", 0, [])
    with pytest.raises(ValueError, match="'z' is not in the window"):
        ask(window)


def test_the_first_pose_is_where_it_is_told_and_the_rest_follows() -> None:
    start = se3.exp(np.array([0.3, -0.2, 0.1, 4.0, 5.0, 6.0]))
    window = SlidingWindow()
    first = window.add_pose(
        "a", 0, [], PosePrior(T_world_frame=start, covariance=1e-10 * np.eye(6))
    )
    np.testing.assert_allclose(first.T_world_cam, start, atol=1e-12)
    assert np.sqrt(np.diag(first.covariance)).max() < 1e-4
    step = se3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 1.0]))
    edge = Edge(reference_id="a", T_reference_frame=step, covariance=1e-4 * np.eye(6))
    second = window.add_pose("b", 7, [edge], status=Status.RESUMED)
    np.testing.assert_allclose(second.T_world_cam, start @ step, atol=1e-9)
    assert (second.stamp_ns, second.frame_id, second.status) == (7, "b", Status.RESUMED)
    assert [e.status for e in window.finish()] == [Status.OK, Status.RESUMED]


def test_without_a_place_the_first_pose_is_the_identity() -> None:
    window = SlidingWindow()
    np.testing.assert_allclose(window.add_pose("a", 0, []).T_world_cam, np.eye(4), atol=1e-12)


def test_a_good_edge_outvotes_a_bad_one_by_their_covariances() -> None:
    window = SlidingWindow(WindowConfig(kernel="none"))
    window.add_pose("a", 0, [])
    shift = np.eye(4)
    shift[0, 3] = 0.01
    edges = [
        Edge(reference_id="a", T_reference_frame=np.eye(4), covariance=4e-4 * np.eye(6)),
        Edge(reference_id="a", T_reference_frame=shift, covariance=1e-4 * np.eye(6)),
    ]
    estimate = window.add_pose("b", 1, edges)
    # The mean of 0 and 1 cm, weighted by 1 / variance.
    assert estimate.T_world_cam[0, 3] == pytest.approx(0.008, abs=1e-6)
    np.testing.assert_allclose(np.diag(estimate.covariance), 0.8e-4, rtol=1e-3)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_kernel_keeps_one_bad_edge_from_moving_the_pose_wherever_it_stands(place: int) -> None:
    found = {}
    for kernel in ("huber", "none"):
        window = SlidingWindow(WindowConfig.model_validate({"kernel": kernel, "gate": None}))
        window.add_pose("a", 0, [])
        transforms = [np.eye(4) for _ in range(3)]
        transforms[place][0, 3] = 0.5  # fifty sigmas
        edges = [
            Edge(reference_id="a", T_reference_frame=T, covariance=1e-4 * np.eye(6))
            for T in transforms
        ]
        found[kernel] = window.add_pose("b", 1, edges).T_world_cam[0, 3]
    assert found["none"] == pytest.approx(0.5 / 3, rel=0.01)
    assert found["huber"] < 0.1 * 0.5


def test_edges_many_sizes_apart_do_not_break_the_window() -> None:
    # Uncertainty of coasting beside edges surer by 1e5: Cholesky factors would be indefinite.
    window = SlidingWindow(WindowConfig(size=3))
    for frame in range(60):
        sigma = 30.0 if frame % 7 == 3 else 1e-4
        covariance = sigma**2 * np.eye(6)
        edge = Edge(reference_id=frame - 1, T_reference_frame=np.eye(4), covariance=covariance)
        estimate = window.add_pose(frame, frame, [edge] if frame else [])
        assert np.isfinite(estimate.covariance).all()
    assert len(window.finish()) == 60
