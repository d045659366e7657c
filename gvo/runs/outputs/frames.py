"""Names of frames, and the poses so far."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.convert.bag_messages import FramePose, pose_numbers
from gvo.io.poses.tf_paths import bare
from gvo.types import Estimate, FloatArray, IntArray, Loop

ESTIMATES: Final = ("raw", "causal", "smoothed")
GLOBAL: Final = "global"
"""The estimate that comes at the end of a run."""
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
        For a world without a name, or a transform between a frame and itself.
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
        if not callable(self.T_base_cam):
            T = np.array(self.T_base_cam, dtype=np.float64)
            T.setflags(write=False)
            object.__setattr__(self, "T_base_cam", T)
            if self.is_camera and not np.array_equal(T, np.eye(4)):
                raise ValueError(f"{camera}: its transform to itself must be the identity")

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


_N_NUMBERS = 7


class StampedPose(NamedTuple):
    """Stamp in nanoseconds and pose (4, 4) of a frame."""

    stamp_ns: int
    T_world_frame: FloatArray


class Twist(NamedTuple):
    """A velocity of a moving frame, in its own axes.

    (rx, ry, rz, tx, ty, tz) per second, shape (6,), radians and metres; its covariance (6, 6) in
    the same order, None where it is not known.
    """

    velocity: FloatArray
    covariance: FloatArray | None


class Track:
    """The poses of one estimate so far, 64 bytes each, in the order of their stamps."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._poses = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, estimate: Estimate) -> None:
        """Take the next pose, in any order of stamps."""
        index = bisect_right(self._stamps_ns, estimate.stamp_ns)
        self._stamps_ns.insert(index, estimate.stamp_ns)
        numbers = pose_numbers(estimate.T_world_frame).tolist()
        self._poses[_N_NUMBERS * index : _N_NUMBERS * index] = array("d", numbers)

    def before(self, stamp_ns: int) -> StampedPose | None:
        """Return stamp and pose (4, 4) of the latest pose before a stamp."""
        index = bisect_left(self._stamps_ns, stamp_ns) - 1
        if index < 0:
            return None
        numbers = np.array(self._poses[_N_NUMBERS * index : _N_NUMBERS * (index + 1)])
        R = np.asarray(Rotation.from_quat(numbers[3:]).as_matrix())
        return StampedPose(self._stamps_ns[index], se3.make_transform(R, numbers[:3]))

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Return the pose (4, 4) at a stamp, if there is one."""
        pose = self.before(stamp_ns + 1)
        return pose.T_world_frame if pose is not None and pose.stamp_ns == stamp_ns else None

    def segments(self, loops: Iterable[Loop]) -> FloatArray:
        """Return lines (n, 2, 3) from frame to reference of those loops that count."""
        counting = [loop for loop in loops if not loop.reason]
        ends = [(self.at(loop.stamp_ns), self.at(loop.reference_ns)) for loop in counting]
        known = [
            [T[:3, 3], T_reference[:3, 3]]
            for T, T_reference in ends
            if T is not None and T_reference is not None
        ]
        return np.array(known).reshape(-1, 2, 3)

    def poses(self, n_most: int | None = None) -> tuple[IntArray, FloatArray]:
        """Return stamps (n,) and positions with quaternions (n, 7).

        Of more than `n_most`, every second, fourth, ... and the last are taken: those shown stay
        the same while the track grows.
        """
        stride = 1
        while n_most is not None and stride * (n_most - 1) < len(self) > n_most:
            stride *= 2
        is_shown = np.arange(len(self)) % stride == 0
        is_shown[-1:] = True
        stamps_ns = np.frombuffer(self._stamps_ns, dtype=np.int64)
        return stamps_ns[is_shown], np.frombuffer(self._poses).reshape(-1, _N_NUMBERS)[is_shown]


def twist_between(
    estimate: Estimate, previous: StampedPose | None, step_covariance: FloatArray | None
) -> Twist:
    """Return the velocity that leads from the pose before to this one.

    Parameters
    ----------
    estimate : Estimate
        The later pose.
    previous : StampedPose or None
        The earlier one; without it the velocity is 0, of unknown covariance.
    step_covariance : ndarray of float64, shape (6, 6), or None
        Of the step between the two, (rx, ry, rz, tx, ty, tz), in the later frame.
    """
    if previous is None:
        return Twist(velocity=np.zeros(6), covariance=None)
    elapsed_s = 1e-9 * (estimate.stamp_ns - previous.stamp_ns)
    step = se3.log(se3.invert(previous.T_world_frame) @ estimate.T_world_frame)
    covariance = None if step_covariance is None else step_covariance / elapsed_s**2
    return Twist(velocity=step / elapsed_s, covariance=covariance)
