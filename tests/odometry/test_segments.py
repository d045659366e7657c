"""A lost camera begins a segment, which is joined where a kept keyframe is seen again for sure."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from gvo.backend.pose_graph import NewPose, PoseGraph
from gvo.config import Config
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.odometry.odometry import Odometry
from gvo.types import (
    Failure,
    FloatArray,
    FrameResult,
    MotionPrior,
    RelativePose,
    Status,
)

# After four steps without a measurement the camera is lost.
STEP_NS = 571_000_000
SIGMAS = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2])


@dataclass(frozen=True, kw_only=True)
class Place:
    """A frame of a sensor that knows where it is; dark ones see nothing."""

    stamp_ns: int
    T_world_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    is_dark: bool = False


@dataclass
class Beacon:
    """A front-end that registers what is less than half a metre apart.

    `see` is what it says when asked for a place again: the true relative pose, changed.
    """

    see: Callable[[FloatArray], FloatArray | None] = lambda T: T
    reach_m: float = 0.5
    n_looked: int = 0
    camera = StereoCamera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, baseline=0.1)
    points_cam = np.array([[x, y, 3.0] for x in (-1.0, 0.0, 1.0) for y in (-0.5, 0.5)])

    def extract(self, frame: Place) -> Place:
        return frame

    def register(
        self, reference: Place, current: Place, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        T = true_step(reference, current)
        if reference.is_dark or current.is_dark or np.linalg.norm(T[:3, 3]) > self.reach_m:
            return Failure(reason="nothing in common")
        return relative(T)

    def describe(self, observations: Place) -> SimpleNamespace:
        return SimpleNamespace(
            stamp_ns=observations.stamp_ns,
            T_world_frame=observations.T_world_frame,
            points_cam=self.points_cam,
            descriptors_left=np.arange(32 * 6, dtype=np.uint8).reshape(6, 32),
        )

    def recognize(
        self, reference: SimpleNamespace, current: SimpleNamespace, observations: Place
    ) -> RelativePose | Failure:
        self.n_looked += 1
        seen = self.see(true_step(reference, observations))  # type: ignore[arg-type]
        return Failure(reason="never seen") if seen is None else relative(seen)


class Plain(Beacon):
    """The same without a way to look for a place."""

    recognize = None  # type: ignore[assignment]


def true_step(reference: Place, current: Place) -> FloatArray:
    return np.asarray(se3.invert(reference.T_world_frame) @ current.T_world_frame)


def relative(T: FloatArray) -> RelativePose:
    return RelativePose(T_reference_current=T, covariance=np.diag(SIGMAS**2))


def at(x: float, turn: float = 0.0) -> FloatArray:
    return np.asarray(
        se3.exp(np.array([0.0, 0.0, 0.0, x, 0.0, 0.0]))
        @ se3.exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0]))
    )


def walk(n_dark: int = 6, n_after: int = 12, *, away: FloatArray) -> list[Place]:
    """Walk for a metre; the light goes out; go on from elsewhere."""
    poses = [at(0.1 * n) for n in range(10)]
    poses += [at(1.0)] * n_dark
    poses += [away @ at(0.1 * n) for n in range(n_after)]
    return [
        Place(stamp_ns=n * STEP_NS, T_world_frame=T, is_dark=10 <= n < 10 + n_dark)
        for n, T in enumerate(poses)
    ]


def run(frontend: Beacon, places: list[Place], **loops: object) -> list[FrameResult]:
    settings = {
        "window": {"keyframe_distance_m": 0.3, "n_keyframes": 4},
        "loops": loops,
    }
    odometry = Odometry(config=Config.model_validate(settings), frontend=frontend)
    return [odometry.track(place) for place in places]


def steps_of_the_window(
    odometry: Odometry, places: list[Place]
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the step of each frame but the first: as it is told, and as the window has it then."""
    told = [odometry.track(places[0]).T_previous_frame]
    assert told[0] is None
    pairs = []
    for previous, place in pairwise(places):
        step, window = odometry.track(place).T_previous_frame, odometry.window
        assert step is not None
        known = se3.invert(window.pose(previous.stamp_ns)) @ window.pose(place.stamp_ns)
        pairs.append((step, np.asarray(known)))
    return pairs


def errors(results: list[FrameResult], places: list[Place]) -> list[float]:
    return [
        float(np.linalg.norm((result.causal.T_world_frame - place.T_world_frame)[:3]))
        for result, place in zip(results, places, strict=True)
    ]


AWAY = at(4.0, turn=0.8)


