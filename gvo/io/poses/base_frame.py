"""The base frame, whose poses are written: the camera's, or one that the camera is mounted on.

The camera frame of a recording is the frame_id of its images. It names the optical frame of the
rectified camera (x right, y down, z forward), as in image_geometry and stereo_image_proc; so what
`/tf` says of it holds for the rectified images without another rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import plain_number
from gvo.errors import ConfigurationError, RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.poses.tf import TfBuffer
from gvo.io.poses.tf_paths import bare, list_names
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, Estimate, Failure, FloatArray, IntArray, Loop

InitialPose: TypeAlias = FloatArray | Literal["truth"]

_NORM_TOLERANCE = 1e-2
_ROTATION_TOLERANCE = 1e-3


class BaseFrame:
    """Converts poses of the camera into poses of the base frame.

    The world is chosen so that the first pose is the initial pose. The first estimate given to
    `apply` is taken for that of the first frame, unless `start` was called.

    Parameters
    ----------
    name : str
        Of the frame; empty where it has none.
    T_base_cam : ndarray of float64, shape (4, 4), or callable
        Maps camera coordinates to the base frame, metres. A function of stamp_ns where the
        camera moves on it: returns the matrix, and whether it is that of another stamp.
    T_initial : ndarray of float64, shape (4, 4), optional
        T_world_base of the first frame, metres; the identity where omitted.

    Attributes
    ----------
    name : str
    origin : str
        Where its mount comes from, in words; empty for tf and the camera itself.
    first_stamp_ns : int or None
        Stamp of the first frame, once it is known.

    Raises
    ------
    ValueError
        When a matrix is no rigid transform.
    """

    def __init__(
        self,
        name: str = "",
        T_base_cam: FloatArray | Callable[[int], tuple[FloatArray, bool]] | None = None,
        *,
        T_initial: FloatArray | None = None,
    ) -> None:
        self.name = name
        self.origin = ""
        self.first_stamp_ns: int | None = None
        self.is_camera = T_base_cam is None
        self.T_initial = None if T_initial is None else _rigid("T_initial", T_initial)
        self._guessed_stamps_ns: set[int] = set()
        self._mount_low = np.full(3, np.inf)
        self._mount_high = np.full(3, -np.inf)
        self._T_world_cam_first = np.eye(4)
        self._T_base_cam: FloatArray | None = None
        if callable(T_base_cam):
            self._mount = T_base_cam
        else:
            T = np.eye(4) if T_base_cam is None else _rigid("T_base_cam", T_base_cam)
            self._T_base_cam = T
            self._mount = lambda _: (T, False)

    @classmethod
    def from_tf(
        cls,
        buffer: TfBuffer,
        frame: str,
        camera_frame: str,
        *,
        T_initial: FloatArray | None = None,
        where: str = "the recording",
    ) -> BaseFrame:
        """Take from `/tf` where the camera is mounted on a frame.

        Parameters
        ----------
        buffer : TfBuffer
            Of the recording.
        frame : str
            Its name.
        camera_frame : str
            The frame_id of the images.
        T_initial : ndarray of float64, shape (4, 4), optional
            T_world_base of the first frame, metres; the identity where omitted.
        where : str
            The recording, for messages.

        Raises
        ------
        RecordingError
            When `/tf` does not connect the frames.
        """
        frame, camera_frame = bare(frame), bare(camera_frame)
        if frame == camera_frame:
            return cls(frame, T_initial=T_initial)
        if not camera_frame:
            raise RecordingError(
                f"{where}: --frame {frame}: the images name no camera frame (their frame_id is "
                "empty); give T_body_cam by --calibration FILE"
            )
        if buffer.is_static(frame, camera_frame):
            T_base_cam = buffer.lookup(frame, camera_frame, 0)
            if isinstance(T_base_cam, Failure):
                raise _not_found(where, frame, camera_frame, buffer, T_base_cam.reason)
            return cls(frame, T_base_cam, T_initial=T_initial)
        return cls(frame, _MovingMount(buffer, frame, camera_frame, where), T_initial=T_initial)

    @property
    def is_placed(self) -> bool:
        """Tell whether an initial pose was asked for."""
        return self.T_initial is not None

    @property
    def fixed_mount(self) -> FloatArray | None:
        """T_base_cam, shape (4, 4), metres; None for the camera, and where it moves."""
        return None if self.is_camera else self._T_base_cam

    @property
    def n_guessed(self) -> int:
        """Frames whose transform `/tf` does not hold: the one nearest in time was taken."""
        return len(self._guessed_stamps_ns)

    @property
    def mount_travel_m(self) -> float:
        """Diagonal of the box around the camera's positions on the base frame so far, metres."""
        return float(np.linalg.norm(np.maximum(self._mount_high - self._mount_low, 0.0)))

    def restarted(self) -> BaseFrame:
        """Return the same frame before a first frame."""
        mount = self._mount if self._T_base_cam is None else self._T_base_cam
        again = BaseFrame(self.name, None if self.is_camera else mount, T_initial=self.T_initial)
        again.origin = self.origin
        return again

    def start(self, stamp_ns: int, T_initial: FloatArray | None = None) -> None:
        """Say which frame is the first one.

        Parameters
        ----------
        stamp_ns : int
            Its stamp, nanoseconds.
        T_initial : ndarray of float64, shape (4, 4), optional
            T_world_base at that stamp, in place of the one given before.

        Raises
        ------
        ValueError
            Where the first frame is known already, or the matrix is no rigid transform.
        """
        if self.first_stamp_ns is not None:
            raise ValueError(f"the first frame is that of {self.first_stamp_ns} ns already")
        if T_initial is not None:
            self.T_initial = _rigid("T_initial", T_initial)
        self.first_stamp_ns = stamp_ns
        T_base_cam = self.T_base_cam(stamp_ns)
        T_initial = np.eye(4) if self.T_initial is None else self.T_initial
        self._T_world_cam_first = T_initial @ T_base_cam

    def T_base_cam(self, stamp_ns: int) -> FloatArray:  # noqa: N802 - the field's name
        """Return where the camera is mounted at a stamp, shape (4, 4), metres."""
        T, is_guessed = self._mount(stamp_ns)
        self._mount_low = np.minimum(self._mount_low, T[:3, 3])
        self._mount_high = np.maximum(self._mount_high, T[:3, 3])
        if is_guessed:
            self._guessed_stamps_ns.add(stamp_ns)
        return T

    def apply(self, estimate: Estimate) -> Estimate:
        """Return the estimate of the base frame.

        Parameters
        ----------
        estimate : Estimate
            Of the camera, in the world of the first camera: raw, causal or smoothed.

        Returns
        -------
        Estimate
            The very same object where there is nothing to do.
        """
        if self.first_stamp_ns is None:
            self.start(estimate.stamp_ns)
        if self.is_camera and self.T_initial is None:
            return estimate
        T_base_cam = self.T_base_cam(estimate.stamp_ns)
        T_camera = self._T_world_cam_first @ estimate.T_world_frame
        # T exp(xi) B = T B exp(Ad(B^-1) xi), with B = T_cam_frame
        covariance = se3.transport_covariance(estimate.covariance, T_base_cam)
        return replace(
            estimate,
            T_world_frame=T_camera @ se3.invert(T_base_cam),
            covariance=0.5 * (covariance + covariance.T),  # symmetric in spite of rounding
        )

    def apply_to_step(self, start_ns: int, stamp_ns: int, T_start_end: FloatArray) -> FloatArray:
        """Return a motion of the camera between two stamps, (4, 4), as one of the base frame."""
        if self.is_camera:
            return T_start_end
        T_end = se3.invert(self.T_base_cam(stamp_ns))
        return np.asarray(self.T_base_cam(start_ns) @ T_start_end @ T_end)

    def apply_to_world(self, T_map_world: FloatArray) -> FloatArray:
        """Return a correction of poses of the camera, (4, 4), as one of those of the base frame."""
        T = self._T_world_cam_first
        return np.asarray(T @ T_map_world @ se3.invert(T))

    def apply_to_edge(self, stamp_ns: int, edge: Edge) -> Edge:
        """Return an edge between two stamps, the later one given, as one of the base frame."""
        if self.is_camera:
            return edge
        start_ns = int(edge.reference_id)  # type: ignore[call-overload]
        return replace(
            edge,
            T_reference_frame=self.apply_to_step(start_ns, stamp_ns, edge.T_reference_frame),
            covariance=se3.transport_covariance(edge.covariance, self.T_base_cam(stamp_ns)),
        )

    def apply_to_loop(self, loop: Loop) -> Loop:
        """Return a loop as one of the base frame."""
        edge = self.apply_to_edge(loop.stamp_ns, loop.edge)
        return replace(loop, T_reference_frame=edge.T_reference_frame, covariance=edge.covariance)

    def convert(self, trajectory: Trajectory) -> Trajectory:
        """Convert a trajectory of the camera into that of the base frame.

        Its world stays as it is: for comparing true poses of the camera with estimates of the
        frame.

        Parameters
        ----------
        trajectory : Trajectory
            Of the camera, in any world.

        Returns
        -------
        Trajectory
            T_world_frame, without the poses at whose stamps the place of the camera in the frame
            is not known, and without covariances where the camera moves there.

        Raises
        ------
        TrajectoryError
            When the trajectory holds positions alone, and the frame is not the camera.
        """
        if self.is_camera:
            return trajectory
        if not trajectory.has_rotations:
            raise TrajectoryError(
                "positions of the camera without rotations tell no positions of "
                f"{self.name or 'another frame'}; run without --frame to compare them"
            )
        if self._T_base_cam is not None:
            return trajectory.transformed(se3.invert(self._T_base_cam))
        found = [self._mount(int(stamp_ns)) for stamp_ns in trajectory.stamps_ns]
        is_known = np.array([not is_guessed for _, is_guessed in found], dtype=np.bool_)
        T_base_cam = np.array([T for T, _ in found]).reshape(-1, 4, 4)[is_known]
        known = trajectory.select(is_known)
        T_world_frame = known.T_world_frame @ se3.invert(T_base_cam)
        return replace(known, T_world_frame=T_world_frame, covariances=None)


