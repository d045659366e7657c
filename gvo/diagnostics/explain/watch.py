"""A front-end that is watched: what it was asked, what it answered, what happened inside."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gvo._trace import Event, watched
from gvo.config import Config
from gvo.frontend.factory import make_frontend
from gvo.frontend.protocol import Stamped
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import Failure, FloatArray, Frame, MotionPrior, RelativePose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """One call of a front-end's `register` or `relocalize`.

    Parameters
    ----------
    reference_ns : int
        Stamp of the reference.
    prior : ndarray of float64, shape (4, 4), or None
        Predicted T_reference_current.
    result : RelativePose or Failure
    events : list of Event
        What happened inside.
    is_relocalization : bool
        Asked of a keyframe of an earlier segment.
    """

    reference_ns: int
    prior: FloatArray | None
    result: RelativePose | Failure
    events: list[Event]
    is_relocalization: bool = False


@dataclass(slots=True, kw_only=True, eq=False)
class WatchedFrame:
    """What a front-end did with one frame.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    observations : observations
        What `extract` gave.
    events : list of Event
        What happened in `extract`.
    offset_px, row_offset_px : float
        What was known of the rig then: taken off disparities, added to rows of the right image.
    registrations : list of Registration
        In the order of the calls.
    """

    frame: Frame
    observations: Any
    events: list[Event]
    offset_px: float
    row_offset_px: float
    registrations: list[Registration] = field(default_factory=list)


class WatchedFrontend:
    """The front-end of the configuration, which notes what it does with each frame.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
    config : Config
        With one thread: what happens on others is not seen. Results do not depend on it.

    Attributes
    ----------
    camera : StereoCamera
    is_watching : bool
        Whether events are kept; calls and answers are in any case.
    """

    def __init__(self, camera: StereoCamera | PinholeCamera, config: Config) -> None:
        runtime = config.runtime.model_copy(update={"threads": 1})
        self._frontend = make_frontend(camera, config.model_copy(update={"runtime": runtime}))
        self.camera = self._frontend.camera
        self.is_watching = False
        self._latest: WatchedFrame | None = None

    @property
    def rig_offsets(self) -> RigOffsets:
        """What is learnt of the rig."""
        return self._frontend.rig_offsets

    @property
    def latest(self) -> WatchedFrame:
        """What was done with the latest frame.

        Raises
        ------
        ValueError
            Before the first one.
        """
        if self._latest is None:
            raise ValueError("the front-end has not seen a frame yet")
        return self._latest

    def extract(self, frame: Frame) -> Any:  # noqa: ANN401 - the front-end's own
        """Extract as the front-end does."""
        with watched() as events:
            observations = self._frontend.extract(frame)
        self._latest = WatchedFrame(
            frame=frame,
            observations=observations,
            events=events if self.is_watching else [],
            offset_px=self.rig_offsets.disparity.value_px,
            row_offset_px=self.rig_offsets.row.value_px,
        )
        return observations

    def register(
        self,
        reference: Any,  # noqa: ANN401 - the front-end's own
        current: Any,  # noqa: ANN401
        prior: MotionPrior | None = None,
    ) -> RelativePose | Failure:
        """Register as the front-end does."""
        with watched() as events:
            result = self._frontend.register(reference, current, prior)
        T_predicted = None if prior is None else prior.T_predicted
        self._append(reference, T_predicted, result, events)
        return result

    def relocalize(
        self,
        reference: Any,  # noqa: ANN401 - the front-end's own
        current: Any,  # noqa: ANN401
    ) -> RelativePose | Failure:
        """Look for a place again as the front-end does."""
        with watched() as events:
            result = self._frontend.relocalize(reference, current)
        self._append(reference, None, result, events, is_relocalization=True)
        return result

    def _append(
        self,
        reference: Stamped,
        prior: FloatArray | None,
        result: RelativePose | Failure,
        events: list[Event],
        *,
        is_relocalization: bool = False,
    ) -> None:
        self.latest.registrations.append(
            Registration(
                reference_ns=reference.stamp_ns,
                prior=prior,
                result=result,
                events=events if self.is_watching else [],
                is_relocalization=is_relocalization,
            )
        )
