"""The sliding window under long mixtures of right, wrong and damaged calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, PosePrior, PositionPrior, Prior, Rejected
from tests.backend.walks import STEP_NS, seeds

SIGMAS = [1e-4, 1e-2, 1.0]
COVARIANCES = ["zero", "negative", "tiny", "vast", "nan", "asymmetric"]
BREAKAGES = [
    *("nan", "infinite", "huge", "no rotation", "reflection", "stranger", "itself", "departed"),
    *(f"{kind} covariance" for kind in COVARIANCES),
]
qualities = st.sampled_from(["good"] * 6 + ["outlier"] * 2 + ["broken"] * 2)
picks = st.integers(0, 2**16)
edge_lists = st.lists(
    st.tuples(picks, qualities, st.sampled_from(SIGMAS), st.sampled_from(BREAKAGES)),
    min_size=1,
    max_size=4,
)
priors = st.sampled_from(
    ["none"] * 6 + ["pose", "position", "far", "wrong", "nan", "absurd", "no covariance"]
)


def damage(T: FloatArray, covariance: FloatArray, breakage: str) -> tuple[FloatArray, FloatArray]:
    """Return a measurement with one fault of its values."""
    T, covariance = T.copy(), covariance.copy()
    values = {"nan": np.nan, "infinite": np.inf, "huge": 1e300}
    scales = {"zero": 0.0, "negative": -1.0, "tiny": 1e-24, "vast": 1e24, "nan": np.nan}
    if breakage in values:
        T[1, 3] = values[breakage]
    elif breakage == "no rotation":
        T[:3, :3] = np.arange(9.0).reshape(3, 3)
    elif breakage == "reflection":
        T[:3, :3] = T[:3, :3] @ np.diag([1.0, -1.0, 1.0])
    elif breakage == "asymmetric covariance":
        covariance[0, 1] += 0.9 * covariance[0, 0]
    elif breakage.endswith("covariance"):
        covariance *= scales[breakage.split()[0]]
    return T, covariance


def assert_sound(estimate: Estimate) -> None:
    assert se3.transform_fault(estimate.T_world_frame, tolerance=1e-6) == ""
    assert_covariance(estimate.covariance)


def assert_covariance(covariance: FloatArray) -> None:
    assert np.isfinite(covariance).all()
    sigmas = np.sqrt(np.diag(covariance))
    assert (sigmas > 0).all()
    correlations = covariance / np.outer(sigmas, sigmas)
    np.testing.assert_allclose(correlations, correlations.T, atol=1e-6)
    # Sixteen digits cannot hold 1e-4 beside 1e4 m in turned axes: zero but for the rounding.
    assert np.linalg.eigvalsh(correlations)[0] > -1e-12


def has_poses(machine: WindowMachine) -> bool:
    """Tell whether the window did not just begin anew."""
    return len(machine.window) > 0


class WindowMachine(RuleBasedStateMachine):
    """A window, what it was given, and what it gave back."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps: dict[int, int] = {}
        self.truths: dict[int, FloatArray] = {}
        self.kept: set[int] = set()
        self.popped: list[Estimate] = []
        self.n_rejected = 0
        self.window = SlidingWindow()
        self.rng = np.random.default_rng(0)

    # Making of the calls.

    @initialize(
        seed=seeds,
        size=st.sampled_from([2, 3, 5, 8, None]),
        kernel=st.sampled_from(["none", "huber", "cauchy", "geman_mcclure", "dcs"]),
        gate=st.sampled_from([None, 3.0, 10.0]),
        keyframes=st.sampled_from(["manual", "manual", "distance"]),
        prior=priors,
    )
    def begin(
        self,
        seed: int,
        size: int | None,
        kernel: Any,
        gate: float | None,
        keyframes: Any,
        prior: str,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.size, self.is_manual = size, keyframes == "manual"
        self.n_keyframes = 0 if self.is_manual else 3
        self.last_fix, self.fix_interval = -1, 0
        config = WindowConfig(size=size, kernel=kernel, gate=gate, n_keyframes=3)
        self.window = SlidingWindow(config, keyframes=keyframes)
        self.add([], prior, 1)

    def live(self) -> list[Any]:
        return list(self.window.poses())

    def pick(self, number: int) -> int:
        ids = self.live()
        frame = ids[-1 - number % len(ids)]
        assert isinstance(frame, int)
        return frame

    def measure(self, reference: int, frame: int, quality: str, sigma: float, how: str) -> Edge:
        noise = sigma * self.rng.normal(size=6)
        T = se3.invert(self.truths[reference]) @ self.truths[frame] @ se3.exp(noise)
        covariance = sigma**2 * np.diag(self.rng.uniform(0.5, 2.0, size=6))
        name: object = reference
        if quality == "outlier":
            T = T @ se3.exp(self.rng.normal(size=6) * self.rng.choice([0.1, 1.0, 30.0]))
        elif quality == "broken":
            T, covariance = damage(T, covariance, how)
            departed = sorted(set(self.stamps) - set(self.live()) - {frame})
            names = {"stranger": "x", "itself": frame, "departed": departed[0] if departed else -1}
            name = names.get(how, reference)
        return Edge(reference_id=name, T_reference_frame=T, covariance=covariance)

    def make_prior(self, frame: int, kind: str) -> Prior | None:
        if kind == "none":
            return None
        T = self.truths[frame] @ se3.exp(1e-2 * self.rng.normal(size=6))
        covariance = 1e-4 * np.eye(6)
        if kind == "position":
            return PositionPrior(position_world=T[:3, 3], covariance=1e-4 * np.eye(3))
        if kind == "wrong":
            return PositionPrior(
                position_world=T[:3, 3] + 5 * self.rng.normal(size=3), covariance=1e-6 * np.eye(3)
            )
        if kind == "no covariance":
            covariance = np.zeros((6, 6))
        else:
            T[0, 3] += {"pose": 0.0, "far": 1e3, "nan": np.nan, "absurd": 1e9}[kind]
        return PosePrior(T_world_frame=T, covariance=covariance)

    def add(self, wanted: list[tuple[int, str, float, str]], prior: str, gap: int) -> None:
        frame = len(self.stamps)
        stamp = gap * STEP_NS + max(self.stamps.values(), default=-gap * STEP_NS)
        step = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.3]) + 0.02 * self.rng.normal(size=6)
        newest = self.truths.get(frame - 1, np.eye(4))
        self.truths[frame] = newest @ se3.exp(step) if frame else newest
        if not has_poses(self):
            wanted = []
        edges = [
            self.measure(self.pick(number), frame, quality, sigma, how)
            for number, quality, sigma, how in wanted
        ]
        given = self.make_prior(frame, prior)
        self.stamps[frame] = stamp
        estimate = self.window.add_pose(frame, stamp, edges, given)
        self.check_answer(estimate, frame)
        assert len(estimate.rejected) <= len(edges) + (given is not None)
        for refused in estimate.rejected:
            self.check_refusal(refused, frame)
        if any(q == "broken" for _, q, _, _ in wanted) or prior in ("nan", "absurd"):
            assert estimate.rejected
        if given is not None and all(each.reference_id is not None for each in estimate.rejected):
            self.note_fix(frame)
        self.check_size()

    # What must hold.

    def check_answer(self, estimate: Estimate, frame: int) -> None:
        assert_sound(estimate)
        assert (estimate.frame_id, estimate.stamp_ns) == (frame, self.stamps[frame])
        if frame in self.window:
            np.testing.assert_allclose(self.window.pose(frame), estimate.T_world_frame, atol=1e-9)
        else:  # where GTSAM takes it not even alone it is reckoned, and handed over at once
            assert self.window.counts.n_restored > 0

    def check_refusal(self, refused: Estimate | Rejected, frame: object) -> None:
        assert isinstance(refused, Rejected)
        assert not refused
        assert refused.frame_id == frame
        assert refused.stamp_ns == (self.stamps.get(frame) if isinstance(frame, int) else None)
        assert refused.reason
        self.n_rejected += 1

    def note_fix(self, frame: int) -> None:
        if self.last_fix >= 0:
            self.fix_interval = max(self.fix_interval, frame - self.last_fix)
        self.last_fix = max(self.last_fix, frame)

    def check_size(self) -> None:
        if self.size is not None:
            kept = self.kept & set(self.live())
            size = max(self.size, self.fix_interval + 1)
            assert len(self.window) <= size + len(kept) + self.n_keyframes

    @invariant()
    def the_poses_of_the_window_are_sound(self) -> None:
        poses = self.window.poses()
        assert len(poses) == len(self.window)
        assert list(poses) == sorted(poses)  # type: ignore[type-var]
        last = len(self.stamps) - 1 if self.stamps else None
        # One that GTSAM takes not even alone is handed over without ever being there.
        assert self.window.newest == last or self.window.counts.n_restored > 0
        assert self.window.newest == next(reversed(poses), None)
        for frame, T in poses.items():
            assert frame in self.window
            assert se3.transform_fault(T, tolerance=1e-6) == ""

    @invariant()
    def what_is_counted_is_what_was_answered(self) -> None:
        assert self.window.counts.n_rejected == self.n_rejected
        assert self.window.counts.n_poses == len(self.stamps)

    # Right calls, and damaged data.

    @rule(wanted=edge_lists, prior=priors, gap=st.sampled_from([1, 1, 1, 7, 100]))
    def add_pose(self, wanted: list[tuple[int, str, float, str]], prior: str, gap: int) -> None:
        self.add(wanted, prior, gap)

    @rule()
    def add_pose_with_good_edges(self) -> None:
        self.add([(0, "good", 1e-2, ""), (1, "good", 1e-2, ""), (2, "good", 1e-2, "")], "none", 1)

    @rule(prior=priors, gap=st.sampled_from([1, 30]))
    def add_pose_without_edges(self, prior: str, gap: int) -> None:
        self.add([], prior, gap)

    @precondition(has_poses)
    @rule(
        pair=st.tuples(picks, picks),
        quality=qualities,
        sigma=st.sampled_from(SIGMAS),
        how=st.sampled_from(BREAKAGES),
    )
    def add_edge(self, pair: tuple[int, int], quality: str, sigma: float, how: str) -> None:
        reference, frame = self.pick(pair[0]), self.pick(pair[1])
        edge = self.measure(reference, frame, quality, sigma, how)
        before = self.before()
        answer = self.window.add_edge(frame, edge)
        self.check_late(answer, frame, before, is_good=quality != "broken" and reference != frame)

    @precondition(has_poses)
    @rule(number=picks, kind=priors.filter(lambda kind: kind != "none"))
    def add_prior(self, number: int, kind: str) -> None:
        frame = self.pick(number)
        before = self.before()
        prior = self.make_prior(frame, kind)
        assert prior is not None
        answer = self.window.add_prior(frame, prior)
        is_good = kind not in ("nan", "absurd", "no covariance")
        self.check_late(answer, frame, before, is_good=is_good)
        if answer:
            self.note_fix(frame)

    def check_late(
        self,
        answer: Estimate | Rejected,
        frame: int,
        before: tuple[int, dict[Any, FloatArray]],
        *,
        is_good: bool,
    ) -> None:
        if isinstance(answer, Estimate):
            assert is_good
            self.check_answer(answer, frame)
        else:
            self.check_refusal(answer, frame)
            self.check_unchanged(before)

    def before(self) -> tuple[int, dict[Any, FloatArray]]:
        return self.window.counts.n_restored, self.window.poses()

    def check_unchanged(self, before: tuple[int, dict[Any, FloatArray]]) -> None:
        n_restored, poses = before
        # A graph that was made anew is the same but for rounding, also thousands of km away.
        farthest = max(float(np.abs(T[:3, 3]).max()) for T in poses.values())
        atol = 0.0 if self.window.counts.n_restored == n_restored else 1e-6 * max(1.0, farthest)
        after = self.window.poses()
        assert list(after) == list(poses)
        for frame, T in after.items():
            np.testing.assert_allclose(T, poses[frame], rtol=0, atol=atol)

    @precondition(has_poses)
    @rule(number=picks)
    def keep(self, number: int) -> None:
        if len(self.kept & set(self.live())) < 4:
            frame = self.pick(number)
            self.window.keep(frame)
            self.kept.add(frame)

    @precondition(has_poses)
    @rule(number=picks)
    def release(self, number: int) -> None:
        frame = self.pick(number)
        self.window.release(frame)
        self.kept.discard(frame)

    @rule()
    def look(self) -> None:
        ids = self.live()
        for frame in ids:
            assert_covariance(self.window.covariance(frame))
            assert self.window.stamp_ns(frame) == self.stamps[frame]
        for edge in self.window.graph():
            assert edge.frame_id in ids
            assert edge.reference_id is None or edge.reference_id in ids
            assert np.isfinite(edge.residual).all()
            assert 0.0 <= edge.weight <= 1.0
            assert edge.chi2 == pytest.approx(edge.residual @ edge.residual)

    @precondition(has_poses)
    @rule(pair=st.tuples(picks, picks))
    def relate(self, pair: tuple[int, int]) -> None:
        a, b = self.pick(pair[0]), self.pick(pair[1])
        if a == b:
            return
        edge = self.window.relative_pose(a, b)
        assert edge.reference_id == a
        between = se3.invert(self.window.pose(a)) @ self.window.pose(b)
        np.testing.assert_allclose(edge.T_reference_frame, between, atol=1e-6)
        # The difference of two joint blocks: exact to the rounding of these.
        np.testing.assert_array_equal(edge.covariance, edge.covariance.T)
        sigmas = np.sqrt(np.diag(edge.covariance))
        assert (sigmas > 0).all()
        assert np.linalg.eigvalsh(edge.covariance / np.outer(sigmas, sigmas))[0] > -1e-9

    @rule()
    def pop_finished(self) -> None:
        self.popped += self.window.pop_finished()
        names = {e.frame_id for e in self.popped}
        assert set(self.live()) == set(self.stamps) - names
        assert self.window.pop_finished() == []

    # The end.

    def teardown(self) -> None:
        if self.stamps:
            self.check_end()

    def check_end(self) -> None:
        early = self.popped + self.window.pop_finished()
        last = self.window.finish()
        assert [e.stamp_ns for e in last] == sorted(e.stamp_ns for e in last)
        assert (len(self.window), self.live(), self.window.finish()) == (0, [], [])
        found = {e.frame_id: e for e in early + last}
        assert len(found) == len(early) + len(last)
        assert set(found) == set(self.stamps)
        for frame, estimate in found.items():
            assert estimate.stamp_ns == self.stamps[frame]  # type: ignore[index]
            assert_sound(estimate)


@pytest.mark.parametrize(
    ("n_examples", "n_steps"), [(25, 60), pytest.param(5, 400, marks=pytest.mark.acceptance)]
)
def test_any_mixture_of_calls_leaves_a_window_that_goes_on(n_examples: int, n_steps: int) -> None:
    run_state_machine_as_test(
        WindowMachine,
        settings=settings(
            max_examples=n_examples,
            stateful_step_count=n_steps,
            phases=[Phase.explicit, Phase.reuse, Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )
