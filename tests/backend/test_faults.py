"""Each fault that kills GTSAM, or poisons it in silence, beside a twin that never saw it.

A window is driven with good poses, meets one fault, and is driven on. Where nothing of the
fault may stay, every later estimate equals that of the twin.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import (
    Edge,
    Estimate,
    FloatArray,
    FrameId,
    PosePrior,
    PositionPrior,
    Prior,
    Rejected,
    Status,
)

STEP_NS = 100_000_000
N = 29  # eight good poses, the one with the fault, twenty good ones
FAULTY = 8  # the window of five holds 3 to 7 when it comes
NEWEST = FAULTY - 1
CONFIG = WindowConfig(size=5)

Act = Callable[[SlidingWindow], object]


def stamp_of(frame: int) -> int:
    return 1_000 + frame * STEP_NS


@cache
def true_poses() -> tuple[FloatArray, ...]:
    rng = np.random.default_rng(5)
    poses = [np.eye(4)]
    for _ in range(N - 1):
        twist = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.3]) + 0.02 * rng.normal(size=6)
        poses.append(poses[-1] @ se3.exp(twist))
    return tuple(poses)


@cache
def good_edges() -> tuple[tuple[Edge, ...], ...]:
    """Return for each pose edges to the three before it."""
    rng = np.random.default_rng(6)
    poses = true_poses()
    edges: list[tuple[Edge, ...]] = []
    for frame in range(N):
        measured = []
        for reference in range(max(frame - 3, 0), frame):
            mixing = np.eye(6) + 0.2 * rng.normal(size=(6, 6))
            covariance = 1e-6 * mixing @ mixing.T
            noise = se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
            T = se3.normalize(np.linalg.inv(poses[reference]) @ poses[frame] @ noise)
            measured.append(
                Edge(reference_id=reference, T_reference_frame=T, covariance=covariance)
            )
        edges.append(tuple(measured))
    return tuple(edges)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A window's whole life: what it answered to the fault and what it gave."""

    answer: object
    causal: list[Estimate]
    finished: list[Estimate]
    window: SlidingWindow


def run(
    act: Act | None = None,
    *,
    edges: Sequence[Edge] | None = None,
    prior: Prior | None = None,
    first_prior: Prior | None = None,
    config: WindowConfig = CONFIG,
) -> Run:
    """Drive a window; before pose 8 it meets `act`, with pose 8 come `edges` and `prior`."""
    window = SlidingWindow(config)
    causal: list[Estimate] = []
    finished: list[Estimate] = []
    answer: object = None
    for frame, frame_edges in enumerate(good_edges()):
        frame_prior = first_prior if frame == 0 else None
        if frame == FAULTY:
            answer = act(window) if act else None
            frame_edges = tuple(frame_edges if edges is None else edges)
            frame_prior = prior
        causal.append(window.add_pose(frame, stamp_of(frame), frame_edges, frame_prior))
        finished += window.pop_finished()
        # Where not even a pose alone goes in, it is handed over at once.
        assert (window.newest == frame) != any(e.frame_id == frame for e in finished)
    return Run(answer=answer, causal=causal, finished=finished + window.finish(), window=window)


@cache
def plain_twin() -> Run:
    return run()


@cache
def twin_without_edges() -> Run:
    return run(edges=())


def assert_sound(estimate: Estimate) -> None:
    T, covariance = estimate.T_world_cam, estimate.covariance
    assert np.isfinite(T).all()
    assert np.isfinite(covariance).all()
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-15)
    sigmas = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(sigmas, sigmas))[0] > 0


def assert_complete(found: Run, n: int = N) -> None:
    """Check that each pose came out once, sound, under its own stamp."""
    assert sorted(number(e.frame_id) for e in found.finished) == list(range(n))
    for estimate in [*found.causal, *found.finished]:
        assert_sound(estimate)
        assert estimate.stamp_ns == stamp_of(number(estimate.frame_id))


def number(frame_id: FrameId) -> int:
    assert isinstance(frame_id, int)
    return frame_id


def assert_as_twin(found: Run, twin: Run) -> None:
    assert_complete(found)
    for ours, theirs in ((found.causal, twin.causal), (found.finished, twin.finished)):
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            assert (one.frame_id, one.stamp_ns) == (other.frame_id, other.stamp_ns)
            assert one.status == other.status
            np.testing.assert_allclose(one.T_world_cam, other.T_world_cam, rtol=0, atol=1e-9)
            scale = np.abs(other.covariance).max()
            np.testing.assert_allclose(
                one.covariance / scale, other.covariance / scale, rtol=0, atol=1e-9
            )


def assert_names(
    answer: object, frame_id: FrameId, stamp_ns: int | None, reference_id: FrameId
) -> None:
    """Check that a refusal says in one line what was refused, in the caller's own names."""
    assert isinstance(answer, Rejected)
    assert not answer
    assert (answer.frame_id, answer.stamp_ns) == (frame_id, stamp_ns)
    assert answer.reference_id is reference_id or answer.reference_id == reference_id
    assert answer.reason.strip()
    line = str(answer)
    assert "\n" not in line
    for name in (frame_id, reference_id, stamp_ns):
        assert name is None or repr(name) in line


# Faults of a measured transform and of a covariance, made of good ones.
Fault = Callable[[FloatArray], FloatArray]


def with_entry(row: int, column: int, value: float) -> Fault:
    def change(matrix: FloatArray) -> FloatArray:
        changed = matrix.copy()
        changed[row, column] = value
        return changed

    return change


def with_rotation(R: FloatArray) -> Fault:
    return lambda T: se3.make_transform(T[:3, :3] @ R, T[:3, 3])


