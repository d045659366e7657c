"""Loops: a keyframe sees a place that has left the window, and is registered against it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any, Final

import numpy as np

from gvo.config import Config
from gvo.frontend.factory import make_frontend
from gvo.frontend.features import PlaceIndex
from gvo.frontend.protocol import Recognizer
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.odometry.graph import Table
from gvo.odometry.keyframes import view_overlap
from gvo.types import FloatArray, Frame, Loop, RelativePose, SegmentJoin, Status

# A frame that shows less than so much of the latest place is another one.
_MAX_OVERLAP = 0.7
# Places that are never searched: the latest ones.
_N_RECENT = 10
# Places that a view is registered against: those of the best scores, if they stand out.
_N_CANDIDATES = 3
_NOISE_QUANTILE = 0.95
_ABOVE_NOISE = 1.5
_SURE_SCORE = 0.06
# Places within which a second loop has to confirm one, that of a later frame or, either way along
# the places, of the same; the sigmas by which both may differ; and by how much odometry may be
# wrong between them: per metre, and per radian.
_N_WAITING = 5
_N_BESIDE = 2
_AGREEMENT = 5.0
_DRIFT = 0.02
# In a world that no loop connects with the others, so many frames search all of them; later ones
# with growing pauses of at most so many frames.
_N_EAGER = 15
_MAX_PAUSE = 30
_UNCONFIRMED = "no other loop confirms it"
_AMBIGUOUS = "it fits several places"

_LOOP: Final = np.dtype(
    [
        *(("stamp_ns", "i8"), ("reference_ns", "i8"), ("T_reference_frame", "f8", (4, 4))),
        *(("covariance", "f8", (6, 6)), ("n_matches", "i8"), ("n_inliers", "i8")),
        ("reason", f"U{len(_UNCONFIRMED)}"),
    ]
)
"""A loop that nothing confirms any more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Visit:
    """A place, and where odometry was when it was seen, in one of its worlds."""

    place: Any
    T_world_frame: FloatArray
    world: int


class _Loops(Sequence[Loop]):
    """Loops as they came: rows of a table, and the latest ones, which others may yet confirm.

    A shallow copy stays as it is.
    """

    def __init__(self) -> None:
        self._table, self._n_rows = Table(_LOOP), 0
        self.latest: tuple[Loop, ...] = ()

    def __len__(self) -> int:
        return self._n_rows + len(self.latest)

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 - a loop, or some where it is a slice
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        index = range(len(self))[index]
        if index >= self._n_rows:
            return self.latest[index - self._n_rows]
        return Loop(**self._table.fields(index))

    def settle(self, before_ns: float = math.inf) -> None:
        """Add those before a stamp to the table."""
        settled = [loop for loop in self.latest if loop.stamp_ns < before_ns]
        for loop in settled:
            self._table.append_fields(loop.stamp_ns, loop)
        self._n_rows, self.latest = self._n_rows + len(settled), self.latest[len(settled) :]


