"""Loops connect what a lost camera measured before and after; odometry tells which are false."""

from collections.abc import Container
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.odometry.graph import RunGraph
from gvo.odometry.loops import LoopDetector
from gvo.types import Edge, Failure, FloatArray, Optimum, RelativePose, Status
from tests.make.results import estimate_at
from tests.odometry.drives import (
    PERIOD_NS,
    SIGMAS,
    Drive,
    MadeUpPlaces,
    block,
    measured,
    poses,
    position_error,
)

N_LAP = 100
# Dark frames; the guess is wrong by far from the first one on.
DARK = range(50, 55)
AWAY = se3.exp(np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5]))
TWIN = se3.exp(np.array([0.0, 0.01, 0.0, 0.1, 0.0, 0.3]))


def lit_again(
    truth: FloatArray,
    *,
    dark: range = DARK,
    away: FloatArray = AWAY,
    status: Status = Status.LOST,
) -> Drive:
    """Return a drive without measurements of dark frames, and none across them."""
    drive = Drive(truth)
    T_guess_truth = truth[dark.start] @ away @ se3.invert(truth[dark.start])
    for j, T in enumerate(truth):
        edges: list[Edge] = []
        if j > 0 and j not in dark and j != dark.stop:
            edges = [measured(truth, j - 1, j, SIGMAS, None)]
        is_dark = j in dark or j == dark.stop
        estimate = estimate_at(
            j * PERIOD_NS,
            T if j < dark.start else T_guess_truth @ T,
            covariance=np.eye(6) if j < dark.start else 4.0 * np.eye(6),
            status=status if is_dark else Status.OK,
        )
        drive.graph.add_frame(estimate, edges, is_place=j % 5 == 0 and not is_dark)
    return drive


def bright(optimum: Optimum, truth: FloatArray) -> float:
    """Return the error of the frames that were measured."""
    seen = [j for j in range(len(truth)) if j not in DARK and j != DARK.stop]
    return position_error(poses(optimum)[seen], truth[seen])


@pytest.mark.parametrize("status", [Status.COASTING, Status.LOST])
def test_a_loop_takes_what_came_after_the_dark_to_its_place(status: Status) -> None:
    truth = block(1.2, n_per_lap=N_LAP)
    drive = lit_again(truth, status=status)
    before = bright(drive.graph.optimize(), truth)
    drive.graph.loops = [drive.loop(5 * k, N_LAP + 5 * k) for k in range(3)]
    optimum = drive.graph.optimize()
    assert before > 1.0
    assert not any(loop.reason for loop in optimum.loops)
    assert bright(optimum, truth) < 0.01
    assert max(float(each.covariance[3, 3]) for each in optimum.estimates[60:]) < 0.1


def test_without_a_loop_across_it_stays_where_it_was_guessed_as_uncertain_as_that() -> None:
    truth = block(1.0, n_per_lap=N_LAP)
    drive = lit_again(truth)
    drive.graph.loops = [drive.loop(30, 40)]
    optimum = drive.graph.optimize()
    found = se3.invert(poses(optimum)[60]) @ poses(optimum)[-1]
    np.testing.assert_allclose(found, se3.invert(truth[60]) @ truth[-1], atol=1e-6)
    assert float(optimum.estimates[40].covariance[3, 3]) < 0.1
    assert float(optimum.estimates[-1].covariance[3, 3]) > 4.0


def test_false_loops_after_a_loss_are_refused_where_more_true_ones_follow() -> None:
    truth = block(1.4, n_per_lap=400)
    # Ten seconds, in which it may have come to the other side of the block.
    drive = lit_again(truth, dark=range(80, 180))
    false = [drive.loop(20 * k, 200 + 20 * k, T=TWIN) for k in range(3)]
    true = [drive.loop(20 * k, 400 + 20 * k) for k in range(4)]
    drive.graph.loops = false
    # with nothing against them they count
    assert not any(loop.reason for loop in drive.graph.optimize().loops)
    drive.graph.loops = [*false, *true]
    optimum = drive.graph.optimize()
    assert [bool(loop.reason) for loop in optimum.loops] == [True] * 3 + [False] * 4
    assert position_error(poses(optimum)[190:], truth[190:]) < 0.01