GARBAGE = np.random.default_rng(0).normal(size=(3, 3))
SHEAR = np.array([[1.0, 0.02, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

TRANSFORM_FAULTS: dict[str, Fault] = {
    "NaN in the rotation": with_entry(1, 0, np.nan),
    "infinity in the rotation": with_entry(2, 2, -np.inf),
    "NaN in the translation": with_entry(0, 3, np.nan),
    "infinity in the translation": with_entry(2, 3, np.inf),
    "NaN everywhere": lambda T: np.full((4, 4), np.nan),
    "all zeros": lambda T: np.zeros((4, 4)),
    "random numbers as rotation": with_rotation(GARBAGE),
    "a zero rotation": with_rotation(np.zeros((3, 3))),
    "a scaled rotation": with_rotation(1.1 * np.eye(3)),
    "a huge rotation": with_rotation(1e200 * np.eye(3)),
    "a reflection": with_rotation(np.diag([1.0, 1.0, -1.0])),
    "a point reflection": with_rotation(-np.eye(3)),
    "a shear": with_rotation(SHEAR),
    "a scale in the last row": with_entry(3, 3, 2.0),
    "a perspective in the last row": with_entry(3, 0, 1.0),
    "a zero last row": with_entry(3, 3, 0.0),
    "NaN in the last row": with_entry(3, 1, np.nan),
    "a transposed transform": lambda T: np.array(T.T),
    "1e9 m": with_entry(0, 3, 1e9),
    "1e300 m": with_entry(1, 3, 1e300),
    "-1e308 m": with_entry(2, 3, -1e308),
}


def turned(diagonal: FloatArray) -> FloatArray:
    """Return a matrix of these eigenvalues that shows none of them on its diagonal."""
    n = len(diagonal)
    Q, _ = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))
    matrix = Q @ np.diag(diagonal) @ Q.T
    return np.asarray(0.5 * (matrix + matrix.T))


COVARIANCE_FAULTS: dict[str, Fault] = {
    "a covariance with NaN": with_entry(0, 0, np.nan),
    "a covariance with NaN beside the diagonal": with_entry(0, 1, np.nan),
    "a covariance of NaN": lambda C: np.full_like(C, np.nan),
    "an infinite variance": with_entry(2, 2, np.inf),
    "a zero covariance": np.zeros_like,
    "a zero variance": lambda C: turned(1e-6 * np.arange(len(C), dtype=float)),
    "a negative covariance": lambda C: -C,
    "an indefinite covariance": lambda C: turned(np.r_[-1e-6, np.full(len(C) - 1, 1e-6)]),
    "correlations above one": lambda C: np.asarray(1e-6 * (2.0 * np.ones_like(C) - np.eye(len(C)))),
    "an asymmetric covariance": with_entry(0, 1, 5e-7),
    "a covariance of 1e-20": lambda C: 1e-20 * np.eye(len(C)),
    "a covariance of 1e20": lambda C: 1e20 * np.eye(len(C)),
    "a covariance of 1e-310": lambda C: 1e-310 * np.eye(len(C)),
    "a covariance of 1e300": lambda C: 1e300 * np.eye(len(C)),
}

REFERENCE_FAULTS: dict[str, FrameId] = {
    "an unknown reference": "nobody",
    "a reference that left": 0,
    "a reference to come": FAULTY + 1,
    "a reference of another type": (1, 2),
    "a reference that is no number": float("nan"),
    "no reference": None,
}


def bad_edge(fault: str, good: Edge, frame: int) -> Edge:
    """Return an edge of this frame with one fault."""
    if fault in TRANSFORM_FAULTS:
        return replace(good, T_reference_frame=TRANSFORM_FAULTS[fault](good.T_reference_frame))
    if fault in COVARIANCE_FAULTS:
        return replace(good, covariance=COVARIANCE_FAULTS[fault](good.covariance))
    return replace(good, reference_id=REFERENCE_FAULTS.get(fault, frame))


BAD_EDGES = [*TRANSFORM_FAULTS, *COVARIANCE_FAULTS, *REFERENCE_FAULTS, "an edge to itself"]


@pytest.mark.parametrize("fault", BAD_EDGES)
@pytest.mark.parametrize("place", [0, 3])
def test_a_bad_edge_among_good_ones_is_refused_and_leaves_no_trace(fault: str, place: int) -> None:
    good = good_edges()[FAULTY]
    bad = bad_edge(fault, good[-1], FAULTY)
    found = run(edges=(*good[:place], bad, *good[place:]))
    rejected = found.causal[FAULTY].rejected
    assert len(rejected) == 1
    assert_names(rejected[0], FAULTY, stamp_of(FAULTY), bad.reference_id)
    assert_as_twin(found, plain_twin())
    assert found.window.counts.n_rejected == 1
    assert repr(FAULTY) in found.window.counts.first_rejected
    assert str(stamp_of(FAULTY)) in found.window.counts.first_rejected


@pytest.mark.parametrize("fault", BAD_EDGES)
def test_a_pose_whose_edges_are_all_bad_is_a_pose_without_edges(fault: str) -> None:
    bad = tuple(bad_edge(fault, edge, FAULTY) for edge in good_edges()[FAULTY])
    found = run(edges=bad)
    assert len(found.causal[FAULTY].rejected) == len(bad)
    for edge, rejected in zip(bad, found.causal[FAULTY].rejected, strict=True):
        assert_names(rejected, FAULTY, stamp_of(FAULTY), edge.reference_id)
    assert found.causal[FAULTY].status == Status.COASTING
    assert_as_twin(found, twin_without_edges())


@pytest.mark.parametrize("fault", BAD_EDGES)
def test_a_bad_edge_between_known_poses_is_refused_and_leaves_no_trace(fault: str) -> None:
    good = good_edges()[NEWEST][0]
    bad = bad_edge(fault, good, NEWEST)
    found = run(lambda window: window.add_edge(NEWEST, bad))
    assert_names(found.answer, NEWEST, stamp_of(NEWEST), bad.reference_id)
    assert_as_twin(found, plain_twin())
    assert found.window.counts.n_rejected == 1


def test_all_kinds_of_bad_edges_at_once_are_refused_one_by_one() -> None:
    good = good_edges()[FAULTY]
    bad = [bad_edge(fault, good[-1], FAULTY) for fault in BAD_EDGES]
    found = run(edges=(*bad, *good, *bad))
    rejected = found.causal[FAULTY].rejected
    assert len(rejected) == 2 * len(bad) == found.window.counts.n_rejected
    assert_as_twin(found, plain_twin())


POSE_PRIOR = PosePrior(T_world_frame=true_poses()[NEWEST], covariance=1e-4 * np.eye(6))
POSITION_PRIOR = PositionPrior(
    position_world=true_poses()[NEWEST][:3, 3], covariance=1e-4 * np.eye(3)
)

BAD_PRIORS: dict[str, Prior] = {
    **{
        f"pose: {name}": replace(POSE_PRIOR, T_world_frame=fault(POSE_PRIOR.T_world_frame))
        for name, fault in TRANSFORM_FAULTS.items()
    },
    **{
        f"pose: {name}": replace(POSE_PRIOR, covariance=fault(POSE_PRIOR.covariance))
        for name, fault in COVARIANCE_FAULTS.items()
    },
    **{
        f"position: {name}": replace(POSITION_PRIOR, covariance=fault(POSITION_PRIOR.covariance))
        for name, fault in COVARIANCE_FAULTS.items()
    },
    **{
        f"position: {value}": replace(POSITION_PRIOR, position_world=np.array([0.0, value, 0.0]))
        for value in (np.nan, np.inf, -np.inf, 1e9, -1e300)
    },
}


@pytest.mark.parametrize("fault", BAD_PRIORS)
def test_a_bad_prior_with_a_pose_is_refused_and_leaves_no_trace(fault: str) -> None:
    found = run(prior=BAD_PRIORS[fault])
    assert len(found.causal[FAULTY].rejected) == 1
    assert_names(found.causal[FAULTY].rejected[0], FAULTY, stamp_of(FAULTY), None)
    assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("fault", BAD_PRIORS)
def test_a_bad_prior_of_a_known_pose_is_refused_and_leaves_no_trace(fault: str) -> None:
    found = run(lambda window: window.add_prior(NEWEST, BAD_PRIORS[fault]))
    assert_names(found.answer, NEWEST, stamp_of(NEWEST), None)
    assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("fault", BAD_PRIORS)
def test_a_first_pose_with_a_bad_prior_starts_as_if_there_were_none(fault: str) -> None:
    found = run(first_prior=BAD_PRIORS[fault])
    assert len(found.causal[0].rejected) == 1
    assert_names(found.causal[0].rejected[0], 0, stamp_of(0), None)
    assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("frame_id", [0, FAULTY, "nobody", None, (1, 2)])
def test_an_edge_or_a_prior_of_an_unknown_pose_is_refused(frame_id: FrameId) -> None:
    edge = replace(good_edges()[NEWEST][0])
    found = run(lambda window: window.add_edge(frame_id, edge))
    assert isinstance(found.answer, Rejected)
    assert (found.answer.frame_id, found.answer.reference_id) == (frame_id, edge.reference_id)
    assert_as_twin(found, plain_twin())
    found = run(lambda window: window.add_prior(frame_id, POSE_PRIOR))
    assert isinstance(found.answer, Rejected)
    assert found.answer.frame_id == frame_id
    assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("jump", [0.5, 10.0, 1e4])
def test_an_edge_that_contradicts_all_others_is_refused_and_leaves_no_trace(jump: float) -> None:
    good = good_edges()[NEWEST][0]
    moved = replace(good, T_reference_frame=with_entry(0, 3, jump)(good.T_reference_frame))
    found = run(lambda window: window.add_edge(NEWEST, moved))
    assert_names(found.answer, NEWEST, stamp_of(NEWEST), good.reference_id)
    assert_as_twin(found, plain_twin())
    turned_round = replace(
        good,
        T_reference_frame=good.T_reference_frame @ se3.exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0])),
    )
    found = run(lambda window: window.add_edge(NEWEST, turned_round))
    assert_names(found.answer, NEWEST, stamp_of(NEWEST), good.reference_id)
    assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("jump", [0.5, 10.0, 1e3])
