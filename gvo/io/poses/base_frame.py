"""The base frame, whose poses are written: the camera's, or one that the camera is mounted on.

The camera frame of a recording is the frame_id of its images. It names the optical frame of the
rectified camera (x right, y down, z forward), as in image_geometry and stereo_image_proc; so what
`/tf` says of it holds for the rectified images without another rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from gvo._text import plain_number
from gvo.errors import ConfigurationError, RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.bag.messages import bare
from gvo.io.bag.source import BagSource
from gvo.io.poses.tf import TfBuffer, list_names
from gvo.io.poses.truth import moved
from gvo.io.recording import Source
from gvo.trajectory.g2o import transforms_of
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, Estimate, Failure, FloatArray, InertialState, IntArray, Loop

InitialPose: TypeAlias = FloatArray | Literal["truth"]
Mount: TypeAlias = Callable[[int], tuple[FloatArray, bool]]

_ROTATION_TOLERANCE = 1e-3
# Over so long a time the motion of a camera on its frame is measured, nanoseconds.
_MOTION_NS = 20_000_000


class BaseFrame:
    """Converts poses of the camera into poses of the base frame, on which it is mounted.

    The world is chosen so that the first pose is the initial pose. The first estimate given to
    `apply` is taken for that of the first frame, unless `start` was called.

    Parameters
    ----------
    name : str
        Of the frame; empty where it has none.
    T_base_cam : ndarray of float64, shape (4, 4), or callable
        Maps camera coordinates to the base frame, metres; omitted for the camera itself. A
        function of stamp_ns where the camera moves on it: returns the matrix, and whether it is
        that of another stamp.
    T_initial : ndarray of float64, shape (4, 4), optional
        T_world_base of the first frame, metres; the identity where omitted.
    origin : str
        Where its mount comes from, in words; empty for tf and the camera itself.

    Attributes
    ----------
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
        T_base_cam: FloatArray | Mount | None = None,
        *,
        T_initial: FloatArray | None = None,
        origin: str = "",
    ) -> None:
        self.name = name
        self.origin = origin
        self.first_stamp_ns: int | None = None
        self.is_camera = T_base_cam is None
        self.T_initial = None if T_initial is None else _rigid("T_initial", T_initial)
        self._mount: FloatArray | Mount
        if callable(T_base_cam):
            self._mount = T_base_cam
        else:
            self._mount = np.eye(4) if T_base_cam is None else _rigid("T_base_cam", T_base_cam)
        self._guessed_stamps_ns: set[int] = set()
        self._mount_low = np.full(3, np.inf)
        self._mount_high = np.full(3, -np.inf)
        self._T_world_cam_first = np.eye(4)

    @property
    def is_placed(self) -> bool:
        """Tell whether an initial pose was asked for."""
        return self.T_initial is not None

    @property
    def fixed_mount(self) -> FloatArray | None:
        """T_base_cam, shape (4, 4), metres; None for the camera, and where it moves."""
        return None if self.is_camera or callable(self._mount) else self._mount

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
        mount = None if self.is_camera else self._mount
        return BaseFrame(self.name, mount, T_initial=self.T_initial, origin=self.origin)

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
        T, is_guessed = self._mount_at(stamp_ns)
        self._mount_low = np.minimum(self._mount_low, T[:3, 3])
        self._mount_high = np.maximum(self._mount_high, T[:3, 3])
        if is_guessed:
            self._guessed_stamps_ns.add(stamp_ns)
        return T

    def _mount_at(self, stamp_ns: int) -> tuple[FloatArray, bool]:
        return self._mount(stamp_ns) if callable(self._mount) else (self._mount, False)

    def apply(self, estimate: Estimate) -> Estimate:
        """Return the estimate of the base frame; the same object where there is nothing to do.

        Parameters
        ----------
        estimate : Estimate
            Of the camera, in the world of the first camera: raw, causal or smoothed.
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
            effects=_transported(estimate.effects, T_base_cam),
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
            effects=_transported(edge.effects, self.T_base_cam(stamp_ns)),
        )

    def apply_to_loop(self, loop: Loop) -> Loop:
        """Return a loop as one of the base frame."""
        edge = self.apply_to_edge(loop.stamp_ns, loop.edge)
        return replace(
            loop,
            T_reference_frame=edge.T_reference_frame,
            covariance=edge.covariance,
            effects=edge.effects,
        )

    def apply_to_inertial(self, state: InertialState | None) -> InertialState | None:
        """Return what the IMU tells of the camera as what it tells of the base frame."""
        if self.is_camera or state is None:
            return state
        T_base_cam, _ = self._mount_at(state.stamp_ns)
        ends_ns = state.stamp_ns - _MOTION_NS // 2, state.stamp_ns + _MOTION_NS // 2
        before, after = (self._mount_at(stamp_ns)[0] for stamp_ns in ends_ns)
        on_base = se3.log(se3.invert(before) @ after) * 1e9 / _MOTION_NS
        return replace(
            state,
            twist=se3.adjoint(T_base_cam) @ (state.twist - on_base),
            twist_covariance=se3.transport_covariance(state.twist_covariance, T_base_cam),
            up=T_base_cam[:3, :3] @ state.up,
        )

    def convert(self, trajectory: Trajectory) -> Trajectory:
        """Convert true poses of the camera, in any world, into those of the base frame.

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
                "positions without rotations cannot be moved from the camera to "
                f"{self.name or 'another frame'}; run without --frame to compare them"
            )
        if self.fixed_mount is not None:
            return trajectory.transformed(se3.invert(self.fixed_mount))
        found = [self._mount_at(int(stamp_ns)) for stamp_ns in trajectory.stamps_ns]
        is_known = np.array([not is_guessed for _, is_guessed in found], dtype=np.bool_)
        T_base_cam = np.array([T for T, _ in found]).reshape(-1, 4, 4)
        return moved(trajectory, se3.invert(T_base_cam), is_known)