def test_a_twin_that_lies_farther_than_one_drives_in_the_dark_is_refused() -> None:
    truth = block(1.4, n_per_lap=N_LAP)
    drive = lit_again(truth, dark=range(20, 25))
    drive.graph.loops = [drive.loop(5 * k, 50 + 5 * k, T=TWIN) for k in range(3)]
    loops = drive.graph.optimize().loops
    assert {loop.reason for loop in loops} == {"farther from odometry than that drifts"}
    drive.graph.loops = [drive.loop(5 * k, N_LAP + 5 * k) for k in range(3)]
    assert not any(loop.reason for loop in drive.graph.optimize().loops)


@pytest.mark.parametrize(("speed_m", "n_dark"), [(2.0, 20), (3.0, 50), (0.02, 20)])
def test_whatever_moves_may_halt_in_the_dark(speed_m: float, n_dark: int) -> None:
    """It was guessed to go on at 20 or 30 m/s, and stood still from the first dark frame on."""
    halted = np.minimum(np.arange(40 + n_dark), 20) * speed_m
    halted[20 + n_dark :] -= speed_m * np.arange(20)  # and then backs out
    truth = np.array([se3.exp(np.array([0, 0, 0, 0, 0, s])) for s in halted])
    drive = Drive(truth)
    for j, T in enumerate(truth):
        is_dark = 20 <= j <= 20 + n_dark
        edges = [] if j == 0 or is_dark else [measured(truth, j - 1, j, SIGMAS, None)]
        coasted = min(max(j - 19, 0), n_dark + 1)
        T_guess = T @ se3.exp(np.array([0, 0, 0, 0, 0, coasted * speed_m]))
        estimate = estimate_at(j * PERIOD_NS, T_guess, status=Status.LOST if is_dark else Status.OK)
        drive.graph.add_frame(estimate, edges, is_place=j % 5 == 0 and not is_dark)
    drive.graph.loops = [drive.loop(20 - 5 * k, 20 + n_dark + 5 * k) for k in range(1, 3)]
    assert not any(loop.reason for loop in drive.graph.optimize().loops)


@pytest.mark.parametrize("n_twins", [3, 8])
def test_where_most_loops_are_refused_none_leads_across_a_gap(n_twins: int) -> None:
    truth = walk(200)
    drive = lit_again(truth, dark=range(50, 55))
    across = [drive.loop(5 * k, 60 + 5 * k) for k in range(4)]
    # As between equal rooms: odometry tells that these are 5 m apart.
    twins = [drive.loop(100 + 5 * k, 150 + 5 * k, T=np.eye(4)) for k in range(n_twins)]
    drive.graph.loops = [*across, *twins]
    reasons = [loop.reason for loop in drive.graph.optimize().loops]
    assert all(reasons[4:])
    doubt = "across a gap, where most other loops are refused" if n_twins > 4 else ""
    assert reasons[:4] == [doubt] * 4


def walk(n: int = 120, step_m: float = 0.1) -> FloatArray:
    """Return a straight walk of 12 m."""
    return np.array([se3.exp(np.array([0, 0, 0, 0, 0, step_m * j])) for j in range(n)])


def test_loops_between_equal_rooms_are_refused_however_many_agree() -> None:
    drive = Drive(walk()).run()
    drive.graph.loops = [drive.loop(5 * k, 50 + 5 * k, T=np.eye(4)) for k in range(12)]
    optimum = drive.graph.optimize()
    assert {loop.reason for loop in optimum.loops} == {"farther from odometry than that drifts"}
    assert position_error(poses(optimum), drive.truth) < 0.01


@pytest.mark.parametrize("n_more", [0, 300])
def test_the_way_between_two_places_counts_not_what_came_before(n_more: int) -> None:
    truth = walk(120 + n_more)
    drive = Drive(truth).run()
    last = len(truth) - 1 - (len(truth) - 1) % 5
    drive.graph.loops = [drive.loop(last - 50, last, T=np.eye(4))] * 2
    assert all(loop.reason for loop in drive.graph.optimize().loops)


@pytest.mark.parametrize("bias", [(0.01, 0.0), (0.0, 0.0005), (-0.01, -0.0005)])
def test_true_loops_count_after_one_percent_of_drift(bias: tuple[float, float]) -> None:
    drive = Drive(block(1.3, n_per_lap=N_LAP), np.random.default_rng(1), bias=bias).run()
    drive.graph.loops = [drive.loop(5 * k, N_LAP + 5 * k) for k in range(5)]
    assert not any(loop.reason for loop in drive.graph.optimize().loops)


