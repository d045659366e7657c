"""Which of two edges is believed, and what the references' own uncertainty excuses."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.factors import Measurement
from gvo.backend.gating import Gated, Prediction, disagreement, gate_edges
from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, FrameId
from tests.backend.walks import STEP_NS, seeds, shifted, walk

GATE = 10.0


def edge(reference_id: FrameId, T: FloatArray, covariance: FloatArray) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=covariance)


# Two edges alone cannot outvote each other; the motion so far decides.


CONFIG = WindowConfig(size=8, kernel="none", gate=GATE)


@pytest.mark.parametrize("is_wrong_first", [False, True])
@pytest.mark.parametrize("is_wrong_nearer", [False, True])
@settings(max_examples=8)
@given(seed=seeds, offset_m=st.floats(8.0, 1000.0))
def test_of_two_edges_that_disagree_the_one_that_fits_the_motion_stays(
    is_wrong_first: bool, is_wrong_nearer: bool, seed: int, offset_m: float
) -> None:
    rng = np.random.default_rng(seed)
    step = se3.exp(np.r_[0.05 * rng.normal(size=3), 0.5 * rng.normal(size=3)])
    direction = rng.normal(size=3)
    jump = shifted(*(offset_m * direction / np.linalg.norm(direction)))
    nearer, farther = (4, step), (3, step @ step)
    (right, T_right), (wrong, T_wrong) = (farther, nearer) if is_wrong_nearer else (nearer, farther)
    edges = [
        edge(right, se3.normalize(T_right), 1e-4 * np.eye(6)),
        edge(wrong, se3.normalize(T_wrong @ jump), 1e-4 * np.eye(6)),
    ]
    window = walk(CONFIG, 5, step)
    expected = window.pose(4) @ step
    estimate = window.add_pose(5, 5 * STEP_NS, edges[::-1] if is_wrong_first else edges)
    assert [refused.reference_id for refused in estimate.rejected] == [wrong]
    assert window.counts.n_gated == 1
    np.testing.assert_allclose(estimate.T_world_frame, expected, atol=1e-3)


@pytest.mark.parametrize("is_swapped", [False, True])
def test_where_the_motion_fits_neither_of_two_edges_both_stay(is_swapped: bool) -> None:
    # One against one, and nobody to tell which is right.
    window = walk(CONFIG, 5, shifted(z=0.5))
    edges = [
        edge(4, shifted(100.0, 0.0, 0.0), 1e-4 * np.eye(6)),
        edge(3, shifted(-100.0, 0.0, 0.0), 1e-4 * np.eye(6)),
    ]
    estimate = window.add_pose(5, 5 * STEP_NS, edges[::-1] if is_swapped else edges)
    assert estimate.rejected == ()


# References that are uncertain of each other excuse a disagreement, by their lever arm.

SURE = 1e-6 * np.eye(6)
TURN_SIGMA = 0.05
ARM_M = 30.0


def two_references(T_0_1: FloatArray, axis: FloatArray) -> SlidingWindow:
    """Return a window of two poses; how they are turned about an axis of pose 1 is ill known."""
    covariance = SURE.copy()
    covariance[:3, :3] += TURN_SIGMA**2 * np.outer(axis, axis)
    window = SlidingWindow(CONFIG)
    window.add_pose(0, 0, [])
    window.add_pose(1, STEP_NS, [edge(0, T_0_1, covariance)])
    return window


def arriving(T_0_1: FloatArray, twist_of_1: FloatArray, T_1_2: FloatArray) -> list[Edge]:
    """Return two edges from pose 1, and one from pose 0 as if pose 1 were off by a twist."""
    T_0_2 = se3.normalize(T_0_1 @ se3.exp(twist_of_1) @ T_1_2)
    return [edge(1, T_1_2, SURE), edge(1, T_1_2, SURE), edge(0, T_0_2, SURE)]


@pytest.mark.parametrize("is_stretch", [False, True])
@pytest.mark.parametrize("rearrange", [list, lambda e: [*e[1:], e[0]], lambda e: e[::-1]])
@settings(max_examples=15)
@given(seed=seeds)
def test_turns_of_uncertain_references_excuse_what_lies_across_a_long_arm_and_no_stretch(
    is_stretch: bool, rearrange: Callable[[list[Edge]], list[Edge]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    T_0_1, T_1_2 = (se3.exp(np.r_[rng.normal(size=3), np.zeros(3)]) for _ in range(2))
    arm = rng.normal(size=3)
    arm /= np.linalg.norm(arm)
    T_1_2[:3, 3] = ARM_M * arm
    axis = np.cross(arm, rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    # Off by two sigmas of the turn, across the arm: three metres, thousands of the edges' sigmas.
    # No turn of pose 1 lengthens the arm: two metres are far beyond the millimetres known.
    twist = (
        np.r_[np.zeros(3), 2.0 * arm] if is_stretch else np.r_[2.0 * TURN_SIGMA * axis, np.zeros(3)]
    )
    window = two_references(T_0_1, axis)
    estimate = window.add_pose(2, 2 * STEP_NS, rearrange(arriving(T_0_1, twist, T_1_2)))
    assert [refused.reference_id for refused in estimate.rejected] == [0] * is_stretch


# Where to start, by what the edges say together.


def random_covariance(rng: np.random.Generator, sigma: float) -> FloatArray:
    factor = np.eye(6) + 0.5 * rng.normal(size=(6, 6))
    return np.asarray(sigma**2 * factor @ factor.T)


def optimum(edges: list[Edge], references: dict[FrameId, FloatArray], T: FloatArray) -> FloatArray:
    """Return the least squares of edges from known references, by GTSAM's batch."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(0, gtsam.Pose3(T))
    for each in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(each.covariance)
        predicted = references[each.reference_id] @ each.T_reference_frame
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(predicted), noise))
    answer = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.asarray(answer.atPose3(0).matrix())


