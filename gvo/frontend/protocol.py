"""What a front-end is: two methods, and optional capabilities as small protocols."""

from __future__ import annotations

from collections.abc import Sized
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np

from gvo.config import Config
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import Failure, FloatArray, MotionPrior, RelativePose, Stamped

if TYPE_CHECKING:
    from gvo.frontend.offsets import RigOffsets

# Frames and observations of the front-end's own kind.
_Own: TypeAlias = Any


ObservationsT = TypeVar("ObservationsT", bound=Stamped)


class Frontend(Protocol[ObservationsT]):
    """Turns frames into observations, and two frames' observations into a relative pose.

    Any object with these two methods will do; nothing is to be inherited. Observations are the
    front-end's own affair but for their `stamp_ns`; what else is used of them is in `HasPoints`,
    `CountsKeypoints` and their length. What else a front-end may offer is in `Recognizer`,
    `Reconfigurable`, `HasCamera`, `AlignsDepth` and `LearnsRig`, looked up once when `Odometry` is
    made.

    `gvo.testing.check_frontend` tests the contract.
    """

    def extract(self, frame: _Own, /) -> ObservationsT:
        """Return what is needed of a frame, which is left as it is.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame, or whatever else has a stamp_ns
            An image in which nothing is seen gives observations that cannot be registered, not
            an exception.
        """

    def register(
        self, reference: ObservationsT, current: ObservationsT, prior: MotionPrior | None, /
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame.

        Parameters
        ----------
        reference, current : observations
            What `extract` gave for either frame, neighbours in time or not; left as they are.
        prior : MotionPrior or None
            What is expected of the motion, a guess that may be wrong.

        Returns
        -------
        RelativePose or Failure
            `T_reference_current` and its covariance are all that an own front-end has to fill
            in. The same arguments give the same result, bit for bit.
        """


class Reconfigurable(Protocol):
    """A front-end whose parameters can change while it runs."""

    def reconfigure(self, config: Config, /) -> None:
        """Take over a configuration; observations extracted before must stay usable."""


class HasCamera(Protocol):
    """A front-end of a camera; with `HasPoints`, keyframes are chosen by view overlap."""

    @property
    def camera(self) -> StereoCamera | PinholeCamera:
        """The camera that the points are seen by."""


class AlignsDepth(Protocol):
    """A front-end that measures the motion a second time, by depth images alone."""

    def align_depth(
        self, reference: _Own, current: _Own, T_reference_current: FloatArray, /
    ) -> RelativePose | Failure:
        """Estimate the motion between two frames from a start value."""


class LearnsRig(Protocol):
    """A front-end that calibrates constant errors of its camera online."""

    @property
    def rig_offsets(self) -> RigOffsets:
        """The present estimates."""


class Recognizer(Protocol):
    """A front-end that knows frames again that it keeps small: loops and lost cameras need one.

    A place has `stamp_ns`, `points_cam` (n, 3) and `descriptors_left` (n, m); what else
    `recognize` needs is the front-end's own affair. Where there is `describe_densely` beside
    `describe`, it describes the frames of a lost camera, which are few.
    """

    @property
    def camera(self) -> StereoCamera:
        """The camera that the points are seen by; of RGB-D, with a virtual baseline."""

    def extract(self, frame: _Own, /) -> _Own:
        """Return what is needed of a frame."""

    def describe(self, observations: _Own, /) -> _Own:
        """Return a frame as a place, at less than 100 kB."""

    def recognize(
        self, reference: _Own, current: _Own, observations: _Own, /
    ) -> RelativePose | Failure:
        """Estimate the motion from a place to a frame, given with its own place; rather fail."""


@runtime_checkable
class HasPoints(Protocol):
    """Observations whose points tell the view overlap."""

    @property
    def points_cam(self) -> FloatArray:
        """Points in the `cam` frame, metres, shape (n, 3)."""


@runtime_checkable
class CountsKeypoints(Protocol):
    """Observations that know the number of keypoints detected; it is reported."""

    @property
    def n_keypoints(self) -> int:
        """Keypoints detected, measured in 3-D or not."""


class CheckedFrontend(Generic[ObservationsT]):
    """A front-end with its capabilities looked up; invalid results become Failure.

    Parameters
    ----------
    frontend : Frontend

    Attributes
    ----------
    recognizer : Recognizer or None
        The front-end, where it is one.
    """

    def __init__(self, frontend: Frontend[ObservationsT]) -> None:
        self._frontend = frontend
        self._reconfigurable: Reconfigurable | None = _capability(frontend, "reconfigure")
        self._learner: LearnsRig | None = _capability(frontend, "rig_offsets")
        self._aligner: AlignsDepth | None = _capability(frontend, "align_depth")
        self.recognizer: Recognizer | None = _capability(frontend, "recognize")
        self._camera_holder: HasCamera | None = _capability(frontend, "camera")

    @property
    def camera(self) -> StereoCamera | PinholeCamera | None:
        """The front-end's own camera, where it has one; `reconfigure` may change it."""
        camera = None if self._camera_holder is None else self._camera_holder.camera
        return camera if isinstance(camera, StereoCamera | PinholeCamera) else None

    @property
    def rig_offsets(self) -> RigOffsets | None:
        """What is learnt of the camera; None where the front-end does not learn."""
        from gvo.frontend.offsets import RigOffsets  # loads compiled loops

        offsets = None if self._learner is None else self._learner.rig_offsets
        return offsets if isinstance(offsets, RigOffsets) else None

    def extract(self, frame: _Own, /) -> ObservationsT:
        """Extract as the front-end does."""
        return self._frontend.extract(frame)

    def register(
        self, reference: ObservationsT, current: ObservationsT, prior: MotionPrior | None, /
    ) -> RelativePose | Failure:
        """Register two frames.

        Raises
        ------
        ValueError
            When the front-end returns neither RelativePose nor Failure.
        """
        return self._checked("register", self._frontend.register(reference, current, prior))

    def align_depth(
        self, reference: ObservationsT, current: ObservationsT, T_reference_current: FloatArray
    ) -> RelativePose | Failure:
        """Register two frames by depth alone; raises as `register`."""
        if self._aligner is None:
            return Failure(reason="the front-end aligns no depth")
        result = self._aligner.align_depth(reference, current, T_reference_current)
        return self._checked("align_depth", result)

    def reconfigure(self, config: Config) -> None:
        """Hand over a configuration, where the front-end takes one."""
        if self._reconfigurable is not None:
            self._reconfigurable.reconfigure(config)

    def _checked(self, method: str, result: object) -> RelativePose | Failure:
        if not isinstance(result, RelativePose | Failure):
            raise ValueError(
                f"{method} of {type(self._frontend).__name__} must return RelativePose or "
                f"Failure, got {type(result).__name__}"
            )
        fault = find_fault(result) if isinstance(result, RelativePose) else ""
        return Failure(reason=f"the front-end is at fault: {fault}") if fault else result


def _capability(frontend: object, name: str) -> Any:  # noqa: ANN401 - one of the protocols
    """Return the front-end if it has an attribute; isinstance would not see what it delegates."""
    return frontend if getattr(frontend, name, None) is not None else None


def count_points(observations: object) -> tuple[int, int]:
    """Return the numbers of keypoints and of points, 0 where the observations do not tell."""
    n_points = len(observations) if isinstance(observations, Sized) else 0
    if isinstance(observations, CountsKeypoints):
        return observations.n_keypoints, n_points
    return n_points, n_points


def find_fault(result: RelativePose) -> str:
    """Return what is wrong with a relative pose, in one line; empty where nothing is."""
    T, covariance = result.T_reference_current, result.covariance
    for name, array, shape in (
        ("T_reference_current", T, (4, 4)),
        ("the covariance", covariance, (6, 6)),
        ("the passing covariance", result.passing_covariance, (6, 6)),
    ):
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
            return f"{name} is no array of float64 of shape {shape}"
    fault = se3.transform_fault(T)
    if fault:
        return f"T_reference_current {fault}"
    fault = se3.covariance_fault(covariance)
    if fault:
        return f"the covariance {fault}"
    fault = se3.covariance_fault(covariance - result.passing_covariance)
    return f"the covariance without what passes {fault}" if fault else ""