@pytest.mark.parametrize("kind", [PosePrior, PositionPrior])
def test_a_prior_that_contradicts_a_sure_window_is_believed_and_the_window_goes_on(
    kind: type[Prior], jump: float
) -> None:
    moved: Prior
    if kind is PosePrior:
        moved = PosePrior(
            T_world_frame=with_entry(0, 3, jump)(POSE_PRIOR.T_world_frame),
            covariance=1e-6 * np.eye(6),
        )
    else:
        position = POSITION_PRIOR.position_world + np.array([jump, 0.0, 0.0])
        moved = PositionPrior(position_world=position, covariance=1e-6 * np.eye(3), kernel="none")
    for found in (run(lambda window: window.add_prior(NEWEST, moved)), run(prior=moved)):
        if jump < 100.0:  # beyond, no step of Gauss-Newton comes back
            assert found.window.counts.n_priors == 1
            assert (
                abs(found.causal[-1].T_world_cam[0, 3] - plain_twin().causal[-1].T_world_cam[0, 3])
                > 0.01 * jump
            )
        assert_complete(found)


def test_arrays_rounded_to_single_precision_are_good_enough() -> None:
    def rounded(edge: Edge) -> Edge:
        return replace(
            edge,
            T_reference_frame=edge.T_reference_frame.astype(np.float32),
            covariance=edge.covariance.astype(np.float32),
        )

    found = run(edges=tuple(rounded(edge) for edge in good_edges()[FAULTY]))
    assert found.causal[FAULTY].rejected == ()
    assert_complete(found)
    for one, other in zip(found.causal, plain_twin().causal, strict=True):
        np.testing.assert_allclose(one.T_world_cam, other.T_world_cam, atol=1e-5)