class CountedPlaces(MadeUpPlaces):
    """The same, with the numbers of the frames that are described as those of a lost camera."""

    def __init__(self, truth: FloatArray, n_per_lap: int) -> None:
        super().__init__(truth, n_per_lap)
        self.described: list[int] = []

    def describe_densely(self, observations: int) -> SimpleNamespace:
        self.described.append(observations)
        return super().describe(observations)


def gap(truth: FloatArray, n_before: int, *later: range) -> RunGraph:
    """Return the graph of places before a gap, and of parts after it, which lie anywhere."""
    graph = RunGraph()
    for k, frames in enumerate((range(n_before), *later)):
        for j in frames:
            T = truth[j] if k == 0 else AWAY @ truth[j]
            edges = [] if j == frames.start else [measured(truth, j - 1, j, SIGMAS, None)]
            graph.add_frame(estimate_at(j * PERIOD_NS, T), edges, is_place=True)
    return graph


def test_frames_after_a_gap_search_eagerly_and_then_where_they_are_places() -> None:
    truth = block(3.0, n_per_lap=N_LAP)
    frontend = CountedPlaces(truth, N_LAP)
    detector = LoopDetector(frontend=frontend, graph=gap(truth, 50))
    for j in range(0, 50, 5):
        detector.look(j, truth[j])
    for j in range(60, 100):
        is_keyframe = j % 5 == 0
        assert detector.look(j, truth[j], part=60 * PERIOD_NS, is_keyframe=is_keyframe) == ()
    found = frontend.described
    assert found[:15] == list(range(60, 75))
    assert len(found[15:]) >= 2
    assert all(j % 5 == 0 for j in found[15:])


def test_two_frames_after_a_gap_are_connected_by_two_loops_that_agree() -> None:
    truth = block(2.0, n_per_lap=N_LAP)
    graph = gap(truth, 50)
    detector = LoopDetector(frontend=MadeUpPlaces(truth, N_LAP), graph=graph)
    for j in range(0, 50, 5):
        detector.look(j, truth[j])
    # Its poses have nothing to do with those before.
    looks = []
    for j in (110, 115, 120):
        part = graph.parts.of(110 * PERIOD_NS)
        looks.append(detector.look(j, AWAY @ truth[j], part=part, is_keyframe=False))
        graph.parts.add(j * PERIOD_NS, [part])
        for loop in looks[-1]:
            graph.parts.join(loop.stamp_ns, loop.reference_ns)
    # Once connected, only keyframes look.
    assert [len(loops) for loops in looks] == [0, 2, 0]
    assert [j for j in (110, 115, 120) if j * PERIOD_NS in detector] == [110, 115]


def test_loops_are_as_uncertain_as_registrations_are_known_to_be() -> None:
    truth = block(2.0, n_per_lap=N_LAP)
    covariances = []
    for factor in (1.0, 9.0):
        detector = LoopDetector(frontend=MadeUpPlaces(truth, N_LAP))
        detector.variance_factor = factor
        for j in range(0, N_LAP, 5):
            detector.look(j, truth[j])
        detector.look(N_LAP + 10, truth[N_LAP + 10])
        covariances.append(detector.loops[0].covariance)
    np.testing.assert_allclose(covariances[1], 9.0 * covariances[0])


class Erring(MadeUpPlaces):
    """The same, but what is measured from all places but some is wrong."""

    def __init__(self, truth: FloatArray, n_per_lap: int, *, right: Container[int]) -> None:
        super().__init__(truth, n_per_lap)
        self.right = right

    def recognize(
        self, reference: SimpleNamespace, current: SimpleNamespace, observations: int
    ) -> RelativePose | Failure:
        result = super().recognize(reference, current, observations)
        if isinstance(result, Failure) or reference.stamp_ns // PERIOD_NS in self.right:
            return result
        return replace(result, T_reference_current=result.T_reference_current @ AWAY)


EVERYWHERE = range(1000)