KNOWN = np.zeros((6, 6))


def verdict_of(
    edges: list[Edge],
    references: dict[FrameId, FloatArray],
    *,
    gate: float | None,
    unknown: FloatArray = KNOWN,
) -> Gated:
    return gate_edges(
        predicted(edges, references),
        relative_covariance=lambda a, b: KNOWN if a == b else unknown,
        motion=lambda: None,
        gate=gate,
    )


def predicted(edges: list[Edge], references: dict[FrameId, FloatArray]) -> list[Prediction]:
    return [
        Prediction(
            Measurement.of(each),
            gtsam.Pose3(references[each.reference_id] @ each.T_reference_frame),
        )
        for each in edges
    ]


def refused_of(verdict: Gated, edges: list[Edge]) -> set[int]:
    """Return which edges are refused; check that the others are accepted, in order."""
    refused = {k for k, each in enumerate(edges) if any(each is out for out, _ in verdict.refused)}
    kept = [each for k, each in enumerate(edges) if k not in refused]
    accepted = [measurement.edge for measurement in verdict.accepted]
    assert [*map(id, accepted)] == [*map(id, kept)]
    assert len(refused) == len(verdict.refused)
    assert all(reason for _, reason in verdict.refused)
    return refused


@pytest.mark.parametrize("gate", [None, 1e-3, 10.0])
@settings(max_examples=10)
@given(seed=seeds, n=st.integers(3, 6), n_wrong=st.integers(0, 1))
def test_the_start_is_the_optimum_of_the_edges_that_agree(
    gate: float | None, seed: int, n: int, n_wrong: int
) -> None:
    rng = np.random.default_rng(seed)
    T_world_frame = se3.exp(rng.normal(size=6))
    references: dict[FrameId, FloatArray] = {k: se3.exp(rng.normal(size=6)) for k in range(n)}
    edges = []
    for k in range(n):
        covariance = random_covariance(rng, 1e-4)
        noise = 0.5 * rng.multivariate_normal(np.zeros(6), covariance)
        if k >= n - n_wrong:
            noise[3:] += [0.3, -0.2, 0.4]
        T = np.linalg.inv(references[k]) @ T_world_frame @ se3.exp(noise)
        edges.append(edge(k, T, covariance))
    order = rng.permutation(n)
    ordered = [edges[k] for k in order]
    verdict = verdict_of(ordered, references, gate=gate)
    wrong = {int(order[k]) for k in refused_of(verdict, ordered)}
    # Of edges that all disagree nobody is outvoted: none has more beside it than another.
    assert wrong == (set(range(n - n_wrong, n)) if gate == 10.0 else set())
    expected = optimum(edges[: n - n_wrong], references, T_world_frame)
    # Twists about an outlier, where it comes first, are exact to a part of its distance only.
    tolerance = 1e-4 if n_wrong else 1e-7
    np.testing.assert_allclose(verdict.T_world_start.matrix(), expected, atol=tolerance)


@given(seed=seeds)
def test_a_disagreement_is_told_in_sigmas_of_both_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    known, T = random_covariance(rng, 1e-2), se3.exp(rng.normal(size=6))
    measured = random_covariance(rng, 1e-2)
    twist = rng.multivariate_normal(np.zeros(6), known + measured)
    sigmas = float(np.sqrt(twist @ np.linalg.solve(known + measured, twist)))
    one = edge("a", se3.normalize(T @ se3.exp(twist)), measured)
    assert disagreement(one, T, known, gate=1.001 * sigmas) == ""
    reason = disagreement(one, T, known, gate=0.999 * sigmas)
    assert f"by {sigmas:.3g} sigma" in reason
    assert f"window.gate: {0.999 * sigmas:g}" in reason


def test_what_the_references_have_in_common_is_no_disagreement_of_theirs() -> None:
    # The same difference, along the motion of the second reference and not.
    unknown = np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    here: dict[FrameId, FloatArray] = {0: np.eye(4), 1: shifted(z=1.0)}
    for offset, n_refused in ((shifted(2.0, 0.0, 0.0), 0), (shifted(0.0, 2.0, 0.0), 1)):
        edges = [edge(0, shifted(z=2.0), 1e-4 * np.eye(6)) for _ in range(2)]
        edges.append(edge(1, shifted(z=1.0) @ offset, 1e-4 * np.eye(6)))
        verdict = verdict_of(edges, here, gate=10.0, unknown=unknown)
        assert refused_of(verdict, edges) == ({2} if n_refused else set())