class LoopDetector:
    """Finds places again, and registers frames against them.

    Candidates come by appearance, the latest places apart. What is registered has to be seen in
    most of the view. It is a loop when another one confirms it: two loops of neighbouring frames,
    or of a frame to neighbouring places, and the odometry between them agree.

    Where odometry was lost it goes on in another world, whose place among the others is not known
    until a loop tells: its first frames search all other places, whatever they look like.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera, optional
        Needed without a front-end.
    config : Config, optional
    frontend : Recognizer, optional
        In place of the one that the configuration names.

    Attributes
    ----------
    loops : sequence of Loop
        All that were registered; those without a reason against them are confirmed.
    variance_factor : float
        Of the covariances of loops to come, where registrations are less certain than they state.
    """

    def __init__(
        self,
        camera: StereoCamera | PinholeCamera | None = None,
        config: Config | None = None,
        *,
        frontend: Recognizer | None = None,
    ) -> None:
        if frontend is None and camera is None:
            raise ValueError("LoopDetector needs a camera, or a front-end (frontend=...)")
        self._follow(frontend or make_frontend(camera, config))  # type: ignore[arg-type]
        self._index = PlaceIndex()
        # By their stamps; those of the index in its order; the latest ones, which it has not.
        self._visits: dict[int, _Visit] = {}
        self._indexed: list[_Visit] = []
        self._recent: list[_Visit] = []
        self._world = 0
        self._connected: set[int] = set()
        self._n_searches: dict[int, int] = {}
        self._n_paused = 0
        self.loops = _Loops()
        self.variance_factor = 1.0

    def reconfigure(self, frontend: Recognizer, *, keeps_places: bool) -> None:
        """Go on with another front-end; places of another kind are not searched any more."""
        self._follow(frontend)
        if not keeps_places:
            self._index, self._visits = PlaceIndex(), {}
            self._indexed, self._recent = [], []
            self.loops.settle()

    def _follow(self, frontend: Recognizer) -> None:
        self._frontend = frontend
        self._describe_densely = getattr(frontend, "describe_densely", frontend.describe)

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._visits)

    def __contains__(self, stamp_ns: object) -> bool:
        """Tell whether the place of a frame is known by it."""
        return stamp_ns in self._visits

    def detect(self, frame: Frame, T_world_frame: FloatArray) -> tuple[Loop, ...]:
        """Look for the place that a frame shows, and keep it as another one.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
        T_world_frame : ndarray of float64, shape (4, 4)
            By odometry, which may drift, metres.

        Returns
        -------
        tuple of Loop
            Those that are confirmed with this frame.
        """
        return self.look(self._frontend.extract(frame), T_world_frame)

    def look(
        self,
        observations: Any,  # noqa: ANN401 - of the front-end's own kind
        T_world_frame: FloatArray,
        *,
        near: Container[int] = (),
        world: int = 0,
        is_keyframe: bool = True,
        allows: Callable[[Loop], bool] = lambda _: True,
    ) -> tuple[Loop, ...]:
        """Detect, by what a front-end extracted; places whose stamps are `near` are no loops.

        A frame that shows most of the latest place is none of its own, and nothing is looked for.
        Those that are no keyframes are looked at only in a `world` that is not connected with the
        others, and are places where they are found. What confirms a loop to another world is
        asked of `allows` too: how far the camera may have come in the dark.
        """
        if world != self._world:
            self.loops.settle()
            while self._recent:  # odometry does not know where they are any more
                self._keep_oldest_recent()
        self._world = world
        is_search = self._is_search(world, T_world_frame)
        is_place = is_keyframe and not self._shows_latest(T_world_frame)
        if not (is_search or is_place):
            return ()
        describe = self._describe_densely if is_search else self._frontend.describe
        place = describe(observations)
        scores = self._index.scores(place.descriptors_left)
        visits = self._elsewhere(scores, world) if is_search else self._candidates(scores, near)
        loops = self._register(visits, place, observations)
        if not is_place and not loops:
            return ()
        self._add(place, T_world_frame)
        if not loops:
            return ()
        confirmed = self._confirm(loops, allows)
        return tuple(confirmed or self._confirm_alone(loops[0], place, observations))

    def keep(self, observations: Any, T_world_frame: FloatArray) -> None:  # noqa: ANN401
        """Add a frame of the latest world as a place, without looking."""
        self._add(self._describe_densely(observations), T_world_frame)

    def _add(self, place: Any, T_world_frame: FloatArray) -> None:  # noqa: ANN401
        visit = _Visit(place=place, T_world_frame=T_world_frame, world=self._world)
        self._visits[place.stamp_ns] = visit
        self._recent.append(visit)
        if len(self._recent) > _N_RECENT:
            self._keep_oldest_recent()

    def _is_search(self, world: int, T_world_frame: FloatArray) -> bool:
        """Tell whether a frame of a world searches all others: until it is connected, and eagerly.

        Once it is connected, a frame that shows what another one showed would only repeat it.
        """
        if not self._visits:
            self._connected.add(world)
        n_searches = self._n_searches.setdefault(world, 0 if self._visits else _N_EAGER)
        is_late = n_searches >= _N_EAGER
        if world in self._connected and (is_late or self._shows_latest(T_world_frame)):
            return False
        self._n_paused += 1
        if self._n_paused <= min(n_searches - _N_EAGER, _MAX_PAUSE):
            return False
        self._n_searches[world], self._n_paused = n_searches + 1, 0
        return True

    def _register(
        self,
        visits: Iterable[_Visit],
        place: Any,  # noqa: ANN401
        observations: Any,  # noqa: ANN401
    ) -> list[Loop]:
        """Return the first loop; from a world that is not connected, all: they may contradict."""
        loops = []
        for visit in visits:
            result = self._frontend.recognize(visit.place, place, observations)
            if isinstance(result, RelativePose):
                loops.append(self._loop(visit, place, result))
                if self._world in self._connected:
                    break
        return loops

    def _loop(self, visit: _Visit, place: Any, result: RelativePose) -> Loop:  # noqa: ANN401
        return Loop(
            stamp_ns=place.stamp_ns,
            reference_ns=visit.place.stamp_ns,
            T_reference_frame=result.T_reference_current,
            covariance=self.variance_factor * result.covariance,
            n_matches=result.n_matches,
            n_inliers=result.n_inliers,
            reason=_UNCONFIRMED,
        )

    def _keep_oldest_recent(self) -> None:
        """Add the oldest of the latest places to the index, unless another frame knows it."""
        visit = self._recent.pop(0)
        stamp_ns = visit.place.stamp_ns
        newest = reversed(self.loops)
        newest = takewhile(lambda loop: loop.stamp_ns >= stamp_ns, newest)
        if any(loop.stamp_ns == stamp_ns and not loop.reason for loop in newest):
            del self._visits[stamp_ns]
        else:
            self._index.add(visit.place.descriptors_left)
            self._indexed.append(visit)

    def _shows_latest(self, T_world_frame: FloatArray) -> bool:
        return bool(self._recent) and self._shows(T_world_frame, self._recent[-1])

    def _shows(self, T_world_frame: FloatArray, visit: _Visit) -> bool:
        """Tell whether a frame shows most of a place, by odometry."""
        T = se3.invert(T_world_frame) @ visit.T_world_frame
        return view_overlap(visit.place.points_cam, T, self._frontend.camera) > _MAX_OVERLAP

    def _elsewhere(self, scores: FloatArray, world: int) -> list[_Visit]:
        """Return the places of other worlds that a view is most like."""
        best = (self._indexed[k] for k in np.argsort(-scores))
        return [visit for visit in best if visit.world != world][:_N_CANDIDATES]

    def _candidates(self, scores: FloatArray, near: Container[int]) -> list[_Visit]:
        if len(scores) == 0:
            return []
        limit = min(_ABOVE_NOISE * float(np.quantile(scores, _NOISE_QUANTILE)), _SURE_SCORE)
        best = np.argsort(-scores)[: 4 * _N_CANDIDATES]
        chosen = (self._indexed[k] for k in best if scores[k] >= limit)
        return [visit for visit in chosen if visit.place.stamp_ns not in near][:_N_CANDIDATES]

    def _confirm(self, loops: Sequence[Loop], allows: Callable[[Loop], bool]) -> list[Loop]:
        """Return the loops that are confirmed with the first of a frame, this one among them."""
        loop = loops[0]
        world, reference_world = self._worlds_of(loop)
        if any(self._contradict(loop, other) for other in loops[1:]):
            loop = replace(loop, reason=_AMBIGUOUS)
        self.loops.settle(self._recent[-1 - _N_WAITING :][0].place.stamp_ns)
        latest, confirmed = list(self.loops.latest), []
        agreeing = [k for k, other in enumerate(latest) if self._agree(other, loop)]
        if world != reference_world and world not in self._connected:
            n_against = sum(self._contradict(other, loop) for other in latest)
            agreeing = [k for k in agreeing if allows(latest[k])]
            agreeing = agreeing if len(agreeing) > n_against else []
        for k in agreeing:
            if latest[k].reason:
                latest[k] = replace(latest[k], reason="")
                confirmed.append(latest[k])
        if agreeing:
            confirmed.append(loop := replace(loop, reason=""))
        if agreeing and world != reference_world:
            self._connected.add(world)
        elif world not in self._connected and loop.reason != _AMBIGUOUS:  # the next may confirm it
            self._n_searches[world] = min(self._n_searches[world], _N_EAGER - _N_WAITING)
        self.loops.latest = *latest, loop
        return confirmed

    def _confirm_alone(
        self,
        loop: Loop,
        place: Any,  # noqa: ANN401
        observations: Any,  # noqa: ANN401
    ) -> list[Loop]:
        """Return the latest loop if the frame is found from a place beside, too, where it says.

        No other frame may follow that could tell. One that shows the same place tells no more than
        another place of this frame does, where these two are as far apart.
        """
        if not self._connected.issuperset(self._worlds_of(loop)):
            return []
        reference = self._visits[loop.reference_ns]
        number = self._indexed.index(reference)
        for other in self._indexed[max(number - _N_BESIDE, 0) : number + _N_BESIDE + 1]:
            is_earlier = other.place.stamp_ns < loop.reference_ns
            earlier, later = (other, reference) if is_earlier else (reference, other)
            is_apart = not self._shows(later.T_world_frame, earlier)
            seconds = self._register([other], place, observations) if is_apart else []
            if any(self._agree(second, loop) for second in seconds):
                loop = replace(loop, reason="")
                self.loops.latest = *self.loops.latest[:-1], loop
                return [loop]
        return []

    def _worlds_of(self, loop: Loop) -> tuple[int, int]:
        """Return the worlds of a loop's frame and of its reference."""
        return self._visits[loop.stamp_ns].world, self._visits[loop.reference_ns].world

    def _contradict(self, first: Loop, second: Loop) -> bool:
        """Tell whether two loops between the same worlds disagree: one place looks like another."""
        is_same = self._worlds_of(first) == self._worlds_of(second)
        return is_same and not self._agree(first, second)

    def _agree(self, first: Loop, second: Loop) -> bool:
        """Tell whether two loops and the odometry between their ends agree."""
        is_apart = self._worlds_of(first)[1] != self._worlds_of(second)[1]
        if is_apart or _AMBIGUOUS in (first.reason, second.reason):
            return False
        T_first_second, drift = self._way(first.stamp_ns, second.stamp_ns)
        T_references, other_drift = self._way(first.reference_ns, second.reference_ns)
        T_expected = se3.invert(T_references) @ first.T_reference_frame @ T_first_second
        difference = se3.log(se3.invert(T_expected) @ second.T_reference_frame)
        Ad = se3.adjoint(se3.invert(T_first_second))
        covariance = Ad @ first.covariance @ Ad.T + second.covariance + np.diag(drift + other_drift)
        return bool(se3.mahalanobis(difference, covariance) <= _AGREEMENT**2)

    def _way(self, first_ns: int, second_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the motion between two places by odometry, and variances of its drift (6,)."""
        first, second = (self._visits[ns] for ns in (first_ns, second_ns))
        T = se3.invert(first.T_world_frame) @ second.T_world_frame
        length, angle = float(np.linalg.norm(T[:3, 3])), float(se3.rotation_angle(T))
        turn = (_DRIFT * angle) ** 2 + (_DRIFT * 0.1 * length) ** 2
        return T, np.repeat([turn, (_DRIFT * length) ** 2], 3)


class Segments:
    """Which segment a run is in, and which ones are joined.

    While the camera is lost its pose is a guess that nobody should rely on. The frames after that
    are a segment of their own, somewhere in the world: where, only a loop to a place of an earlier
    segment can tell.
    """

    def __init__(self) -> None:
        self._starts_ns: list[int] = []
        self._groups = [0]
        self._is_lost = False

    @property
    def current(self) -> int:
        """The segment of the latest frame."""
        return len(self._starts_ns)

    def segment_of(self, stamp_ns: int) -> int:
        """Return the segment of an earlier frame."""
        return bisect_right(self._starts_ns, stamp_ns)

    def note_frame(self, stamp_ns: int, status: Status) -> None:
        """Add a frame; the first one that is lost begins a segment."""
        if status is Status.LOST and not self._is_lost:
            self._starts_ns.append(stamp_ns)
            self._groups.append(self.current)
        self._is_lost = status is Status.LOST

    def unjoined(self, stamps_ns: Iterable[int]) -> list[int]:
        """Return the keyframes of segments that the current one is not joined to."""
        present = self._groups[self.current]
        return [ns for ns in stamps_ns if self._groups[self.segment_of(ns)] != present]

    def join(self, stamp_ns: int, reference_ns: int) -> SegmentJoin | None:
        """Join the segment of a frame to that of an earlier one, and to all that are joined to it.

        Parameters
        ----------
        stamp_ns, reference_ns : int
            The frame, and the one that it was registered against.

        Returns
        -------
        SegmentJoin or None
            None where they are joined already.
        """
        segment, other = self.segment_of(stamp_ns), self.segment_of(reference_ns)
        present, former = self._groups[segment], self._groups[other]
        if present == former:
            return None
        self._groups = [former if group == present else group for group in self._groups]
        return SegmentJoin(
            segment=segment, to_segment=other, stamp_ns=stamp_ns, reference_ns=reference_ns
        )
