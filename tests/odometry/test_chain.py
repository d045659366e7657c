"""The raw chain, driven by a front-end that knows the truth and fails on command."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.frontend.protocol import CheckedFrontend
from gvo.geometry import se3
from gvo.odometry.chain import RawChain, RawStep
from gvo.types import Edge, Failure, FloatArray, MotionPrior, Observations, RelativePose, Status
from tests.make.results import observations_of

seeds = st.integers(min_value=0, max_value=2**32 - 1)
STEP_NS = 100_000_000
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4])


def observe(stamp_ns: int) -> Observations:
    return observations_of(stamp_ns, np.zeros((0, 3)))


class TrueFrontend:
    """Registers frames at known poses, but those of `blank`; remembers what it was asked."""

    def __init__(
        self,
        pose: Callable[[int], FloatArray],
        blank: set[int],
        passing_share: float = 0.0,
        *,
        shared: FloatArray | None = None,
        bend: FloatArray | None = None,
    ) -> None:
        self._pose = pose
        self._shared, self._bend = shared, np.zeros(6) if bend is None else bend
        self._blank = blank
        self._passing_share = passing_share
        self.asked: list[tuple[int, int, MotionPrior | None]] = []

    def extract(self, frame: Observations) -> Observations:
        return frame

    def register(
        self, reference: Observations, current: Observations, prior: MotionPrior | None = None
    ) -> RelativePose | Failure:
        a, b = reference.stamp_ns, current.stamp_ns
        self.asked.append((a, b, prior))
        if a in self._blank or b in self._blank:
            return Failure(reason=f"nothing seen in {a} or {b}", n_matches=4, n_inliers=2)
        return RelativePose(
            T_reference_current=np.linalg.inv(self._pose(a)) @ self._pose(b) @ se3.exp(self._bend),
            covariance=COVARIANCE,
            shared=self._shared,
            passing_covariance=self._passing_share * COVARIANCE,
            matches=np.zeros((9, 2), dtype=np.int64),
            inliers=np.arange(9) < 7,
        )


class Unpredictable:
    """A front-end that finds nothing around predicted pixels."""

    def __init__(self, frontend: TrueFrontend) -> None:
        self._frontend = frontend

    def extract(self, frame: Observations) -> Observations:
        return frame

    def register(
        self, reference: Observations, current: Observations, prior: MotionPrior | None = None
    ) -> RelativePose | Failure:
        if prior is not None:
            return Failure(reason="nothing there")
        return self._frontend.register(reference, current)


def steady(stamp_ns: int) -> FloatArray:
    return se3.exp(np.array([0.05, 0.3, -0.1, 0.2, 0.1, 1.5]) * (1e-9 * stamp_ns))


def advance(chain: RawChain[Observations], stamp_ns: int) -> RawStep:
    return chain.advance(observe(stamp_ns), observe(stamp_ns))


def edge_of(step: RawStep) -> Edge:
    assert step.edge is not None
    return step.edge


def run(
    stamps: list[int], blank: set[int], pose: Callable[[int], FloatArray] = steady
) -> tuple[list[RawStep], TrueFrontend]:
    frontend = TrueFrontend(pose, blank)
    chain = RawChain(frontend)
    return [advance(chain, stamp) for stamp in stamps], frontend


def stamps_of(n: int, start: int = 0) -> list[int]:
    return [start + STEP_NS * i for i in range(n)]


def test_what_passes_with_the_next_step_does_not_add_up() -> None:
    chains = [RawChain(TrueFrontend(steady, set(), share)) for share in (0.75, 0.0)]
    steps = [[advance(chain, stamp) for stamp in stamps_of(4)] for chain in chains]
    for part, every in zip(*steps, strict=True):
        np.testing.assert_allclose(part.estimate.covariance, 0.25 * every.estimate.covariance)
    # A step is measured as well as it says.
    np.testing.assert_array_equal(edge_of(steps[0][-1]).covariance, COVARIANCE)


def test_errors_that_registrations_share_move_poses_as_told() -> None:
    shared, sizes = np.random.default_rng(1).normal(size=(6, 2)), np.array([1e-6, -2e-6])
    blank = {stamps_of(6)[3]}
    chain = RawChain(TrueFrontend(steady, blank, shared=shared))
    bent = RawChain(TrueFrontend(steady, blank, shared=shared, bend=3.0 * shared @ sizes))
    for stamp in stamps_of(6):
        step = chain.advance(observe(stamp), observe(stamp), effects_factor=3.0)
        other = advance(bent, stamp)
        moved = se3.log(se3.invert(step.estimate.T_world_frame) @ other.estimate.T_world_frame)
        if stamp == 0:
            assert step.effects is None
        elif stamp not in blank:  # there the bent velocity goes on, the told effects do not
            assert step.effects is not None
            np.testing.assert_allclose(step.effects @ sizes, moved, rtol=1e-3, atol=1e-8)


@settings(max_examples=25)
@given(seed=seeds)
def test_the_chain_is_the_product_of_its_relative_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.integers(1, 10**9, 20)).tolist()
    poses = dict(zip(stamps, se3.exp(rng.normal(size=(20, 6))), strict=True))
    steps, _ = run(stamps, set(), poses.__getitem__)
    product = np.eye(4)
    for step, stamp, previous in zip(steps, stamps, [None, *stamps], strict=False):
        product = product if step.edge is None else product @ step.edge.T_reference_frame
        expected = np.linalg.inv(poses[stamps[0]]) @ poses[stamp]
        np.testing.assert_allclose(step.estimate.T_world_frame, expected, atol=1e-9)
        np.testing.assert_allclose(product, expected, atol=1e-9)
        assert step.edge is None or step.edge.reference_id == previous
        assert step.failure is None
        assert step.estimate.stamp_ns == stamp
    assert all(step.registration is not None for step in steps[1:])
    assert [step.n_steps for step in steps] == list(range(20))


def test_the_covariance_grows_as_sampled_chains_spread() -> None:
    steps, _ = run(stamps_of(6), set())
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (20_000, 1, 1))
    for step in steps[1:]:
        noise = rng.multivariate_normal(np.zeros(6), COVARIANCE, len(T))
        T = T @ edge_of(step).T_reference_frame @ se3.exp(noise)
    errors = se3.log(np.linalg.inv(steps[-1].estimate.T_world_frame) @ T)
    covariance = steps[-1].estimate.covariance
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(np.cov(errors.T) / scale, covariance / scale, atol=0.05)


def test_a_bad_frame_in_between_coasts_and_the_next_is_tied_to_the_one_before_it() -> None:
    stamps = stamps_of(6)
    steps, frontend = run(stamps, {stamps[3]})
    assert [step.failure is None for step in steps] == [True, True, True, False, True, True]
    assert [edge_of(step).reference_id for step in steps[3:]] == [stamps[2], stamps[2], stamps[4]]
    assert steps[3].estimate.status == Status.COASTING
    failure = steps[3].failure
    assert failure is not None
    assert failure.reason.startswith("nothing seen")
    assert (failure.n_matches, failure.n_inliers) == (4, 2)
    assert steps[4].failure is None
    # At a constant rate coasting goes where the camera went.
    for step, stamp in zip(steps, stamps, strict=True):
        np.testing.assert_allclose(step.estimate.T_world_frame, steady(stamp), atol=1e-9)
    references = [a for a, b, _ in frontend.asked if b == stamps[4]]
    assert list(dict.fromkeys(references)) == [stamps[3], stamps[2]]


@pytest.mark.parametrize("gap_ns", [STEP_NS, 3 * STEP_NS])
def test_coasting_inflates_the_covariance_by_its_duration(gap_ns: int) -> None:
    stamps = [0, STEP_NS, STEP_NS + gap_ns, 2 * STEP_NS + gap_ns]
    steps, _ = run(stamps, {stamps[2]})
    sigmas = np.repeat([np.radians(30.0), 3.0], 3) * 1e-9 * gap_ns
    np.testing.assert_allclose(edge_of(steps[2]).covariance, np.diag(sigmas**2))
    assert np.all(np.sqrt(np.diag(steps[2].estimate.covariance)) >= sigmas)
    # Tied to the last good frame again, the chain is as sure as if nothing had been.
    assert np.diag(steps[3].estimate.covariance).max() < 0.01


def test_a_long_gap_coasts_on_and_comes_back_to_the_last_good_frame() -> None:
    stamps = stamps_of(20)
    steps, _ = run(stamps, set(stamps[5:15]))
    assert [step.failure is None for step in steps] == [True] * 5 + [False] * 10 + [True] * 5
    assert edge_of(steps[15]).reference_id == stamps[4]
    assert [edge_of(step).reference_id for step in steps[5:15]] == stamps[4:14]
    np.testing.assert_allclose(steps[19].estimate.T_world_frame, steady(stamps[19]), atol=1e-9)


def test_a_velocity_is_not_carried_over_a_long_gap() -> None:
    # Of a recording that stopped for a minute the last velocity says nothing.
    stamps = [0, STEP_NS, 600 * STEP_NS]
    steps, _ = run(stamps, {stamps[2]})
    coasted = np.linalg.norm(edge_of(steps[2]).T_reference_frame[:3, 3])
    assert 1.0 < coasted < 2.0  # a second at 1.5 m/s


def test_the_prior_is_constant_velocity_from_the_raw_chain() -> None:
    _, frontend = run([0, STEP_NS, 3 * STEP_NS, 4 * STEP_NS], set())
    assert frontend.asked[0][2] is None  # nothing known yet
    assert len(frontend.asked) == 3
    for a, b, prior in frontend.asked[1:]:
        assert prior is not None
        expected = np.linalg.inv(steady(a)) @ steady(b)
        np.testing.assert_allclose(prior.T_predicted, expected, atol=1e-9)


def test_a_prediction_that_leads_nowhere_is_dropped_before_the_frame_is_given_up() -> None:
    stamps = stamps_of(4)
    chain = RawChain(Unpredictable(TrueFrontend(steady, set())))
    assert all(advance(chain, stamp).failure is None for stamp in stamps)


@pytest.mark.parametrize("stamp", [STEP_NS, STEP_NS - 1, 0])
def test_a_stamp_that_does_not_advance_is_misuse(stamp: int) -> None:
    chain = RawChain(TrueFrontend(steady, set()))
    for good in (0, STEP_NS):
        advance(chain, good)
    with pytest.raises(ValueError, match=f"stamp {stamp} is not after {STEP_NS}"):
        advance(chain, stamp)
    assert advance(chain, 2 * STEP_NS).failure is None


def test_frames_from_the_start_on_may_be_blank() -> None:
    stamps = stamps_of(5)
    steps, _ = run(stamps, set(stamps[:2]))
    assert [step.failure is None for step in steps] == [True, False, False, True, True]


def test_rotations_stay_rotations_over_a_long_chain() -> None:
    steps, _ = run(stamps_of(2000), set())
    R = steps[-1].estimate.T_world_frame[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


class Spoilt(TrueFrontend):
    """A front-end whose result at one stamp is changed."""

    def __init__(self, stamp_ns: int, **changes: Any) -> None:
        super().__init__(steady, set())
        self._stamp_ns = stamp_ns
        self._changes = changes

    def register(
        self, reference: Observations, current: Observations, prior: MotionPrior | None = None
    ) -> RelativePose | Failure:
        result = super().register(reference, current, prior)
        if isinstance(result, Failure) or current.stamp_ns != self._stamp_ns:
            return result
        return replace(result, **self._changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"T_reference_current": np.full((4, 4), np.nan)},
        {"T_reference_current": np.diag([1.0, 1.0, -1.0, 1.0])},
        {"T_reference_current": np.eye(3)},
        {"covariance": np.full((6, 6), np.inf)},
        {"covariance": np.zeros((6, 6))},
        {"covariance": np.ones((6, 6))},
    ],
)
def test_a_false_relative_pose_is_a_failure_and_the_chain_goes_on(changes: dict[str, Any]) -> None:
    stamps = stamps_of(6)
    chain = RawChain(CheckedFrontend(Spoilt(stamps[3], **changes)))
    steps = [advance(chain, stamp) for stamp in stamps]
    assert [step.failure is None for step in steps] == [stamp != stamps[3] for stamp in stamps]
    assert steps[3].failure is not None
    assert "front-end is at fault" in steps[3].failure.reason
    np.testing.assert_allclose(steps[5].estimate.T_world_frame, steady(stamps[5]), atol=1e-9)


def test_steps_are_counted_from_where_they_start() -> None:
    steps, _ = run(stamps_of(6), {3 * STEP_NS})
    counts = [step.n_steps for step in steps]
    assert counts[:3] == [0, 1, 2]
    assert counts[3] > 100  # coasted
    assert counts[4:] == [3, 4]  # from the last registered frame


def test_a_step_is_steady_where_the_velocity_changes_as_it_used_to() -> None:
    """Sigmas are 0.02 m and more: jumps of 0.04 m to and fro are usual, 0.5 m once are not."""

    def pose(stamp_ns: int) -> FloatArray:
        index = stamp_ns // STEP_NS
        T = steady(stamp_ns)
        T[:3, 3] += 0.04 * (index % 2) + 0.5 * (index >= 12)
        return T

    steps, _ = run([i * STEP_NS for i in range(24)], set(), pose)
    are_steady = [step.is_steady for step in steps]
    # The first frame, the first velocity, and three changes that tell what is usual.
    assert are_steady[:5] == [False] * 5
    assert all(are_steady[5:12])
    # The jump, and the return to the velocity before it.
    assert are_steady[12:14] == [False, False]
    assert all(are_steady[14:])


def test_a_step_that_only_goes_on_is_not_called_steady() -> None:
    steps, _ = run([i * STEP_NS for i in range(12)], {9 * STEP_NS})
    assert steps[8].is_steady
    assert not steps[9].is_steady
    assert steps[10].is_steady
