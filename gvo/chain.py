"""The raw chain: each frame registered against the one before, nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.config import WindowConfig
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.geometry import se3
from gvo.types import Estimate, Failure, FloatArray, Observations, RelativePose, Status

# After a longer gap the last velocity says nothing about where the camera is.
_MAX_EXTRAPOLATION_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawStep:
    """One step of the chain.

    Parameters
    ----------
    estimate : Estimate
        Pose of the frame by the chain.
    reference_ns : int or None
        Stamp of the frame that the step starts from; None for the first frame.
    T_reference_frame : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Of T_reference_frame.
    is_registered : bool
        False where the step continues the last velocity.
    reason : str
        Why there is no registration; empty where there is one.
    n_matches, n_inliers : int
    """

    estimate: Estimate
    reference_ns: int | None
    T_reference_frame: FloatArray
    covariance: FloatArray
    is_registered: bool
    reason: str = ""
    n_matches: int = 0
    n_inliers: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Link:
    """A frame that the next one may be registered against."""

    observations: Observations
    T_world_frame: FloatArray
    covariance: FloatArray


class RawChain:
    """Chains relative poses of consecutive frames; the smoother never touches it.

    A frame that cannot be registered against its predecessor is tried against the last
    registered frame, so that one bad image in between costs nothing. Failing that, the pose
    goes on with constant velocity.

    Parameters
    ----------
    frontend : DescriptorFrontend
    config : WindowConfig
        Sigmas of a step without registration.
    """

    def __init__(self, frontend: DescriptorFrontend, config: WindowConfig) -> None:
        self._frontend = frontend
        self._config = config
        self._predecessor: _Link | None = None
        self._anchor: _Link | None = None
        self._velocity: FloatArray | None = None

    @property
    def anchor_ns(self) -> int | None:
        """Stamp of the last registered frame, which the next one may be tied to."""
        return None if self._anchor is None else self._anchor.observations.stamp_ns

    def advance(self, current: Observations) -> RawStep:
        """Register the next frame and return its step.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        predecessor, anchor = self._predecessor, self._anchor
        if predecessor is None or anchor is None:
            return self._begin(current)
        elapsed_s = 1e-9 * (current.stamp_ns - predecessor.observations.stamp_ns)
        if elapsed_s <= 0:
            raise ValueError(
                f"stamp {current.stamp_ns} is not after {predecessor.observations.stamp_ns}, "
                "that of the frame before"
            )
        T_predecessor_current = self._predict(elapsed_s)
        T_world_predicted = predecessor.T_world_frame @ T_predecessor_current
        failure = Failure(reason="")
        for link in [predecessor] if anchor is predecessor else [predecessor, anchor]:
            result = self._register(link, current, T_world_predicted)
            if isinstance(result, RelativePose):
                return self._append(link, current, result)
            failure = failure if failure.reason else result
        return self._coast(predecessor, current, T_predecessor_current, failure)

    def _predict(self, elapsed_s: float) -> FloatArray:
        """Return T_predecessor_current at constant velocity, where there is one."""
        if self._velocity is None:
            return np.eye(4)
        return se3.exp(self._velocity * min(elapsed_s, _MAX_EXTRAPOLATION_S))

    def _register(
        self, link: _Link, current: Observations, T_world_predicted: FloatArray
    ) -> RelativePose | Failure:
        """Search around the predicted pixels, then around the previous ones."""
        if self._velocity is not None:
            prior = se3.invert(link.T_world_frame) @ T_world_predicted
            result = self._frontend.register(link.observations, current, prior)
            if isinstance(result, RelativePose):
                return result
        return self._frontend.register(link.observations, current, None)

    def _begin(self, current: Observations) -> RawStep:
        step = RawStep(
            estimate=Estimate(
                stamp_ns=current.stamp_ns, T_world_cam=np.eye(4), covariance=np.zeros((6, 6))
            ),
            reference_ns=None,
            T_reference_frame=np.eye(4),
            covariance=np.zeros((6, 6)),
            is_registered=True,
        )
        self._predecessor = self._anchor = _link_of(current, step.estimate)
        return step

    def _append(self, link: _Link, current: Observations, result: RelativePose) -> RawStep:
        T_world_current = se3.normalize(link.T_world_frame @ result.T_reference_current)
        estimate = Estimate(
            stamp_ns=current.stamp_ns,
            T_world_cam=T_world_current,
            covariance=se3.compose_covariance(
                link.covariance, result.T_reference_current, result.covariance
            ),
        )
        span_s = 1e-9 * (current.stamp_ns - link.observations.stamp_ns)
        self._velocity = se3.log(result.T_reference_current) / span_s
        self._predecessor = self._anchor = _link_of(current, estimate)
        return RawStep(
            estimate=estimate,
            reference_ns=link.observations.stamp_ns,
            T_reference_frame=result.T_reference_current,
            covariance=result.covariance,
            is_registered=True,
            n_matches=result.n_matches,
            n_inliers=result.n_inliers,
        )

    def _coast(
        self,
        predecessor: _Link,
        current: Observations,
        T_predecessor_current: FloatArray,
        failure: Failure,
    ) -> RawStep:
        elapsed_s = 1e-9 * (current.stamp_ns - predecessor.observations.stamp_ns)
        rates = [
            np.radians(self._config.coasting_sigma_deg_per_s),
            self._config.coasting_sigma_m_per_s,
        ]
        covariance = np.diag(np.repeat(rates, 3) * elapsed_s) ** 2
        estimate = Estimate(
            stamp_ns=current.stamp_ns,
            T_world_cam=se3.normalize(predecessor.T_world_frame @ T_predecessor_current),
            covariance=se3.compose_covariance(
                predecessor.covariance, T_predecessor_current, covariance
            ),
            status=Status.COASTING,
        )
        self._predecessor = _link_of(current, estimate)
        return RawStep(
            estimate=estimate,
            reference_ns=predecessor.observations.stamp_ns,
            T_reference_frame=T_predecessor_current,
            covariance=covariance,
            is_registered=False,
            reason=failure.reason,
            n_matches=failure.n_matches,
            n_inliers=failure.n_inliers,
        )


def _link_of(observations: Observations, estimate: Estimate) -> _Link:
    return _Link(
        observations=observations,
        T_world_frame=estimate.T_world_cam,
        covariance=estimate.covariance,
    )