# Bounds, on a line: edges of one reference, unsure by one sigma each, that differ along x alone.

SIGMA_M = 1e-3


def on_a_line(*places: float) -> list[Edge]:
    """Return edges so far apart, in sigmas of a difference of two."""
    size = np.sqrt(2.0) * SIGMA_M
    return [edge(0, shifted(x * size, 0.0, 0.0), SIGMA_M**2 * np.eye(6)) for x in places]


def judged(edges: list[Edge], gate: float | None) -> tuple[float, set[int]]:
    """Return the start on the line, in the same sigmas, and which edges are refused."""
    verdict = verdict_of(edges, {0: np.eye(4)}, gate=gate)
    start = verdict.T_world_start.translation()[0] / (np.sqrt(2.0) * SIGMA_M)
    return float(start), refused_of(verdict, edges)


@pytest.mark.parametrize(
    ("places", "gate", "start", "refused"),
    [
        ([1e5], 1e-3, 1e5, []),
        # Two edges agree up to five sigmas, then the first is believed to start at.
        ([0.0, 4.9], None, 2.45, []),
        ([0.0, 5.1], None, 0.0, []),
        ([0.0, 5.9], None, 0.0, []),
        ([5.9, 0.0], None, 5.9, []),
        # A chain of them: what is within five sigmas of the one in the middle.
        ([0.0, 3.0, 6.0], None, 3.0, []),
        ([0.0, 4.9, 10.1], None, 2.45, []),
        # A narrow gate refuses what is not yet far for a start.
        ([0.0, 0.0, 3.0], 2.0, 0.0, [2]),
        ([3.0, 0.0, 0.0], 2.0, 0.0, [0]),
        ([0.0, 0.0, 1.9], 2.0, 1.9 / 3.0, []),
        ([0.0, 0.0, 0.7], 0.5, 0.0, [2]),
        ([0.0, 0.1, 0.7], 0.5, 0.05, [2]),
        # A wide one leaves in what is too far to start at.
        ([0.0, 0.0, 7.0], 10.0, 0.0, []),
        ([0.0, 0.0, 9.9], 10.0, 0.0, []),
        ([0.0, 0.0, 10.1], 10.0, 0.0, [2]),
        # How far off the others are does not matter: the median is no medoid.
        ([0.0, 0.1, 300.0, 900.0, 1000.0], None, 0.05, []),
        ([0.0, 0.1, 300.0, 900.0, 1000.0], 10.0, 0.05, [2, 3, 4]),
        ([1000.0, 900.0, 300.0, 0.1, 0.0], 10.0, 0.05, [0, 1, 2]),
    ],
)
def test_on_a_line_the_bounds_are_those_that_are_told(
    places: list[float], gate: float | None, start: float, refused: list[int]
) -> None:
    found, out = judged(on_a_line(*places), gate)
    assert found == pytest.approx(start, rel=1e-6, abs=1e-6)
    assert out == set(refused)


def test_surer_edges_draw_the_start_to_them() -> None:
    one, other = on_a_line(0.0, 1.0)
    surer = edge(0, other.T_reference_frame, other.covariance / 9.0)
    assert judged([one, surer], None)[0] == pytest.approx(0.9, abs=1e-6)


def test_the_motion_is_asked_only_where_edges_disagree_and_votes_as_one() -> None:
    asked = []

    def motion() -> Prediction:
        asked.append(True)
        return predicted(on_a_line(20.0), {0: np.eye(4)})[0]

    for places, refused in (((0.0, 9.9), []), ((0.0, 20.1), [0]), ((20.1, 0.0), [1])):
        asked.clear()
        edges = on_a_line(*places)
        verdict = gate_edges(
            predicted(edges, {0: np.eye(4)}),
            relative_covariance=lambda *_: np.zeros((6, 6)),
            motion=motion,
            gate=10.0,
        )
        assert refused_of(verdict, edges) == set(refused)
        assert len(asked) == len(refused)
    assert "20.1 sigma with the edge from 0 (window.gate: 10)" in verdict.refused[0][1]


def test_a_difference_along_what_is_known_to_be_tied_is_far() -> None:
    # Two translations that are nearly always alike: that they differ is far beyond a gate.
    tied = np.eye(6)
    tied[3, 4] = tied[4, 3] = 1.0 - 1e-9
    half = 0.5 * tied
    assert disagreement(edge(0, shifted(1.0, 1.0, 0.0), half), np.eye(4), half, gate=1.01) == ""
    apart = edge(0, shifted(1.0, -1.0, 0.0), half)
    assert "sigma" in disagreement(apart, np.eye(4), half, gate=1e3)