def _transported(effects: FloatArray | None, T_base_cam: FloatArray) -> FloatArray | None:
    return None if effects is None else np.asarray(se3.adjoint(T_base_cam) @ effects)


def find_base_frame(
    source: Source, name: str | None = None, *, T_initial: FloatArray | None = None
) -> BaseFrame:
    """Find a base frame by its name, and where the camera is mounted on it.

    Parameters
    ----------
    source : Source
        The recording.
    name : str, optional
        As `/tf` of a bag names it; where that does not connect it with the camera, it is the
        body that the calibration places the camera on. Omitted: the camera itself.
    T_initial : ndarray of float64, shape (4, 4), optional
        T_world_frame of the first frame, metres; the identity where omitted.

    Raises
    ------
    RecordingError
        When neither says where the camera is.
    """
    info = source.info
    if name is None:
        return BaseFrame(info.frame_id, T_initial=T_initial)
    name = name.strip("/")
    if isinstance(source, BagSource):
        buffer = source.transforms((name, info.frame_id))
        if info.T_body_cam is None or name in buffer.frames:
            mount = mount_by_tf(buffer, name, bare(info.frame_id), info.name)
            return BaseFrame(name, mount, T_initial=T_initial)
    if info.T_body_cam is None:
        raise RecordingError(
            f"{info.name}: --frame {name}: the recording does not say where the camera is on it; "
            "give a calibration with the camera's pose on the body by --calibration FILE"
        )
    origin = "the body on which the calibration places the camera"
    return BaseFrame(name, info.T_body_cam, T_initial=T_initial, origin=origin)


def mount_by_tf(
    buffer: TfBuffer, frame: str, camera_frame: str, where: str
) -> FloatArray | Mount | None:
    """Return T_frame_camera, over time where it moves; None where both are one frame."""
    if frame == camera_frame:
        return None
    if not camera_frame:
        raise RecordingError(
            f"{where}: --frame {frame}: the images name no camera frame (their frame_id is "
            "empty); give T_body_cam by --calibration FILE"
        )
    stamps_ns, T_frame_camera = buffer.known(frame, camera_frame)
    if len(stamps_ns):
        return _moving_mount(buffer, frame, camera_frame, stamps_ns, T_frame_camera)
    all_ns = buffer.edge_stamps_ns(frame, camera_frame)
    T = buffer.lookup(frame, camera_frame, int(all_ns[0]) if len(all_ns) else 0)
    if not isinstance(T, Failure):
        return T
    is_named = {frame, camera_frame} <= set(buffer.frames)
    held = f"; tf holds {list_names(buffer.frames)}" if is_named else ""
    raise RecordingError(
        f"{where}: --frame {frame}: no transform from the camera frame {camera_frame}: "
        f"{T.reason}{held}; give another --frame, or T_body_cam by --calibration FILE"
    )


def _moving_mount(
    buffer: TfBuffer, frame: str, camera_frame: str, stamps_ns: IntArray, known: FloatArray
) -> Mount:
    """Return T_frame_camera over time; where it is not known, that of the nearest known stamp."""

    def mount(stamp_ns: int) -> tuple[FloatArray, bool]:
        T = buffer.lookup(frame, camera_frame, stamp_ns)
        if not isinstance(T, Failure):
            return T, False
        return known[np.argmin(np.abs(stamps_ns - stamp_ns))], True

    return mount


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
    expected = "expected X,Y,Z or X,Y,Z,QX,QY,QZ,QW (metres), or truth"
    try:
        numbers = [float(plain_number(word)) for word in text.split(",")]
    except ValueError:
        numbers = []
    numbers += [0.0, 0.0, 0.0, 1.0] if len(numbers) == 3 else []
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        raise ConfigurationError(f"--initial-pose {text!r}: {expected}")
    try:
        return np.asarray(transforms_of(np.array([numbers]))[0])
    except ValueError as error:
        raise ConfigurationError(f"--initial-pose {text!r}: {error}; {expected}") from None


def _rigid(name: str, T: FloatArray) -> FloatArray:
    T = np.array(T, dtype=np.float64)
    fault = se3.transform_fault(T, tolerance=_ROTATION_TOLERANCE)
    if fault:
        raise ValueError(f"{name} {fault}")
    return se3.normalize(T)