class _MovingMount:
    """Looks up where a camera that moves on the base frame is mounted."""

    def __init__(self, buffer: TfBuffer, frame: str, camera_frame: str, where: str) -> None:
        self._buffer, self._frame, self._camera_frame = buffer, frame, camera_frame
        stamps_ns = buffer.edge_stamps_ns(frame, camera_frame)
        _, is_known = buffer.lookup_many(frame, camera_frame, stamps_ns)
        self._known_stamps_ns: IntArray = stamps_ns[is_known]
        if len(self._known_stamps_ns) == 0:
            answer = buffer.lookup(frame, camera_frame, int(stamps_ns[0]) if len(stamps_ns) else 0)
            reason = answer.reason if isinstance(answer, Failure) else "no transform at any stamp"
            raise _not_found(where, frame, camera_frame, buffer, reason)

    def __call__(self, stamp_ns: int) -> tuple[FloatArray, bool]:
        T = self._buffer.lookup(self._frame, self._camera_frame, stamp_ns)
        if not isinstance(T, Failure):
            return T, False
        known_ns = self._known_stamps_ns
        after = int(np.searchsorted(known_ns, stamp_ns))
        beside = known_ns[max(after - 1, 0) : after + 1]
        nearest_ns = int(beside[np.argmin(np.abs(beside - stamp_ns))])
        T = self._buffer.lookup(self._frame, self._camera_frame, nearest_ns)
        if isinstance(T, Failure):  # known when this was made; the buffer was changed since
            raise ValueError(f"the buffer was changed after it was given away: {T.reason}")
        return T, True


