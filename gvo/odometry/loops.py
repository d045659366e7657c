"""Loops: a keyframe sees a place that has left the window, and is registered against it."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, takewhile
from typing import Any, TypeAlias

import numpy as np

from gvo.config import Config
from gvo.frontend.factory import make_frontend
from gvo.frontend.features import PlaceIndex
from gvo.frontend.protocol import Recognizer
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.odometry.graph import RunGraph
from gvo.odometry.keyframes import view_overlap
from gvo.types import FloatArray, Frame, Loop, RelativePose

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
# In a part that nothing connects with the first one, so many frames search all others; later ones
# where they are places.
_N_EAGER = 15
# Observations and places, of the front-end's own kind.
_Own: TypeAlias = Any
_UNCONFIRMED = "no other loop confirms it"
_AMBIGUOUS = "it fits several places"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Visit:
    """A place, and where odometry was when it was seen."""

    place: _Own
    T_world_frame: FloatArray


class LoopDetector:
    """Finds places again, and registers frames against them.

    Candidates come by appearance, the latest places apart. What is registered has to be seen in
    most of the view. It is a loop when another one confirms it: two loops of neighbouring frames,
    or of a frame to neighbouring places, and the odometry between them agree.

    After a gap odometry goes on in another part, whose place among the others is not known until a
    loop tells: its first frames search all other places, whatever they look like.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera, optional
        Needed without a front-end.
    config : Config, optional
    frontend : Recognizer, optional
        In place of the one that the configuration names.
    graph : RunGraph, optional
        Where the frames are, which of them measurements connect, and which loops odometry allows.
        Without it all frames are connected, and where they were when they were seen.

    Attributes
    ----------
    loops : list of Loop
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
        graph: RunGraph | None = None,
    ) -> None:
        if frontend is None and camera is None:
            raise ValueError("LoopDetector needs a camera, or a front-end (frontend=...)")
        self._frontend: Any = frontend or make_frontend(camera, config)  # type: ignore[arg-type]
        self._graph = graph
        self._part = 0  # of the frame that is looked at
        self._n_eager: dict[int, int] = {}  # frames of a part that are still to search eagerly
        # Those that a later one may confirm begin at a number.
        self.loops: list[Loop] = []
        self._n_settled = 0
        self.variance_factor = 1.0
        self.forget_places()

    def reconfigure(self, frontend: Recognizer) -> None:
        """Go on with another front-end."""
        self._frontend = frontend

    def forget_places(self) -> None:
        """Search no more of the places so far."""
        # By their stamps; those of the index in its order; the latest ones, which it has not.
        self._visits: dict[int, _Visit] = {}
        self._index, self._indexed = PlaceIndex(), list[_Visit]()
        self._recent: list[_Visit] = []
        self._n_settled = len(self.loops)

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
        observations: _Own,
        T_world_frame: FloatArray,
        *,
        near: Container[int] = (),
        part: int | None = None,
        is_keyframe: bool = True,
    ) -> tuple[Loop, ...]:
        """Detect, by what a front-end extracted; places whose stamps are `near` are no loops.

        A frame that shows most of the latest place is none of its own, and nothing is looked for.
        Those that are no keyframes are looked at only in a `part` that is not connected with the
        first one, and are places where they are found.
        """
        self._begin_part(part or 0)
        is_place = is_keyframe and not (
            self._recent and self._shows(T_world_frame, self._recent[-1])
        )
        is_search = self._is_search(is_place=is_place)
        if not (is_search or is_place):
            return ()
        place = self._describe(observations, is_dense=is_search)
        scores = self._index.scores(place.descriptors_left)
        visits = self._elsewhere(scores) if is_search else self._candidates(scores, near)
        loops = self._register(visits, place, observations, is_search=is_search)
        if not is_place and not loops:
            return ()
        self._add(place, T_world_frame)
        if not loops:
            return ()
        confirmed = self._confirm(loops)
        return tuple(confirmed or self._confirm_alone(loops[0], place, observations))

    def keep(self, observations: _Own, T_world_frame: FloatArray) -> None:
        """Add a frame of the latest part as a place, without looking."""
        self._add(self._describe(observations, is_dense=True), T_world_frame)

    def _describe(self, observations: _Own, *, is_dense: bool) -> _Own:
        plain = self._frontend.describe
        describe = getattr(self._frontend, "describe_densely", plain) if is_dense else plain
        return describe(observations)

    def _add(self, place: _Own, T_world_frame: FloatArray) -> None:
        visit = _Visit(place=place, T_world_frame=T_world_frame)
        self._visits[place.stamp_ns] = visit
        self._recent.append(visit)
        if len(self._recent) > _N_RECENT:
            self._keep_oldest_recent()

    def _part_of(self, stamp_ns: int) -> int:
        """Return the part of a frame, which may be the one that is looked at."""
        if self._graph is None:
            return 0
        return self._graph.parts.of(stamp_ns) if stamp_ns in self._graph.path else self._part

    def _pose(self, visit: _Visit) -> FloatArray:
        """Return where odometry now says that a place was seen."""
        stamp_ns = visit.place.stamp_ns
        if self._graph is None or stamp_ns not in self._graph.path:
            return visit.T_world_frame
        return self._graph.path.pose(stamp_ns)

    def _begin_part(self, part: int) -> None:
        """Note the part of the next frame; odometry does not know where the latest places are."""
        self._part = part
        if self._recent and self._part_of(self._recent[-1].place.stamp_ns) != part:
            self._n_settled = len(self.loops)
            while self._recent:
                self._keep_oldest_recent()

    def _is_search(self, *, is_place: bool) -> bool:
        """Tell whether a frame searches all other parts: eagerly at first, then if it is a place.

        A frame that shows what another one showed would only repeat it.
        """
        part = self._part
        if not self._visits or part == self._part_of(next(iter(self._visits))):
            return False
        n_eager = self._n_eager.get(part, _N_EAGER)
        self._n_eager[part] = max(n_eager - 1, 0)
        return is_place or n_eager > 0

    def _register(
        self, visits: Iterable[_Visit], place: _Own, observations: _Own, *, is_search: bool = False
    ) -> list[Loop]:
        """Return the first loop; of a search all, since they may contradict each other."""
        loops = list[Loop]()
        for visit in visits:
            result = self._frontend.recognize(visit.place, place, observations)
            if isinstance(result, RelativePose):
                loops.append(
                    Loop(
                        stamp_ns=place.stamp_ns,
                        reference_ns=visit.place.stamp_ns,
                        T_reference_frame=result.T_reference_current,
                        covariance=self.variance_factor * result.covariance,
                        n_matches=result.n_matches,
                        n_inliers=result.n_inliers,
                        effects=result.shared,
                        reason=_UNCONFIRMED,
                    )
                )
                if not is_search:
                    break
        return loops

    def _keep_oldest_recent(self) -> None:
        """Add the oldest of the latest places to the index, unless another frame knows it."""
        visit = self._recent.pop(0)
        stamp_ns = visit.place.stamp_ns
        newest = takewhile(lambda loop: loop.stamp_ns >= stamp_ns, reversed(self.loops))
        if any(loop.stamp_ns == stamp_ns and not loop.reason for loop in newest):
            del self._visits[stamp_ns]
        else:
            self._index.add(visit.place.descriptors_left)
            self._indexed.append(visit)

    def _shows(self, T_world_frame: FloatArray, visit: _Visit) -> bool:
        """Tell whether a frame shows most of a place, by odometry."""
        T = se3.invert(T_world_frame) @ self._pose(visit)
        overlap = view_overlap(visit.place.points_cam, T, self._frontend.camera)
        return float(overlap) > _MAX_OVERLAP

    def _elsewhere(self, scores: FloatArray) -> list[_Visit]:
        """Return the places of other parts that a view is most like."""
        best = (self._indexed[k] for k in np.argsort(-scores))
        return list(islice((x for x in best if self._is_apart(x.place.stamp_ns)), _N_CANDIDATES))

    def _is_apart(self, stamp_ns: int) -> bool:
        """Tell whether a frame is in another part than the one that is looked at."""
        return self._part_of(stamp_ns) != self._part

    def _candidates(self, scores: FloatArray, near: Container[int]) -> list[_Visit]:
        if len(scores) == 0:
            return []
        limit = min(_ABOVE_NOISE * float(np.quantile(scores, _NOISE_QUANTILE)), _SURE_SCORE)
        best = np.argsort(-scores)[: 4 * _N_CANDIDATES]
        chosen = (self._indexed[k] for k in best if scores[k] >= limit)
        return [visit for visit in chosen if visit.place.stamp_ns not in near][:_N_CANDIDATES]

    def _confirm(self, loops: Sequence[Loop]) -> list[Loop]:
        """Return the loops that are confirmed with the first of a frame, this one among them.

        One to another part is not if odometry cannot have come there, or more of the latest loops
        contradict it.
        """
        loop = loops[0]
        if any(self._compare(loop, other) < 0 for other in loops[1:]):
            loop = replace(loop, reason=_AMBIGUOUS)
        waiting_ns = self._recent[-1 - _N_WAITING :][0].place.stamp_ns
        rest = self.loops[self._n_settled :]
        self._n_settled += sum(1 for _ in takewhile(lambda each: each.stamp_ns < waiting_ns, rest))
        latest = range(self._n_settled, len(self.loops))
        votes = {k: self._compare(self.loops[k], loop) for k in latest}
        agreeing = [k for k, vote in votes.items() if vote > 0]
        if self._is_apart(loop.reference_ns):
            agreeing = [k for k in agreeing if self._allows(self.loops[k])]
            if len(agreeing) <= sum(vote < 0 for vote in votes.values()):
                agreeing = []
            if not agreeing and loop.reason != _AMBIGUOUS and self._allows(loop):
                # The next frame may confirm it.
                self._n_eager[self._part] = max(self._n_eager.get(self._part, 0), _N_WAITING)
        confirmed = [k for k in agreeing if self.loops[k].reason]
        self.loops.append(replace(loop, reason="") if agreeing else loop)
        for k in confirmed:
            self.loops[k] = replace(self.loops[k], reason="")
        return [self.loops[k] for k in confirmed] + self.loops[-1:] * bool(agreeing)

    def _allows(self, loop: Loop) -> bool:
        return self._graph is None or self._graph.allows(loop)

    def _confirm_alone(self, loop: Loop, place: _Own, observations: _Own) -> list[Loop]:
        """Return the latest loop if the frame is found from a place beside, too, where it says.

        No other frame may follow that could tell. One that shows the same place tells no more than
        another place of this frame does, where these two are as far apart.
        """
        if self._is_apart(loop.reference_ns):
            return []
        reference = self._visits[loop.reference_ns]
        number = self._indexed.index(reference)
        for other in self._indexed[max(number - _N_BESIDE, 0) : number + _N_BESIDE + 1]:
            is_earlier = other.place.stamp_ns < loop.reference_ns
            earlier, later = (other, reference) if is_earlier else (reference, other)
            is_other = not self._shows(self._pose(later), earlier)
            seconds = self._register([other], place, observations) if is_other else []
            if any(self._compare(second, loop) > 0 for second in seconds):
                self.loops[-1] = replace(loop, reason="")
                return self.loops[-1:]
        return []

    def _compare(self, first: Loop, second: Loop) -> int:
        """Tell whether two loops and the odometry between their ends agree (1) or not (-1).

        0: they do not lead from one part to one part. An ambiguous one agrees with none.
        """
        ends = (first.stamp_ns, second.stamp_ns), (first.reference_ns, second.reference_ns)
        if any(self._part_of(a) != self._part_of(b) for a, b in ends):
            return 0
        if _AMBIGUOUS in (first.reason, second.reason):
            return -1
        T_first_second, drift = self._way(first.stamp_ns, second.stamp_ns)
        T_references, other_drift = self._way(first.reference_ns, second.reference_ns)
        T_expected = se3.invert(T_references) @ first.T_reference_frame @ T_first_second
        difference = se3.log(se3.invert(T_expected) @ second.T_reference_frame)
        Ad = se3.adjoint(se3.invert(T_first_second))
        covariance = Ad @ first.covariance @ Ad.T + second.covariance + np.diag(drift + other_drift)
        return 1 if se3.mahalanobis(difference, covariance) <= _AGREEMENT**2 else -1

    def _way(self, first_ns: int, second_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the motion between two places by odometry, and variances of its drift (6,)."""
        first, second = (self._visits[ns] for ns in (first_ns, second_ns))
        T = se3.invert(self._pose(first)) @ self._pose(second)
        length, angle = float(np.linalg.norm(T[:3, 3])), float(se3.rotation_angle(T))
        turn = (_DRIFT * angle) ** 2 + (_DRIFT * 0.1 * length) ** 2
        return T, np.repeat([turn, (_DRIFT * length) ** 2], 3)