def test_a_segment_begins_with_the_first_frame_after_a_gap() -> None:
    results = run(Beacon(see=lambda _: None), walk(away=AWAY))
    statuses = [result.status for result in results]
    first = statuses.index(Status.LOST)
    # Two seconds after the last frame that was tied, the tenth.
    assert first == 9 + 4
    # The first frame that is registered again begins it.
    assert [result.segment for result in results] == [0] * 17 + [1] * (len(results) - 17)
    assert statuses[16:18] == [Status.LOST, Status.RESUMED]
    assert set(statuses[18:]) == {Status.OK}


def test_a_gap_without_frames_is_as_long_as_one_of_dark_frames() -> None:
    places = [place for place in walk(away=AWAY) if not place.is_dark]
    results = run(Beacon(see=lambda _: None), places)
    assert results[10].status is Status.LOST
    assert [result.segment for result in results] == [0] * 11 + [1] * 11


def test_a_keyframe_that_is_seen_twice_joins_the_segments() -> None:
    places = walk(away=AWAY)
    results = run(Beacon(), places)
    joins = [join for result in results for join in result.joins]
    assert len(joins) == 1
    join = joins[0]
    assert (join.segment, join.to_segment) == (1, 0)
    assert join.reference_ns < 10 * STEP_NS
    joined = join.stamp_ns // STEP_NS
    # The first frame that is registered again sees it, the next one confirms it.
    assert joined == 18
    assert results[joined].status is Status.RESUMED
    found = errors(results, places)
    assert found[joined - 1] > 1.0
    assert max(found[joined:]) < 0.02
    sigma = [float(np.sqrt(result.causal.covariance[3, 3])) for result in results]
    assert sigma[joined - 1] > 0.5
    assert max(sigma[joined:]) < 0.2
    assert [result.segment for result in results[joined - 1 : joined + 1]] == [1, 0]
    assert {result.segment for result in results[joined:]} == {0}


def test_a_join_is_no_step_and_each_step_is_of_one_state_of_the_window() -> None:
    places = walk(away=AWAY)
    settings = {"keyframe_distance_m": 0.3, "n_keyframes": 4}
    odometry = Odometry(config=Config.model_validate({"window": settings}), frontend=Beacon())
    pairs = steps_of_the_window(odometry, places)
    for step, known in pairs:
        np.testing.assert_allclose(step, known, atol=1e-9)
    results = run(Beacon(), places)
    poses = [result.causal.T_world_frame for result in results]
    jumps = [float(np.linalg.norm((b - a)[:3, 3])) for a, b in pairwise(poses)]
    lengths = [float(np.linalg.norm(step[:3, 3])) for step, _ in pairs]
    assert max(jumps) > 1.0
    assert max(lengths) < 0.15
    told = [result.T_previous_frame for result in results[1:]]
    np.testing.assert_array_equal(told, [step for step, _ in pairs])


def test_after_a_frame_without_a_window_the_step_is_raw(monkeypatch: pytest.MonkeyPatch) -> None:
    places = walk(n_dark=0, n_after=0, away=np.eye(4))
    insert = PoseGraph.insert

    def fail_once(graph: PoseGraph, pose: NewPose) -> tuple[FloatArray, FloatArray]:
        if pose.stamp_ns == places[5].stamp_ns:
            raise SmoothingError("no")
        return insert(graph, pose)

    monkeypatch.setattr(PoseGraph, "insert", fail_once)
    results = run(Beacon(), places)
    before, after = results[5].raw.T_world_frame, results[6].raw.T_world_frame
    step = results[6].T_previous_frame
    assert step is not None
    np.testing.assert_allclose(step, se3.invert(before) @ after, atol=1e-12)


def test_without_loops_the_keyframes_of_the_window_are_looked_for() -> None:
    places = walk(away=AWAY)
    results = run(Beacon(), places, enabled=False)
    assert [(join.segment, join.to_segment) for r in results for join in r.joins] == [(1, 0)]
    assert max(errors(results, places)[18:]) < 0.02
    assert not any(result.loops for result in results)
    # Farther back than the window reaches nothing is known.
    away = run(Beacon(see=lambda T: T if np.linalg.norm(T[:3, 3]) < 0.3 else None), places)
    assert not any(result.joins for result in away)


def test_the_raw_chain_is_never_joined() -> None:
    places = walk(away=AWAY)
    joined = run(Beacon(), places)
    apart = run(Beacon(see=lambda _: None), places)
    for first, second in zip(joined, apart, strict=True):
        np.testing.assert_array_equal(first.raw.T_world_frame, second.raw.T_world_frame)


