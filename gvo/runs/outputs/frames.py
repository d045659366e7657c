"""Names of a run's frames, and velocities of poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from gvo.geometry import se3
from gvo.io.bag.messages import bare
from gvo.io.convert.bag_messages import FramePose
from gvo.types import Estimate, FloatArray, InertialState
from gvo.viz.scene import ESTIMATES, GLOBAL, StampedPose

ODOM: Final = "odom"
"""The frame of REP 105 in which the base frame never jumps."""

# x forward, y left, z up, from the optical x right, y down, z forward (REP 103).
_T_FLU_OPTICAL: Final = se3.make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunFrames:
    """The names of a run's frames, and where the camera is mounted on the base frame.

    Parameters
    ----------
    world : str
        The fixed frame that the poses are stated in.
    camera : str
        The optical frame of the rectified left or colour camera; `camera_optical` where empty.
    base : str
        The base frame; the camera's where empty.
    T_base_cam : ndarray of float64, shape (4, 4), or callable
        Maps camera coordinates to the base frame, metres. A function of stamp_ns where the
        camera moves in that frame.
    is_world_optical : bool
        Whether `world` has the axes of a camera: z forward.
    is_robot : bool
        Whether the frames of REP 105 are those of a robot, `odom` and the base frame itself, where
        the robot tells how the camera is mounted; otherwise they are below `gvo/` as all others.

    Raises
    ------
    ValueError
        For a world without a name.
    """

    world: str = "world"
    camera: str = ""
    base: str = ""
    T_base_cam: FloatArray | Callable[[int], FloatArray] = field(default_factory=lambda: np.eye(4))
    is_world_optical: bool = False
    is_robot: bool = False

    def __post_init__(self) -> None:
        """Fill in names; tf refuses a leading slash."""
        camera = bare(self.camera) or "camera_optical"
        names = {"world": bare(self.world), "camera": camera, "base": bare(self.base) or camera}
        for key, name in names.items():
            object.__setattr__(self, key, name)
        if not self.world:
            raise ValueError("the world needs a name")

    @property
    def is_camera(self) -> bool:
        """Whether the trajectory is the camera's own."""
        return self.base == self.camera

    def mount(self, stamp_ns: int) -> FloatArray:
        """Return T_base_cam, shape (4, 4), at a stamp."""
        if self.is_camera:
            return np.eye(4)
        return self.T_base_cam(stamp_ns) if callable(self.T_base_cam) else self.T_base_cam

    @property
    def odom(self) -> str:
        """The frame in which the base frame never jumps."""
        return ODOM if self.is_robot else f"gvo/{ODOM}"

    def base_by(self, name: str) -> str:
        """Return the base frame as an estimate places it, or `ODOM`."""
        return self.base if self.is_robot and name == ODOM else f"gvo/{name}/{self.base}"

    def camera_by(self, name: str) -> str:
        """Return the camera's optical frame as an estimate places it, or `ODOM`."""
        return f"gvo/{name}/{self.camera}"

    def moving(self, name: str, estimate: Estimate) -> Iterator[FramePose]:
        """Yield the moving transforms of a pose."""
        return self._moving(name, self.world, estimate.stamp_ns, estimate.T_world_frame)

    def corrected(
        self, stamp_ns: int, T_world_base: FloatArray, T_odom_base: FloatArray
    ) -> Iterator[FramePose]:
        """Yield those of REP 105: a pose that never jumps, and what corrects it to another one."""
        T_world_odom = T_world_base @ se3.invert(T_odom_base)
        yield FramePose(stamp_ns, self.world, self.odom, T_world_odom)
        yield from self._moving(ODOM, self.odom, stamp_ns, T_odom_base)

    def _moving(
        self, name: str, parent: str, stamp_ns: int, T_parent_base: FloatArray
    ) -> Iterator[FramePose]:
        yield FramePose(stamp_ns, parent, self.base_by(name), T_parent_base)
        if callable(self.T_base_cam) and not self.is_camera and self._mounts(name):
            yield self._mounted(stamp_ns, name)

    def fixed(self, stamp_ns: int) -> Iterator[FramePose]:
        """Yield the static transforms."""
        if self.is_world_optical:
            yield FramePose(stamp_ns, f"{self.world}_flu", self.world, _T_FLU_OPTICAL)
        if not callable(self.T_base_cam) and not self.is_camera:
            for name in filter(self._mounts, (*ESTIMATES, GLOBAL, ODOM)):
                yield self._mounted(stamp_ns, name)

    def _mounts(self, name: str) -> bool:
        """Tell whether nobody else says where the camera is on the base frame of that name."""
        return not (self.is_robot and name == ODOM)

    def _mounted(self, stamp_ns: int, name: str) -> FramePose:
        parent, child = self.base_by(name), self.camera_by(name)
        return FramePose(stamp_ns, parent, child, self.mount(stamp_ns))


class Twist(NamedTuple):
    """A velocity of a moving frame, in its own axes.

    (rx, ry, rz, tx, ty, tz) per second, shape (6,), radians and metres; its covariance (6, 6) in
    the same order, None where it is not known.
    """

    velocity: FloatArray
    covariance: FloatArray | None


def twist_of(
    estimate: Estimate,
    previous: StampedPose | None,
    step_covariance: FloatArray | None,
    inertial: InertialState | None,
) -> Twist:
    """Return the velocity by the IMU, else from the pose before to this one; 0 where none was."""
    if inertial is not None:
        return Twist(velocity=inertial.twist, covariance=inertial.twist_covariance)
    if previous is None:
        return Twist(velocity=np.zeros(6), covariance=None)
    elapsed_s = 1e-9 * (estimate.stamp_ns - previous.stamp_ns)
    step = se3.log(se3.invert(previous.T_world_frame) @ estimate.T_world_frame)
    covariance = None if step_covariance is None else step_covariance / elapsed_s**2
    return Twist(velocity=step / elapsed_s, covariance=covariance)