def unhashable_edge() -> Edge:
    return replace(good_edges()[FAULTY][0], reference_id=["a list"])  # type: ignore[arg-type]


def adding(*arguments: Any, **options: Any) -> Act:
    return lambda window: window.add_pose(*arguments, **options)


SOON = stamp_of(NEWEST) + 1
GOOD = good_edges()[FAULTY]
WRONG: Any = "wrong"

MISUSES: dict[str, Act] = {
    "a known name": adding(NEWEST, SOON, GOOD),
    "the name of an older pose": adding(NEWEST - 4, SOON, GOOD),
    "an equal stamp": adding("x", stamp_of(NEWEST), GOOD),
    "an earlier stamp": adding("x", stamp_of(2), GOOD),
    "a negative stamp": adding("x", -1, GOOD),
    "a float as stamp": adding("x", float(SOON), GOOD),
    "a NaN as stamp": adding("x", float("nan"), GOOD),
    "a text as stamp": adding("x", str(SOON), GOOD),
    "no stamp": adding("x", None, GOOD),
    "a list as name": adding([1], SOON, GOOD),
    "an array as name": adding(np.zeros(2), SOON, GOOD),
    "a text as edges": adding("x", SOON, WRONG),
    "one edge that is none": adding("x", SOON, [*GOOD, WRONG]),
    "an array as edge": adding("x", SOON, [np.eye(4)]),
    "one edge in place of a list": adding("x", SOON, GOOD[0]),
    "no edges at all": adding("x", SOON, None),
    "a prior among the edges": adding("x", SOON, [POSE_PRIOR]),
    "an edge as prior": adding("x", SOON, GOOD, GOOD[0]),
    "an array as prior": adding("x", SOON, GOOD, np.eye(4)),
    "an edge to a list": lambda window: window.add_pose("x", SOON, [unhashable_edge()]),
    "an edge that is none": lambda window: window.add_edge(NEWEST, WRONG),
    "a prior in place of an edge": lambda window: window.add_edge(NEWEST, POSE_PRIOR),  # type: ignore[arg-type]
    "a prior that is none": lambda window: window.add_prior(NEWEST, WRONG),
    "an edge in place of a prior": lambda window: window.add_prior(NEWEST, GOOD[0]),  # type: ignore[arg-type]
    "keep an unknown pose": lambda window: window.keep("nobody"),
    "keep a pose that left": lambda window: window.keep(0),
    "release an unknown pose": lambda window: window.release("nobody"),
    "release a pose that left": lambda window: window.release(0),
    "covariance of an unknown pose": lambda window: window.covariance("nobody"),
    "covariance of a pose that left": lambda window: window.covariance(0),
    "pose of an unknown pose": lambda window: window.pose("nobody"),
    "stamp of an unknown pose": lambda window: window.stamp_ns("nobody"),
    "relative pose of an unknown pose": lambda window: window.relative_pose(NEWEST, "nobody"),
    "relative pose to a pose that left": lambda window: window.relative_pose(0, NEWEST),
}