def test_the_light_that_comes_on_where_it_went_out_begins_no_segment() -> None:
    places = walk(away=at(1.0))
    results = run(Plain(), places)
    assert {result.segment for result in results} == {0}
    assert max(errors(results, places)[16:]) < 0.02


def test_what_looks_for_places_is_not_joined_by_one_frame_that_looks_alike() -> None:
    results = run(Beacon(see=lambda _: None), walk(away=at(1.0)))
    assert not any(result.joins for result in results)


def test_nobody_comes_farther_in_the_dark_than_the_stated_sigmas_allow() -> None:
    places = walk(away=at(80.0))
    assert not any(result.joins for result in run(Beacon(), places))
    longer = walk(away=at(80.0), n_dark=80)
    assert sum(len(result.joins) for result in run(Beacon(), longer)) == 1


def test_candidates_that_contradict_each_other_join_nothing() -> None:
    seen = iter(range(1000))
    results = run(Beacon(see=lambda T: np.asarray(at(0.5 * next(seen)) @ T)), walk(away=AWAY))
    assert not any(result.joins for result in results)
    assert errors(results, walk(away=AWAY))[-1] > 1.0


def test_a_false_candidate_is_forgotten_when_more_agree_with_each_other() -> None:
    n_false = iter(range(1000))
    places = walk(away=AWAY)
    results = run(Beacon(see=lambda T: T if next(n_false) else np.asarray(at(5.0) @ T)), places)
    assert [len(result.joins) for result in results[17:22]] == [0, 0, 0, 1, 0]
    assert errors(results, places)[-1] < 0.02


def test_without_a_way_to_look_for_a_place_segments_stay_apart() -> None:
    results = run(Plain(), walk(away=AWAY))
    assert results[-1].segment == 1
    assert not any(result.joins for result in results)


def test_a_place_that_is_no_keyframe_any_more_joins_by_the_way_to_one_that_is() -> None:
    places = walk(away=np.eye(4))  # where the walk began
    odometry = Odometry(
        config=Config.model_validate({"window": {"keyframe_distance_m": 0.1, "n_keyframes": 1}}),
        frontend=Beacon(see=lambda T: T if np.linalg.norm(T[:3, 3]) < 0.3 else None),
    )
    results = [odometry.track(place) for place in places]
    joins = [join for result in results for join in result.joins]
    (loop, *_) = (loop for result in results for loop in result.loops)
    assert joins[0].reference_ns != loop.reference_ns
    joined = joins[0].stamp_ns // STEP_NS
    assert max(errors(results, places)[joined:]) < 0.05


def test_keyframes_that_wait_are_no_more_than_those_in_use() -> None:
    places: list[Place] = []
    for n in range(6):  # six rooms, each entered in the dark
        room = walk(n_dark=6, n_after=0, away=np.eye(4))
        start_ns = len(places) * STEP_NS
        places += [
            Place(
                stamp_ns=start_ns + place.stamp_ns,
                T_world_frame=at(20.0 * n) @ place.T_world_frame,
                is_dark=place.is_dark,
            )
            for place in room
        ]
    results = run(Beacon(see=lambda _: None), places)
    assert results[-1].segment == 5
    assert max(len(result.keyframes_ns) for result in results) <= 2 * 4


def test_what_was_seen_last_is_known_again_though_it_is_no_keyframe() -> None:
    poses = (
        [at(0.1 * n) for n in range(8)] + [at(1.0)] * 6 + [at(1.25 + 0.02 * n) for n in range(8)]
    )
    places = [
        Place(stamp_ns=n * STEP_NS, T_world_frame=T, is_dark=8 <= n < 14)
        for n, T in enumerate(poses)
    ]
    # The last keyframe is 0.85 m behind, the last frame 0.55 m.
    frontend = Beacon(see=lambda T: T if np.linalg.norm(T[:3, 3]) < 0.75 else None)
    window = {"keyframe_distance_m": 0.3}
    odometry = Odometry(config=Config.model_validate({"window": window}), frontend=frontend)
    results = [odometry.track(place) for place in places]
    assert 7 * STEP_NS not in results[7].keyframes_ns
    loops = [loop for result in results for loop in result.loops]
    assert {loop.reference_ns for loop in loops} == {7 * STEP_NS}
    found = odometry.optimize().estimates
    error = [each.T_world_frame - T for each, T in zip(found[15:], poses[15:], strict=True)]
    assert np.abs(error).max() < 0.02