@pytest.mark.parametrize(
    ("beside", "right", "is_lost", "is_confirmed"),
    [
        ([43, 57], EVERYWHERE, False, True),
        ([43, 57], [50, 57], False, True),
        ([43, 57], [43, 50], False, True),
        ([55, 57], [50, 57], False, True),
        ([43, 57], [50], False, False),  # they contradict it
        ([40, 60], EVERYWHERE, False, False),  # they are not seen
        ([45, 55], EVERYWHERE, False, False),  # they are the same view again
        ([43, 57], EVERYWHERE, True, False),  # does not suffice for a camera that was lost
    ],
)
def test_a_loop_of_the_very_last_frame_counts_if_a_place_beside_agrees(
    beside: list[int], right: Container[int], is_lost: bool, is_confirmed: bool
) -> None:
    truth = block(1.2, n_per_lap=500)
    frontend = Erring(truth, 500, right=right)
    detector = LoopDetector(frontend=frontend, graph=gap(truth, 260) if is_lost else None)
    detector.look(0, truth[0])
    for j in sorted([*beside, 50, *range(100, 250, 10)]):
        detector.keep(j, truth[j])
    found = detector.look(550, truth[550], part=550 * PERIOD_NS if is_lost else None)
    assert [loop.reference_ns for loop in found] == [50 * PERIOD_NS] * is_confirmed
    assert [bool(loop.reason) for loop in detector.loops] == [not is_confirmed]


class Repeated(MadeUpPlaces):
    """Places that look the same from every so many frames on, as a row of equal windows does."""

    def __init__(self, truth: FloatArray, n_per_lap: int, *, period: int) -> None:
        super().__init__(truth, n_per_lap)
        self.descriptors = self.descriptors[np.arange(n_per_lap) % period]
        self.period = period

    def recognize(
        self, reference: SimpleNamespace, current: SimpleNamespace, observations: int
    ) -> RelativePose | Failure:
        i = reference.stamp_ns // PERIOD_NS
        # The nearest of the equal ones.
        half = self.period // 2
        alike = i + (observations - i + half) % self.period - half
        edge = measured(self.truth, i, alike, SIGMAS, None)
        return RelativePose(
            T_reference_current=edge.T_reference_frame,
            covariance=edge.covariance,
            matches=np.zeros((80, 2), dtype=np.int64),
            inliers=np.ones(80, dtype=np.bool_),
        )


@pytest.mark.parametrize(("period", "n_joined"), [(10, 0), (80, 1)])
def test_a_view_that_fits_several_places_of_a_row_joins_nothing(period: int, n_joined: int) -> None:
    truth = walk(200, step_m=1.0)
    frontend = Repeated(truth, 200, period=period)
    detector = LoopDetector(frontend=frontend, graph=gap(truth, 60, range(120, 126)))
    for j in range(20, 60, 5):
        detector.look(j, truth[j])
    part = 120 * PERIOD_NS
    looks = [
        detector.look(j, AWAY @ truth[j], part=part, is_keyframe=False) for j in range(120, 126)
    ]
    assert sum(bool(loops) for loops in looks[:2]) == n_joined
    assert any(looks) == bool(n_joined)


def test_loops_to_two_different_parts_confirm_nothing() -> None:
    truth = block(2.0, n_per_lap=N_LAP)
    graph = gap(truth, 12, range(14, 18))
    detector = LoopDetector(frontend=MadeUpPlaces(truth, N_LAP), graph=graph)
    detector.look(10, truth[10])
    detector.look(15, truth[15], part=14 * PERIOD_NS)
    for j in (N_LAP + 10, N_LAP + 15):
        assert detector.look(j, truth[j], part=N_LAP * PERIOD_NS) == ()
    assert [bool(loop.reason) for loop in detector.loops] == [True, True]


def test_a_velocity_is_known_when_the_light_goes_out() -> None:
    """In a fifth of a second nobody comes to the next room, however many loops say so."""
    n_dark, truth = 2, walk(60)
    found = []
    for n_dark in (2, 20):
        drive = lit_again(truth, dark=range(20, 20 + n_dark), away=np.eye(4))
        twin = se3.exp(np.array([0.0, 0, 0, 0, 0, -2.0]))
        false = [drive.loop(k, 45 + k, T=twin) for k in range(0, 10, 5)]
        drive.graph.loops = false
        found.append({loop.reason for loop in drive.graph.optimize().loops})
    assert found == [{"farther from odometry than that drifts"}, {""}]