def parse_initial_pose(text: str) -> InitialPose:
    """Read what `--initial-pose` was given.

    Parameters
    ----------
    text : str
        `X,Y,Z` or `X,Y,Z,QX,QY,QZ,QW` in metres, or `truth`.

    Returns
    -------
    ndarray of float64, shape (4, 4), or "truth"
        T_world_base of the first frame; `truth` means the first pose of the ground truth.

    Raises
    ------
    ConfigurationError
        When it is none of these.

    Examples
    --------
    >>> parse_initial_pose("1,2,0")[:3, 3]
    array([1., 2., 0.])
    """
    if text.strip() == "truth":
        return "truth"
    try:
        numbers = np.array([float(plain_number(word)) for word in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) not in (3, 7) or not np.isfinite(numbers).all():
        raise ConfigurationError(
            f"--initial-pose {text!r}: expected X,Y,Z or X,Y,Z,QX,QY,QZ,QW (metres), or truth"
        )
    quaternion_xyzw = numbers[3:] if len(numbers) == 7 else np.array([0.0, 0.0, 0.0, 1.0])
    norm = math.hypot(*quaternion_xyzw)  # squares of huge numbers overflow
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise ConfigurationError(
            f"--initial-pose {text!r}: the quaternion QX,QY,QZ,QW has the norm {norm:.4g}, "
            "expected 1"
        )
    R = np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix())
    return se3.make_transform(R, numbers[:3])


def _rigid(name: str, T: FloatArray) -> FloatArray:
    T = np.array(T, dtype=np.float64)
    fault = se3.transform_fault(T, tolerance=_ROTATION_TOLERANCE)
    if fault:
        raise ValueError(f"{name} {fault}")
    return se3.normalize(T)


def _not_found(
    where: str, frame: str, camera_frame: str, buffer: TfBuffer, reason: str
) -> RecordingError:
    is_named = {frame, camera_frame} <= set(buffer.frames)
    held = f"; tf holds {list_names(buffer.frames)}" if is_named else ""
    return RecordingError(
        f"{where}: --frame {frame}: no transform from the camera frame {camera_frame}: "
        f"{reason}{held}; give another --frame, or T_body_cam by --calibration FILE"
    )