@pytest.mark.parametrize("misuse", MISUSES)
def test_misuse_is_a_value_error_and_leaves_no_trace(misuse: str) -> None:
    def act(window: SlidingWindow) -> None:
        before = window.poses()
        with pytest.raises(ValueError, match=r"\S") as caught:
            MISUSES[misuse](window)
        assert "\n" not in str(caught.value)
        assert list(window.poses()) == list(before)

    found = run(act)
    assert_as_twin(found, plain_twin())
    assert found.window.counts.n_rejected == 0
    assert found.window.counts.n_poses == N


def test_a_first_pose_with_edges_is_misuse_and_the_window_can_still_begin() -> None:
    window = SlidingWindow(CONFIG)
    with pytest.raises(ValueError, match="'b'"):
        window.add_pose("b", 0, [replace(GOOD[0], reference_id="a")])
    assert len(window) == 0
    assert window.newest is None
    assert window.add_pose("b", 0, []).frame_id == "b"


def test_an_unknown_choice_of_keyframes_is_misuse() -> None:
    with pytest.raises(ValueError, match="sometimes"):
        SlidingWindow(keyframes="sometimes")  # type: ignore[arg-type]


def test_an_empty_window_refuses_finishes_and_begins_again() -> None:
    window = SlidingWindow(CONFIG)
    assert window.finish() == []
    assert window.pop_finished() == []
    assert window.graph() == []
    assert window.poses() == {}
    assert not window.add_edge(1, GOOD[0])
    assert not window.add_prior(1, POSE_PRIOR)
    window.add_pose("a", 10, [])
    assert [e.frame_id for e in window.finish()] == ["a"]
    assert (len(window), "a" in window, window.newest) == (0, False, None)
    window.add_pose("a", 5, [], POSE_PRIOR)  # another recording, from its own start
    np.testing.assert_allclose(window.pose("a"), POSE_PRIOR.T_world_frame, atol=1e-9)
    assert [e.stamp_ns for e in window.finish()] == [5]


# A pose without edges.


def straight_window(n: int = 4, config: WindowConfig = CONFIG) -> tuple[SlidingWindow, FloatArray]:
    """Return a window that moved by the same step n - 1 times, and that step."""
    step = se3.exp(np.array([0.02, 0.05, -0.01, 0.1, 0.0, 0.3]))
    window = SlidingWindow(config)
    for frame in range(n):
        edge = Edge(reference_id=frame - 1, T_reference_frame=step, covariance=1e-6 * np.eye(6))
        window.add_pose(frame, stamp_of(frame), [edge] if frame else [])
    return window, step


def test_a_pose_without_edges_continues_the_last_velocity() -> None:
    for share in (0.5, 1.0, 3.0):
        window, step = straight_window()
        newest = window.pose(3)
        estimate = window.add_pose("x", stamp_of(3) + round(share * STEP_NS), [])
        assert estimate.status == Status.COASTING
        assert estimate.rejected == ()
        expected = newest @ se3.exp(share * se3.log(step))
        np.testing.assert_allclose(estimate.T_world_cam, expected, atol=1e-6)
        assert window.counts.n_coasting == 1
        assert [e.status for e in window.finish()][-1] == Status.COASTING


def test_the_covariance_of_coasting_grows_by_the_sigmas_per_second() -> None:
    for seconds in (0.1, 0.5, 2.0):
        window, _ = straight_window()
        before = window.covariance(3)
        estimate = window.add_pose("x", stamp_of(3) + round(seconds * 1e9), [])
        turn = np.deg2rad(CONFIG.coasting_sigma_deg_per_s) * seconds
        shift = CONFIG.coasting_sigma_m_per_s * seconds
        sigmas = np.r_[np.full(3, turn), np.full(3, shift)]
        Ad = se3.adjoint(se3.invert(window.pose("x")) @ window.pose(3))
        expected = Ad @ before @ Ad.T + np.diag(sigmas**2)
        scale = np.outer(sigmas, sigmas)
        np.testing.assert_allclose(estimate.covariance / scale, expected / scale, atol=1e-3)


