"""The names of a run's frames in a bag.

Frames (REP 103, REP 105)::

    world_flu                       static; only where `world` has the axes of a camera
    +-- world
        +-- gvo/raw/FRAME           the chain of frame-to-frame registrations
        |   +-- gvo/raw/CAMERA      only where FRAME is not the camera; static where it is fixed
        +-- gvo/causal/FRAME        the window's pose of each frame as it arrived
        |   +-- gvo/causal/CAMERA
        +-- gvo/smoothed/FRAME      the pose with which each frame left the window
            +-- gvo/smoothed/CAMERA

FRAME is what the trajectory is asked for, such as `base_link` (x forward, y left, z up), or the
camera's optical frame (x right, y down, z forward). A frame has one parent, and the robot's own
tf gives `base_link` one: with names of their own these frames play beside it. Where the fixed
frame is one of the robot's (`odom`, `map`) and the trajectory starts at the robot's pose in it,
both trees have one root and line up. Without an initial pose, the world of a camera is its first
pose: z points forward. For that case `world_flu` is the same origin with x forward, y left and z
up; it is level where the camera was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gvo.geometry import se3
from gvo.io.convert.bag_messages import FramePose
from gvo.io.poses.tf_paths import bare
from gvo.types import Estimate, FloatArray

ESTIMATES: Final = ("raw", "causal", "smoothed")

# x forward, y left, z up, from the optical x right, y down, z forward (REP 103).
_T_FLU_OPTICAL: Final = se3.make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunFrames:
    """The names of a run's frames, and how the camera sits in the frame of the trajectory.

    Parameters
    ----------
    world : str
        The fixed frame that the poses are stated in.
    camera : str
        The optical frame of the rectified left or colour camera; `camera_optical` where empty.
    tracked : str
        The frame whose poses they are; where empty, the camera's.
    T_tracked_cam : ndarray of float64, shape (4, 4), or callable
        Maps camera coordinates to the tracked frame, metres. A function of stamp_ns where the
        camera moves in that frame.
    is_world_optical : bool
        Whether `world` has the axes of a camera: z forward.

    Raises
    ------
    ValueError
        For a world without a name, or a transform between a frame and itself.
    """

    world: str = "world"
    camera: str = ""
    tracked: str = ""
    T_tracked_cam: FloatArray | Callable[[int], FloatArray] = field(
        default_factory=lambda: np.eye(4)
    )
    is_world_optical: bool = False

    def __post_init__(self) -> None:
        """Choose names where none are given; tf refuses a leading slash."""
        camera = bare(self.camera) or "camera_optical"
        names = {
            "world": bare(self.world),
            "camera": camera,
            "tracked": bare(self.tracked) or camera,
        }
        for key, name in names.items():
            object.__setattr__(self, key, name)
        if not self.world:
            raise ValueError("the world needs a name")
        if not callable(self.T_tracked_cam):
            T = np.array(self.T_tracked_cam, dtype=np.float64)
            T.setflags(write=False)
            object.__setattr__(self, "T_tracked_cam", T)
            if self.is_camera and not np.array_equal(T, np.eye(4)):
                raise ValueError(f"{camera}: its transform to itself must be the identity")

    @property
    def is_camera(self) -> bool:
        """Whether the trajectory is the camera's own."""
        return self.tracked == self.camera

    def mount(self, stamp_ns: int) -> FloatArray:
        """Return T_tracked_cam, shape (4, 4), at a stamp."""
        if self.is_camera:
            return np.eye(4)
        return self.T_tracked_cam(stamp_ns) if callable(self.T_tracked_cam) else self.T_tracked_cam

    def tracked_by(self, name: str) -> str:
        """Return the tracked frame as one of `ESTIMATES` places it."""
        return f"gvo/{name}/{self.tracked}"

    def camera_by(self, name: str) -> str:
        """Return the camera's optical frame as one of `ESTIMATES` places it."""
        return f"gvo/{name}/{self.camera}"

    def moving(self, name: str, estimate: Estimate) -> Iterator[FramePose]:
        """Yield what a pose says of the frames."""
        stamp_ns = estimate.stamp_ns
        yield FramePose(stamp_ns, self.world, self.tracked_by(name), estimate.T_world_cam)
        if callable(self.T_tracked_cam) and not self.is_camera:
            yield self._mounted(stamp_ns, name)

    def fixed(self, stamp_ns: int) -> Iterator[FramePose]:
        """Yield what never moves."""
        if self.is_world_optical:
            yield FramePose(stamp_ns, f"{self.world}_flu", self.world, _T_FLU_OPTICAL)
        if not callable(self.T_tracked_cam) and not self.is_camera:
            for name in ESTIMATES:
                yield self._mounted(stamp_ns, name)

    def _mounted(self, stamp_ns: int, name: str) -> FramePose:
        parent, child = self.tracked_by(name), self.camera_by(name)
        return FramePose(stamp_ns, parent, child, self.mount(stamp_ns))
