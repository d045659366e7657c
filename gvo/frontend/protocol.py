"""What a front-end is: two methods, and values that the back-end understands."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np

from gvo.geometry import se3
from gvo.types import Failure, FloatArray, RelativePose


class Stamped(Protocol):
    """Anything with a stamp: a frame, or what a front-end keeps of one."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""


ObservationsT = TypeVar("ObservationsT", bound=Stamped)


class Frontend(Protocol[ObservationsT]):
    """Turns frames into observations, and two frames' observations into a relative pose.

    Any object with these two methods will do; nothing is to be inherited. Observations are the
    front-end's own affair but for their `stamp_ns`. Where they also hold `points_cam` (n, 3),
    points in metres in the `cam` frame, and the front-end has a `camera` (StereoCamera),
    keyframes are chosen by the share of these points in view; else by distance and angle.
    Where they have a length or `n_keypoints`, these are reported with each frame.

    A front-end may have a third method, `relocalize(reference, current)`: what `register` does,
    of frames that may be far apart in time and place, so that a lost camera is found again. It
    should be right rather than successful. Without it, `register` is asked, with no prior.

    Another is `register_expecting(reference, current, prior, T_usual)`: what `register` does,
    where also the motion at the usual velocity is known, T_reference_current, shape (4, 4), by
    the median velocity of the last second. What pulls off gently before a camera draws the
    prior along, but not this: it tells which of two motions is that of the camera. It is a
    guess that may be wrong. Without the method, `register` is asked. A class that derives from
    a front-end with it and has a `register` of its own needs its own of this too.

    `gvo.testing.check_frontend` tests the contract.
    """

    def extract(self, frame: Any, /) -> ObservationsT:  # noqa: ANN401 - its own kind of frame
        """Return what is needed of a frame, which is left as it is.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame, or whatever else has a stamp_ns
            An image in which nothing is seen gives observations that cannot be registered, not
            an exception.
        """

    def register(
        self, reference: ObservationsT, current: ObservationsT, prior: FloatArray | None, /
    ) -> RelativePose | Failure:
        """Estimate the motion from the reference to the current frame.

        Parameters
        ----------
        reference, current : observations
            What `extract` gave for either frame, neighbours in time or not; left as they are.
        prior : ndarray of float64, shape (4, 4), or None
            Predicted T_reference_current, a guess that may be wrong.

        Returns
        -------
        RelativePose or Failure
            `T_reference_current` and its covariance are all that an own front-end has to fill
            in. The same arguments give the same result, bit for bit.
        """


def register_checked(
    frontend: Frontend[ObservationsT],
    reference: ObservationsT,
    current: ObservationsT,
    prior: FloatArray | None,
    *,
    T_usual: FloatArray | None = None,
) -> RelativePose | Failure:
    """Register two frames and turn a relative pose that is none into a failure.

    Parameters
    ----------
    frontend : Frontend
    reference, current : observations
    prior : ndarray of float64, shape (4, 4), or None
        Predicted T_reference_current.
    T_usual : ndarray of float64, shape (4, 4), optional
        T_reference_current at the usual velocity, for a front-end with `register_expecting`.

    Raises
    ------
    ValueError
        When the front-end returns something else.
    """
    expecting = getattr(frontend, "register_expecting", None)
    if T_usual is None or expecting is None:
        return _checked(frontend, "register", frontend.register(reference, current, prior))
    result = expecting(reference, current, prior, T_usual)
    return _checked(frontend, "register_expecting", result)


def relocalize_checked(
    frontend: Frontend[ObservationsT], reference: ObservationsT, current: ObservationsT
) -> RelativePose | Failure:
    """Register two frames that nothing is known of; as `register_checked`."""
    relocalize = getattr(frontend, "relocalize", None)
    if relocalize is None:
        return register_checked(frontend, reference, current, None)
    return _checked(frontend, "relocalize", relocalize(reference, current))


def _checked(frontend: object, method: str, result: object) -> RelativePose | Failure:
    if not isinstance(result, RelativePose | Failure):
        raise ValueError(
            f"{method} of {type(frontend).__name__} must return RelativePose or Failure, "
            f"got {type(result).__name__}"
        )
    fault = find_fault(result) if isinstance(result, RelativePose) else ""
    return Failure(reason=f"the front-end is at fault: {fault}") if fault else result


def find_fault(result: RelativePose) -> str:
    """Return what is wrong with a relative pose, in one line; empty where nothing is."""
    T, covariance = result.T_reference_current, result.covariance
    for name, array, shape in (
        ("T_reference_current", T, (4, 4)),
        ("the covariance", covariance, (6, 6)),
    ):
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
            return f"{name} is no array of float64 of shape {shape}"
    fault = se3.transform_fault(T)
    if fault:
        return f"T_reference_current {fault}"
    fault = se3.covariance_fault(covariance)
    return f"the covariance {fault}" if fault else ""