def test_the_second_pose_without_edges_stays_where_the_first_is() -> None:
    window = SlidingWindow(CONFIG)
    window.add_pose("a", 0, [], POSE_PRIOR)
    estimate = window.add_pose("b", STEP_NS, [])
    assert estimate.status == Status.COASTING
    np.testing.assert_allclose(estimate.T_world_cam, POSE_PRIOR.T_world_frame, atol=1e-6)


def test_a_gap_of_many_poses_loses_none_and_an_edge_across_it_brings_all_back() -> None:
    window, step = straight_window(config=WindowConfig(size=60, kernel="none"))
    last = 3
    for frame in range(4, 44):
        estimate = window.add_pose(frame, stamp_of(frame), [])
        assert_sound(estimate)
        seconds = 1e-9 * (stamp_of(frame) - stamp_of(last))
        if abs(seconds - CONFIG.lost_after_s) > 0.15:  # a step more or less is all the same
            is_lost = seconds > CONFIG.lost_after_s
            assert estimate.status == (Status.LOST if is_lost else Status.COASTING)
    across = step @ step
    edge = Edge(reference_id=last, T_reference_frame=across, covariance=1e-6 * np.eye(6))
    back = window.add_pose(44, stamp_of(44), [edge])
    assert back.rejected == ()
    assert back.status == Status.RESUMED
    assert window.counts.n_coasting == 40
    np.testing.assert_allclose(back.T_world_cam, window.pose(last) @ across, atol=1e-5)
    assert [e.frame_id for e in window.finish()] == list(range(45))


def test_a_full_prior_alone_is_enough_for_a_pose() -> None:
    window, _ = straight_window()
    place = se3.exp(np.array([0.1, 0.2, 0.3, 5.0, 6.0, 7.0]))
    prior = PosePrior(T_world_frame=place, covariance=1e-4 * np.eye(6))
    estimate = window.add_pose("x", stamp_of(4), [], prior)
    assert (estimate.status, estimate.rejected) == (Status.OK, ())
    np.testing.assert_allclose(estimate.T_world_cam, place, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance, 1e-4 * np.eye(6), atol=1e-6)
    assert [e.frame_id for e in window.finish()] == [0, 1, 2, 3, "x"]


def test_a_position_alone_holds_a_coasting_pose() -> None:
    window, step = straight_window()
    place = (window.pose(3) @ step)[:3, 3] + [0.1, -0.1, 0.05]
    prior = PositionPrior(position_world=place, covariance=1e-6 * np.eye(3))
    estimate = window.add_pose("x", stamp_of(4), [], prior)
    assert estimate.rejected == ()
    np.testing.assert_allclose(estimate.T_world_cam[:3, 3], place, atol=1e-3)
    assert np.diag(estimate.covariance)[3:].max() < 1.1e-6


# GTSAM throwing all the same.


@contextmanager
def failing(
    name: str, calls: Sequence[int] | range, error: type[Exception] = RuntimeError
) -> Iterator[list[int]]:
    """Make a method of GTSAM's ISAM2 fail at these calls, counted from here."""
    original = getattr(gtsam.ISAM2, name)
    seen, failed = [0], []

    def give_up(self: Any, *arguments: Any, **options: Any) -> Any:
        call = seen[0]
        seen[0] += 1
        if call in calls:
            failed.append(call)
            raise error("Indeterminant linear system detected\nand more lines")
        return original(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, name, give_up)
        yield failed


def run_failing(
    name: str, calls: Sequence[int] | range, error: type[Exception] = RuntimeError
) -> tuple[Run, list[int]]:
    """Drive a window while GTSAM fails at these calls since pose 8."""
    failures: list[list[int]] = []
    with ExitStack() as stack:
        found = run(lambda _: failures.append(stack.enter_context(failing(name, calls, error))))
    return found, failures[0]


@pytest.mark.parametrize("error", [RuntimeError, IndexError])
def test_one_failing_update_is_undone_and_its_pose_coasts(
    error: type[Exception], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="gvo"):
        found, failed = run_failing("update", [0], error)
    assert failed == [0]
    assert found.causal[FAULTY].status == Status.COASTING
    assert_as_twin(found, twin_without_edges())
    assert (found.window.counts.n_restored, found.window.counts.n_rebuilt) == (1, 0)
    told = [record for record in caplog.records if record.name.split(".")[0] == "gvo"]
    assert len(told) == 1
    line = told[0].getMessage()
    assert repr(FAULTY) in line
    assert "\n" not in line


