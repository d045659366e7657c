"""What a window refuses, and that nothing of it stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

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
from tests.backend.twins import (
    CONFIG,
    FAULTY,
    NEWEST,
    POSE_PRIOR,
    POSITION_PRIOR,
    Act,
    Fault,
    N,
    assert_as_twin,
    assert_complete,
    good_edges,
    plain_twin,
    run,
    stamp_of,
    twin_without_edges,
    with_entry,
)
from tests.backend.walks import STEP, STEP_NS, edge, shifted, walk


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


# One of each kind: what is a fault of a value is tested where values are validated.
TRANSFORM_FAULTS: dict[str, Fault] = {
    "NaN in the rotation": with_entry(1, 0, np.nan),
    "a scaled rotation": lambda T: se3.make_transform(1.1 * T[:3, :3], T[:3, 3]),
    "a scale in the last row": with_entry(3, 3, 2.0),
    "1e300 m": with_entry(1, 3, 1e300),
}


def turned(diagonal: FloatArray) -> FloatArray:
    """Return a matrix of these eigenvalues that shows none of them on its diagonal."""
    n = len(diagonal)
    Q, _ = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))
    matrix = Q @ np.diag(diagonal) @ Q.T
    return np.asarray(0.5 * (matrix + matrix.T))


COVARIANCE_FAULTS: dict[str, Fault] = {
    "a covariance of NaN": lambda C: np.full_like(C, np.nan),
    "a zero covariance": np.zeros_like,
    "an indefinite covariance": lambda C: turned(np.r_[-1e-6, np.full(len(C) - 1, 1e-6)]),
    "an asymmetric covariance": with_entry(0, 1, 5e-7),
    "a covariance of 1e20": lambda C: 1e20 * np.eye(len(C)),
}
REFERENCE_FAULTS: dict[str, FrameId] = {
    "an unknown reference": "nobody",
    "a reference that left": 0,
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
def test_a_bad_edge_among_good_ones_is_refused_and_leaves_no_trace(fault: str) -> None:
    good = good_edges()[FAULTY]
    place = BAD_EDGES.index(fault) % 4
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
    bad = tuple(bad_edge(fault, good, FAULTY) for good in good_edges()[FAULTY])
    found = run(edges=bad)
    assert len(found.causal[FAULTY].rejected) == len(bad)
    for each, rejected in zip(bad, found.causal[FAULTY].rejected, strict=True):
        assert_names(rejected, FAULTY, stamp_of(FAULTY), each.reference_id)
    assert found.causal[FAULTY].status == Status.COASTING
    assert_as_twin(found, twin_without_edges())


@pytest.mark.parametrize("fault", BAD_EDGES)
def test_a_bad_edge_between_known_poses_is_refused_and_leaves_no_trace(fault: str) -> None:
    bad = bad_edge(fault, good_edges()[NEWEST][0], NEWEST)
    found = run(lambda window: window.add_edge(NEWEST, bad))
    assert_names(found.answer, NEWEST, stamp_of(NEWEST), bad.reference_id)
    assert_as_twin(found, plain_twin())
    assert found.window.counts.n_rejected == 1


BAD_PRIORS: dict[str, Prior] = {
    **{
        f"pose: {name}": replace(POSE_PRIOR, T_world_frame=fault(POSE_PRIOR.T_world_frame))
        for name, fault in TRANSFORM_FAULTS.items()
    },
    "pose: a zero covariance": replace(POSE_PRIOR, covariance=np.zeros((6, 6))),
    "position: an infinite coordinate": replace(
        POSITION_PRIOR, position_world=np.array([0.0, -np.inf, 0.0])
    ),
    "position: 1e9 m": replace(POSITION_PRIOR, position_world=np.array([0.0, 1e9, 0.0])),
    "position: a negative covariance": replace(POSITION_PRIOR, covariance=-np.eye(3)),
}


@pytest.mark.parametrize("fault", BAD_PRIORS)
@pytest.mark.parametrize("frame", [0, NEWEST, FAULTY], ids=["first", "late", "with its pose"])
def test_a_bad_prior_is_refused_and_leaves_no_trace(fault: str, frame: int) -> None:
    bad = BAD_PRIORS[fault]
    if frame == NEWEST:
        found = run(lambda window: window.add_prior(NEWEST, bad))
        refused = found.answer
    else:
        found = run(prior=bad) if frame else run(first_prior=bad)
        (refused,) = found.causal[frame].rejected
    assert_names(refused, frame, stamp_of(frame), None)
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


@pytest.mark.parametrize("jump", [0.5, 10.0, 1e3])
@pytest.mark.parametrize("kind", [PosePrior, PositionPrior])
def test_a_prior_that_contradicts_a_sure_window_is_believed(kind: type[Prior], jump: float) -> None:
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
            last, plain = (each.causal[-1].T_world_frame for each in (found, plain_twin()))
            assert np.linalg.norm(last[:3, 3] - plain[:3, 3]) > 0.01 * jump
        assert_complete(found)


def adding(*arguments: Any, **options: Any) -> Act:
    return lambda window: window.add_pose(*arguments, **options)


SOON = stamp_of(NEWEST) + 1


GOOD = good_edges()[FAULTY]


WRONG: Any = "wrong"
A_LIST: Any = ["a list"]


MISUSES: dict[str, Act] = {
    "a known name": adding(NEWEST, SOON, GOOD),
    "the name of an older pose": adding(NEWEST - 4, SOON, GOOD),
    "an equal stamp": adding("x", stamp_of(NEWEST), GOOD),
    "an earlier stamp": adding("x", stamp_of(2), GOOD),
    "a negative stamp": adding("x", -1, GOOD),
    "a float as stamp": adding("x", float(SOON), GOOD),
    "a NaN as stamp": adding("x", float("nan"), GOOD),
    "a truth value as stamp": adding("x", True, GOOD),
    "a truth value of numpy as stamp": adding("x", np.True_, GOOD),
    "a text as stamp": adding("x", str(SOON), GOOD),
    "no stamp": adding("x", None, GOOD),
    "a list as name": adding(A_LIST, SOON, GOOD),
    "no name": adding(None, SOON, GOOD),
    "an array as name": adding(np.zeros(2), SOON, GOOD),
    "a text as edges": adding("x", SOON, WRONG),
    "one edge that is none": adding("x", SOON, [*GOOD, WRONG]),
    "an array as edge": adding("x", SOON, [np.eye(4)]),
    "one edge in place of a list": adding("x", SOON, GOOD[0]),
    "no edges at all": adding("x", SOON, None),
    "a prior among the edges": adding("x", SOON, [POSE_PRIOR]),
    "an edge as prior": adding("x", SOON, GOOD, GOOD[0]),
    "an array as prior": adding("x", SOON, GOOD, np.eye(4)),
    "an edge to a list": lambda window: window.add_pose(
        "x", SOON, [replace(GOOD[0], reference_id=A_LIST)]
    ),
    "an edge of a list": lambda window: window.add_edge(A_LIST, GOOD[0]),
    "a prior of a list": lambda window: window.add_prior(A_LIST, POSE_PRIOR),
    "the pose of a list": lambda window: window.pose(A_LIST),
    "keep a list": lambda window: window.keep(A_LIST),
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


def test_a_stamp_may_be_a_number_of_numpy() -> None:
    window = SlidingWindow()
    found = window.add_pose("a", np.int64(7), [])  # type: ignore[arg-type]
    assert type(found.stamp_ns) is int
    assert (found.stamp_ns, window.stamp_ns("a")) == (7, 7)


def test_another_type_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be a gvo\.WindowConfig, got dict"):
        SlidingWindow().reconfigure({"size": 3})  # type: ignore[arg-type]


def test_what_goes_in_is_counted_once_and_what_is_refused_by_its_kind() -> None:
    window = walk(WindowConfig(size=9, kernel="none", gate=10.0), 6)
    place = PositionPrior(position_world=np.zeros(3), covariance=np.eye(3))
    known = window.relative_pose(1, 4).T_reference_frame
    assert isinstance(window.add_edge(4, edge(1, known)), Estimate)
    assert isinstance(window.add_prior(0, place), Estimate)
    assert [each.reference_id for each in window.edges(4)] == [3, 1]
    assert window.edges("nobody") == ()
    counts = window.counts
    assert (counts.n_poses, counts.n_edges, counts.n_priors) == (6, 6, 1)
    assert (counts.n_rejected, counts.n_gated, counts.n_coasting) == (0, 0, 0)
    assert counts.first_rejected == ""
    # By the gate; of itself; to nobody; not a place; and a pose without a usable edge.
    refused: list[object] = [
        window.add_edge(4, edge(1, se3.normalize(known @ shifted(z=50.0)))),
        window.add_edge(3, edge(3, STEP)),
        window.add_edge(3, edge("nobody", STEP)),
        window.add_edge("nobody", edge(3, STEP)),
        window.add_prior(
            3, PositionPrior(position_world=place.position_world + 1e9, covariance=np.eye(3))
        ),
        window.add_prior("nobody", place),
    ]
    for answer in refused:
        assert isinstance(answer, Rejected)
        assert not answer
    estimate = window.add_pose(6, 6 * STEP_NS, [edge("nobody", STEP)], place)
    counts = window.counts
    assert (counts.n_poses, counts.n_edges, counts.n_priors) == (7, 6, 2)
    assert (counts.n_rejected, counts.n_gated, counts.n_coasting) == (7, 1, 0)
    assert counts.first_rejected == str(refused[0])
    assert [each.reference_id for each in estimate.rejected] == ["nobody"]
    window.add_pose(7, 7 * STEP_NS, [])
    assert window.counts.n_coasting == 1


def test_the_gate_of_a_late_edge_is_in_sigmas_of_what_it_and_the_window_know() -> None:
    # Translations of steps along one line add up: four steps, and the edge itself.
    step_sigma, loop_sigma = 0.01, 0.03
    sigma = np.sqrt(4 * step_sigma**2 + loop_sigma**2)
    for n_sigmas, is_in in ((3.9, True), (4.1, False)):
        config = WindowConfig(size=9, kernel="none", gate=4.0)
        window = walk(config, 5, shifted(z=1.0), step_sigma)
        answer = window.add_edge(4, edge(0, shifted(z=4.0 + n_sigmas * sigma), loop_sigma))
        assert isinstance(answer, Estimate) == is_in
        if isinstance(answer, Rejected):
            assert "4.1 sigma" in answer.reason
            assert "window.gate: 4" in answer.reason
