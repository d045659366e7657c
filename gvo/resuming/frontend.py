"""A front-end whose answers are kept, and given once more when the run is repeated."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Any, Literal
from weakref import WeakSet

from gvo.errors import ResumeError
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.klt import KltFrontend
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.geometry.camera import StereoCamera
from gvo.odometry.keyframes import sample_points
from gvo.resuming.records import Call, FrameRecord, Learnt
from gvo.types import Failure, FloatArray, Frame, RelativePose

_UNKNOWN = Failure(reason="this was not registered before the interruption")


class RepeatedObservations:
    """What a record holds of a frame, in place of what the front-end kept of it.

    Parameters
    ----------
    record : FrameRecord
    index : int
        Of the record in the journal.
    learnt : Learnt
        By the front-end, before the frame.

    Attributes
    ----------
    renewed : observations or None
        What the front-end keeps of the frame, once it was extracted again.
    """

    def __init__(self, record: FrameRecord, index: int, learnt: Learnt) -> None:
        self.stamp_ns = record.stamp_ns
        self.n_keypoints = record.n_keypoints
        self.points_cam = record.points_cam
        self.index = index
        self.learnt = learnt
        self.renewed: Any = None
        self._n_points = record.n_points
        self._answers: dict[tuple[str, int, bool], deque[RelativePose | Failure]]
        self._answers = defaultdict(deque)
        for call in record.calls:
            self._answers[call.key].append(call.result)

    def __len__(self) -> int:
        """Return the number of points."""
        return self._n_points

    def answer(self, key: tuple[str, int, bool]) -> RelativePose | Failure | None:
        """Return what the front-end answered then; None where it was not asked."""
        answers = self._answers.get(key)
        return answers.popleft() if answers else None

    def forget_answers(self) -> None:
        """Drop the answers that nobody asks for again."""
        self._answers.clear()


class RepeatableFrontend:
    """A front-end that keeps its answers, and is asked nothing where a record has them.

    Whatever is still held of repeated frames once the run is repeated is extracted again
    (`renew`): then all goes on as if it had never been interrupted.

    Parameters
    ----------
    frontend : DescriptorFrontend or KltFrontend

    Attributes
    ----------
    n_unknown : int
        What was asked about repeated frames and is in no record: arithmetic of another kind
        decided otherwise.
    """

    def __init__(self, frontend: DescriptorFrontend | KltFrontend) -> None:
        self.n_unknown = 0
        self._frontend = frontend
        self._held: WeakSet[RepeatedObservations] = WeakSet()
        self._following: RepeatedObservations | None = None
        self._latest: Any = None
        self._calls: list[Call] = []
        self._learnt = self.learnt()

    @property
    def camera(self) -> StereoCamera:
        """The camera that tells which points are in view."""
        return self._frontend.camera

    @property
    def rig_offsets(self) -> RigOffsets:
        """What is learnt of a stereo rig."""
        return self._frontend.rig_offsets

    def learnt(self) -> Learnt:
        """Return all that the front-end has learnt."""
        return tuple(tuple(learner.state()) for learner in self._frontend.learners)

    def record(self, stage_ms: dict[str, float], *, is_keyframe: bool) -> FrameRecord:
        """Return what came out for the latest frame.

        Parameters
        ----------
        stage_ms : dict of str to float
            Milliseconds by stage.
        is_keyframe : bool
            The frame is kept.
        """
        return FrameRecord(
            stamp_ns=self._latest.stamp_ns,
            n_keypoints=self._latest.n_keypoints,
            n_points=len(self._latest),
            calls=tuple(self._calls),
            points_cam=sample_points(self._latest.points_cam) if is_keyframe else None,
            learnt=self.learnt(),
            stage_ms=stage_ms,
        )

    def repeat(self, record: FrameRecord, index: int) -> None:
        """Take the record of the frame that is extracted next."""
        self._following = RepeatedObservations(record, index, self._learnt)
        self._held.add(self._following)
        self._learnt = record.learnt

    def extract(self, frame: Any, /) -> Any:  # noqa: ANN401 - the front-end's own
        """Return what the front-end keeps of a frame; of a record, what stands for that."""
        self._calls = []
        following, self._following = self._following, None
        self._latest = self._frontend.extract(frame) if following is None else following
        return self._latest

    def register(
        self,
        reference: Any,  # noqa: ANN401 - the front-end's own
        current: Any,  # noqa: ANN401
        prior: FloatArray | None,
        /,
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame."""
        return self.register_expecting(reference, current, prior, None)

    def register_expecting(
        self,
        reference: Any,  # noqa: ANN401 - the front-end's own
        current: Any,  # noqa: ANN401
        prior: FloatArray | None,
        T_usual: FloatArray | None,
        /,
    ) -> RelativePose | Failure:
        """Estimate it where the usual motion is known too; a record calls both `register`."""
        if isinstance(current, RepeatedObservations) and current.renewed is None:
            return self._answer(current, ("register", reference.stamp_ns, prior is not None))
        pair = _renewed(reference), _renewed(current)
        result = self._frontend.register_expecting(*pair, prior, T_usual)
        self._note("register", reference.stamp_ns, result, has_prior=prior is not None)
        return result

    def relocalize(
        self,
        reference: Any,  # noqa: ANN401 - the front-end's own
        current: Any,  # noqa: ANN401
        /,
    ) -> RelativePose | Failure:
        """Estimate the motion between frames that may be far apart."""
        if isinstance(current, RepeatedObservations) and current.renewed is None:
            return self._answer(current, ("relocalize", reference.stamp_ns, False))
        result = self._frontend.relocalize(_renewed(reference), _renewed(current))
        self._note("relocalize", reference.stamp_ns, result, has_prior=False)
        return result

    def held(self) -> list[RepeatedObservations]:
        """Return the repeated frames that are still needed, oldest first."""
        return sorted(self._held, key=lambda observations: observations.index)

    def renew(self, observations: RepeatedObservations, frame: Frame) -> None:
        """Extract a frame again, as the front-end did then."""
        self._restore(observations.learnt)
        observations.renewed = self._frontend.extract(frame)
        len(observations.renewed)  # corners that are looked for on another thread are there now
        observations.forget_answers()

    def go_on(self) -> None:
        """Go on with what the front-end had learnt when it was interrupted."""
        self._restore(self._learnt)

    def _note(
        self,
        kind: Literal["register", "relocalize"],
        reference_ns: int,
        result: RelativePose | Failure,
        *,
        has_prior: bool,
    ) -> None:
        call = Call(kind=kind, reference_ns=reference_ns, has_prior=has_prior, result=result)
        self._calls.append(call)

    def _restore(self, learnt: Learnt) -> None:
        learners = self._frontend.learners
        if len(learners) != len(learnt):
            raise ResumeError("the journal is damaged: run without --resume")
        for learner, state in zip(learners, learnt, strict=True):
            learner.restore(state)

    def _answer(
        self, current: RepeatedObservations, key: tuple[str, int, bool]
    ) -> RelativePose | Failure:
        answer = current.answer(key)
        if answer is None:
            self.n_unknown += 1
            return _UNKNOWN
        return answer


def _renewed(observations: Any) -> Any:  # noqa: ANN401 - the front-end's own
    return observations.renewed if isinstance(observations, RepeatedObservations) else observations