def test_an_update_and_its_coasting_failing_restart_the_graph(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING, logger="gvo"):
        found, failed = run_failing("update", [0, 1])
    assert failed == [0, 1]
    assert_complete(found)
    assert found.window.counts.n_rebuilt == 1
    assert found.window.counts.n_restored >= 1
    assert any(record.name.split(".")[0] == "gvo" for record in caplog.records)
    # What follows hangs on the pose the graph began again from: the motion is kept.
    for frame in range(FAULTY + 4, N):
        ours = np.linalg.inv(found.causal[frame - 1].T_world_cam) @ found.causal[frame].T_world_cam
        theirs = np.linalg.inv(true_poses()[frame - 1]) @ true_poses()[frame]
        np.testing.assert_allclose(ours, theirs, atol=0.02)


@pytest.mark.parametrize("n_failures", [3, 4, 5, 10, 40, 10_000])
def test_nothing_is_lost_when_updates_fail_many_times_in_a_row(n_failures: int) -> None:
    found, failed = run_failing("update", range(n_failures))
    assert len(failed) >= min(n_failures, N - FAULTY)
    assert_complete(found)
    assert found.window.counts.n_poses == N
    assert found.window.counts.n_restored >= 1


@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(calls=st.sets(st.integers(0, 60), min_size=1))
def test_nothing_is_lost_wherever_updates_fail(calls: set[int]) -> None:
    with failing("update", sorted(calls)) as failed:
        found = run()
    assert_complete(found)
    if failed:
        assert found.window.counts.n_restored >= 1
    else:
        assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("name", ["marginalizeLeaves", "jointMarginalCovariance"])
@pytest.mark.parametrize("n_failures", [1, 2, 3, 10])
def test_nothing_is_lost_when_other_steps_of_gtsam_fail(name: str, n_failures: int) -> None:
    found, failed = run_failing(name, range(n_failures))
    assert failed
    assert_complete(found)
    assert found.window.counts.n_restored >= 1


@pytest.mark.parametrize(
    "act",
    [
        lambda window: window.add_edge(NEWEST, good_edges()[NEWEST][0]),
        lambda window: window.add_prior(NEWEST, POSITION_PRIOR),
        lambda window: window.add_prior(NEWEST, POSE_PRIOR),
    ],
    ids=["an edge", "a position", "a pose"],
)
def test_an_edge_or_a_prior_at_which_gtsam_fails_is_refused_and_leaves_no_trace(act: Act) -> None:
    def act_and_fail(window: SlidingWindow) -> object:
        before = window.poses()
        with failing("update", [0]) as failed:
            answer = act(window)
        assert failed == [0]
        for name, pose in window.poses().items():
            np.testing.assert_array_equal(pose, before[name])
        return answer

    found = run(act_and_fail)
    assert isinstance(found.answer, Rejected)
    assert found.answer.frame_id == NEWEST
    assert_as_twin(found, plain_twin())
    assert found.window.counts.n_restored == 1


def test_a_polish_that_fails_leaves_the_estimates_as_they_were(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failed = []

    def give_up(*_: Any) -> None:
        failed.append(True)
        raise RuntimeError("Indeterminant linear system detected\nand more lines")

    window = SlidingWindow(WindowConfig(size=None))
    for frame, frame_edges in enumerate(good_edges()):
        window.add_pose(frame, stamp_of(frame), frame_edges)
    before = window.poses()
    for name in ("optimize", "optimizeSafely", "iterate"):
        monkeypatch.setattr(gtsam.LevenbergMarquardtOptimizer, name, give_up)
    with caplog.at_level(logging.WARNING, logger="gvo"):
        finished = window.finish()
    assert failed
    assert [e.frame_id for e in finished] == list(range(N))
    for estimate in finished:
        assert_sound(estimate)
        np.testing.assert_allclose(
            estimate.T_world_cam, before[number(estimate.frame_id)], atol=1e-9
        )
    assert any(record.name.split(".")[0] == "gvo" for record in caplog.records)
