"""The frozen values that travel between the stages."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from numbers import Integral
from typing import Any, Literal, Protocol, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gvo._text import format_stamp
from gvo.config import Kernel

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
ImageArray: TypeAlias = NDArray[np.uint8]
DepthArray: TypeAlias = NDArray[np.float32]
FrameId: TypeAlias = Hashable
_Images: TypeAlias = tuple[NDArray[Any], NDArray[Any]]


def _freeze(value: object, **shapes: tuple[int, ...]) -> None:
    """Replace arrays by read-only copies in float64 of the given shapes."""
    for name, shape in shapes.items():
        try:
            array = np.array(getattr(value, name), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be an array of numbers: {error}") from None
        if array.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
        array.setflags(write=False)
        object.__setattr__(value, name, array)


def _check_kernel(kernel: str | None) -> None:
    if kernel is not None and kernel not in get_args(Kernel):
        raise ValueError(f"kernel must be one of {get_args(Kernel)}, got {kernel!r}")


def _check_images(
    kind: str, stamp_ns: int, images: _Images, dtype: type, *masks: NDArray[Any] | None
) -> None:
    first, second = images
    if not isinstance(stamp_ns, Integral):
        raise ValueError(f"the stamp of {kind} must be an int of nanoseconds, got {stamp_ns!r}")
    for image in images:
        if not isinstance(image, np.ndarray):
            raise ValueError(f"the images of {kind} must be arrays, got {type(image).__name__}")
    if first.ndim != 2 or first.shape != second.shape:
        raise ValueError(
            f"the images of {kind} must be (height, width) and of one size, "
            f"got {first.shape} and {second.shape}"
        )
    if first.dtype != np.uint8 or second.dtype != dtype:
        raise ValueError(
            f"the images of {kind} must be uint8 and {np.dtype(dtype)}, "
            f"got {first.dtype} and {second.dtype}"
        )
    for mask in masks:
        if mask is not None and (mask.dtype != np.uint8 or mask.shape != first.shape):
            raise ValueError(
                f"a mask of {kind} must be uint8 of {first.shape}, got {mask.dtype} {mask.shape}"
            )


class Stamped(Protocol):
    """Anything with a stamp: a frame, or what a front-end keeps of one."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""


class Status(StrEnum):
    """What ties a frame's pose to the frames before it."""

    OK = "ok"
    """At least one registration against an earlier frame."""
    COASTING = "coasting"
    """No registration: the pose continues the last velocity, or an IMU leads to it."""
    LOST = "lost"
    """Coasting for more than two seconds, without an IMU that led there."""
    RESUMED = "resumed"
    """The first registered frame after coasting or lost ones."""
    SKIPPED = "skipped"
    """A faulty frame: no pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentJoin:
    """A segment found its place among earlier ones: a kept keyframe was seen again.

    Parameters
    ----------
    segment, to_segment : int
        Which one was joined to which earlier one.
    stamp_ns, reference_ns : int
        Of the frame that saw the keyframe, and of that keyframe, nanoseconds.
    """

    segment: int
    to_segment: int
    stamp_ns: int
    reference_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """An answer that the data do not hold; falsy, so that `if result:` reads well.

    Parameters
    ----------
    reason : str
        One line: what was missing, with its numbers.
    n_matches, n_inliers : int
        How far it came.
    """

    reason: str
    n_matches: int = 0
    n_inliers: int = 0

    def __bool__(self) -> bool:
        """Tell that there is no result."""
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction(Failure):
    """A failure that another attempt at the same two frames cannot heal: two answers, not none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoFrame:
    """One rectified stereo pair.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the left image, nanoseconds.
    left, right : ndarray of uint8, shape (height, width)
        Rectified grey images: a point lies on the same row of both.
    mask, right_mask : ndarray of uint8, shape (height, width), optional
        0 where nothing of the left or right image is to be used.
    """

    stamp_ns: int
    left: ImageArray
    right: ImageArray
    mask: ImageArray | None = None
    right_mask: ImageArray | None = None

    def __post_init__(self) -> None:
        """Check shapes and types once."""
        images, masks = (self.left, self.right), (self.mask, self.right_mask)
        _check_images("a stereo frame", self.stamp_ns, images, np.uint8, *masks)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdFrame:
    """One undistorted grey image with its depth.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the colour image, nanoseconds.
    image : ndarray of uint8, shape (height, width)
        Grey image made of the colour image.
    depth : ndarray of float32, shape (height, width)
        Metres along the optical axis, NaN = unknown.
    depth_stamp_ns : int, optional
        Stamp of the depth image; None: taken with the colour image.
    mask : ndarray of uint8, shape (height, width), optional
        0 where nothing is to be used: depth becomes unknown there.
    """

    stamp_ns: int
    image: ImageArray
    depth: DepthArray
    depth_stamp_ns: int | None = None
    mask: ImageArray | None = None

    def __post_init__(self) -> None:
        """Check shapes and types once."""
        images = self.image, self.depth
        _check_images("an RGB-D frame", self.stamp_ns, images, np.float32, self.mask)
        if self.mask is not None:
            depth = np.where(self.mask > 0, self.depth, np.float32(np.nan))
            object.__setattr__(self, "depth", depth)


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultyFrame:
    """A frame of the recording that cannot be used; it is skipped and counted.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the faulty frame, nanoseconds.
    reason : str
        One line: what, where.
    is_unpaired : bool
        Nothing is wrong with the image but that it has no partner.
    """

    stamp_ns: int
    reason: str
    is_unpaired: bool = False


Frame: TypeAlias = StereoFrame | RgbdFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """What a front-end keeps of one frame: n points, seen and measured in 3-D.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the frame, nanoseconds.
    keypoints : ndarray of float64, shape (n, 2)
        Pixels (u, v) in the left or colour image.
    disparities : ndarray of float64, shape (n,)
        Disparity in pixels; for RGB-D the virtual one, fx * baseline / depth.
    points_cam : ndarray of float64, shape (n, 3)
        Points in the `cam` frame, metres.
    sigmas : ndarray of float64, shape (n, 3)
        Standard deviations of (u, v, disparity), pixels.
    descriptors_left : ndarray of uint8 or float32, shape (n, m)
        Binary descriptors (Hamming distance) or real ones (Euclidean distance).
    descriptors_right : ndarray or None
        The same of the matched pixels in the right image; None for RGB-D.
    n_keypoints : int
        Keypoints detected before matching and filtering.
    """

    stamp_ns: int
    keypoints: FloatArray
    disparities: FloatArray
    points_cam: FloatArray
    sigmas: FloatArray
    descriptors_left: NDArray[np.uint8] | NDArray[np.float32]
    descriptors_right: NDArray[np.uint8] | NDArray[np.float32] | None = None
    n_keypoints: int = 0

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.keypoints)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionPrior:
    """What is expected of the motion between two frames; a guess that may be wrong.

    Parameters
    ----------
    T_predicted : ndarray of float64, shape (4, 4)
        T_reference_current as predicted by the last velocity, or by poses that are known.
    T_recent : ndarray of float64, shape (4, 4), optional
        T_reference_current at the recent median velocity, of consecutive frames. What passes the
        camera slowly draws the last velocity along, but not this one: it tells which of two
        motions is the camera's.
    is_confirmed : bool
        False where the frames before could not be registered either: what is found is not believed
        before enough of the view is seen again.
    """

    T_predicted: FloatArray
    T_recent: FloatArray | None = None
    is_confirmed: bool = True

    def __post_init__(self) -> None:
        """Copy the arrays."""
        _freeze(self, T_predicted=(4, 4))
        if self.T_recent is not None:
            _freeze(self, T_recent=(4, 4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """A registration's result.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Maps coordinates of the current camera to the reference camera, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the current camera frame.
    passing_covariance : ndarray of float64, shape (6, 6)
        The part of it that the next registration from the current frame takes back, so that it
        does not add up along a chain.
    matches : ndarray of int64, shape (n, 2)
        Indices into the observations of reference and current; -1 where the current frame
        holds none of the point. Empty where the front-end does not tell.
    inliers : ndarray of bool, shape (n,)
        Which matches the pose rests on.
    pixels_reference, pixels_current : ndarray of float64, shape (n, 2)
        Where the matches are in either image, (u, v). Empty where the front-end does not tell.
    points_current : ndarray of float64, shape (n, 3)
        The matches as measured in the current frame, in its `cam` frame in the middle of its
        exposure, metres. Likewise.
    flow_px : float or None
        Median displacement of the inliers between the images, where the front-end tells.
    effects : mapping of str to ndarray of float64, shape (6,)
        By how much the pose is moved, in the current camera frame, by a sigma of each constant of
        the camera that is in doubt, by name.
    shared : ndarray of float64, shape (6, k), optional
        The same of errors that all registrations of this camera share, in units of their size; they
        are not in the covariance. None where the front-end does not tell.
    """

    T_reference_current: FloatArray
    covariance: FloatArray
    passing_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    matches: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    inliers: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    pixels_reference: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    pixels_current: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    points_current: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    flow_px: float | None = None
    effects: Mapping[str, FloatArray] = field(default_factory=dict)
    shared: FloatArray | None = None

    @property
    def n_matches(self) -> int:
        """Number of temporal matches."""
        return len(self.matches)

    @property
    def n_inliers(self) -> int:
        """Number of matches the pose rests on."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """A relative pose to a frame that is already in the window.

    Only shapes are checked here; the window judges the values and refuses what is no rotation
    or no covariance (`Rejected`).

    Parameters
    ----------
    reference_id : hashable
        The frame the measurement refers to.
    T_reference_frame : ndarray of float64, shape (4, 4)
        Maps coordinates of the new frame to the reference frame, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the new frame.
    kernel : {"none", "huber", "cauchy", "geman_mcclure", "dcs"}, optional
        Robust kernel of this edge; the window's where omitted.
    effects : ndarray of float64, shape (6, k), optional
        By how much each of k errors that all edges share moves the new frame, right perturbation:
        those of a calibration, say, in units of their size. They are beside the covariance: neither
        more edges nor a longer way make them average out. None: there are none.

    Raises
    ------
    ValueError
        Where a shape does not fit or the kernel is none of these.
    """

    reference_id: FrameId
    T_reference_frame: FloatArray
    covariance: FloatArray
    kernel: Kernel | None = None
    effects: FloatArray | None = None

    def __post_init__(self) -> None:
        """Copy the arrays."""
        if self.effects is not None:
            _freeze(self, effects=(6, np.shape(self.effects)[-1]))
        try:
            hash(self.reference_id)
        except TypeError:
            raise ValueError(f"reference_id must be hashable: {self.reference_id!r}") from None
        _freeze(self, T_reference_frame=(4, 4), covariance=(6, 6))
        _check_kernel(self.kernel)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePrior:
    """A measured pose of one frame in the world: a known start, a motion-capture fix.

    Parameters
    ----------
    T_world_frame : ndarray of float64, shape (4, 4)
        Maps coordinates of the frame to the world, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame.
    kernel : {"none", "huber", "cauchy", "geman_mcclure", "dcs"}
        Robust kernel.
    """

    T_world_frame: FloatArray
    covariance: FloatArray
    kernel: Kernel = "none"

    def __post_init__(self) -> None:
        """Copy the arrays."""
        _freeze(self, T_world_frame=(4, 4), covariance=(6, 6))
        _check_kernel(self.kernel)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PositionPrior:
    """A measured position of one frame in the world, such as a GPS fix.

    Parameters
    ----------
    position_world : ndarray of float64, shape (3,)
        Origin of the frame in the world, metres.
    covariance : ndarray of float64, shape (3, 3)
        Along the axes of the world, metres squared.
    kernel : {"none", "huber", "cauchy", "geman_mcclure", "dcs"}
        Robust kernel: fixes by satellites are off by far more than they say now and then.
    """

    position_world: FloatArray
    covariance: FloatArray
    kernel: Kernel = "huber"

    def __post_init__(self) -> None:
        """Copy the arrays."""
        _freeze(self, position_world=(3,), covariance=(3, 3))
        _check_kernel(self.kernel)


Prior: TypeAlias = PosePrior | PositionPrior


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """An edge or a prior that the window refused; falsy, so that `if answer:` reads well.

    Parameters
    ----------
    frame_id : hashable
        The frame it was given for.
    stamp_ns : int or None
        Stamp of that frame, where it is known.
    reason : str
        One line: what is wrong, with its numbers.
    reference_id : hashable
        The other frame of an edge; None for a prior.
    """

    frame_id: FrameId
    stamp_ns: int | None
    reason: str
    reference_id: FrameId = None

    def __bool__(self) -> bool:
        """Tell that nothing was added."""
        return False

    def __str__(self) -> str:
        """Name the frames, then the reason."""
        place = "" if self.stamp_ns is None else f" at {self.stamp_ns} ns"
        source = "prior" if self.reference_id is None else f"edge {self.reference_id!r} ->"
        return f"{source} {self.frame_id!r}{place}: {self.reason}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphEdge:
    """A measurement of the window's graph and how well the present poses fit it.

    Parameters
    ----------
    reference_id : hashable
        None for a prior: the world is its reference.
    frame_id : hashable
    T_reference_frame : ndarray of float64, shape (4, 4)
        As measured, metres; of a position prior, the present orientation.
    covariance : ndarray of float64, shape (n, n)
        n is 6; 3 for a position prior.
    residual : ndarray of float64, shape (n,)
        Whitened: of unit covariance where the stated covariances are right.
    weight : float
        Of the robust kernel, 1 without.
    """

    reference_id: FrameId
    frame_id: FrameId
    T_reference_frame: FloatArray
    covariance: FloatArray
    residual: FloatArray
    weight: float

    @property
    def chi2(self) -> float:
        """Squared norm of the whitened residual."""
        return float(self.residual @ self.residual)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """A pose with its covariance and what it rests on.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the frame, nanoseconds.
    T_world_frame : ndarray of float64, shape (4, 4)
        Maps coordinates of the frame (of the camera, a robot's, a front-end's own) to the world,
        metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in that frame.
    status : Status
        What ties the pose to the frames before it.
    frame_id : hashable
        The caller's name of the frame.
    effects : ndarray of float64, shape (6, k), optional
        By how much each of k errors that all steps of a chain share moves the pose, right
        perturbation, by one sigma of each; the covariance contains it. None where it is not told.
    rejected : tuple of Rejected
        The edges and the prior that came with the pose and were refused.
    """

    stamp_ns: int
    T_world_frame: FloatArray
    covariance: FloatArray
    status: Status = Status.OK
    frame_id: FrameId = field(default=None)
    effects: FloatArray | None = None
    rejected: tuple[Rejected, ...] = ()

    def __post_init__(self) -> None:
        """Copy the arrays."""
        _freeze(self, T_world_frame=(4, 4), covariance=(6, 6))
        if self.effects is not None:
            _freeze(self, effects=(6, np.shape(self.effects)[-1]))

    def __repr__(self) -> str:
        """Return one line: stamp, position with its standard deviations, status."""
        R, position = self.T_world_frame[:3, :3], self.T_world_frame[:3, 3]
        with np.errstate(invalid="ignore", over="ignore"):
            sigmas = np.sqrt(np.diag(R @ self.covariance[3:, 3:] @ R.T))
        x, y, z = (f"{p:.3f} ± {s:.2g}" for p, s in zip(position, sigmas, strict=True))
        return f"Estimate({format_stamp(self.stamp_ns)} s, ({x}, {y}, {z}) m, {self.status.value})"


LinkKind: TypeAlias = Literal["step", "keyframe", "depth", "imu"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameLink:
    """An edge from an earlier frame to the newest one, after the window took it.

    Parameters
    ----------
    reference_ns : int
        Stamp of the earlier frame.
    kind : {"step", "keyframe", "depth", "imu"}
        To the frame that the raw chain goes on from, to a keyframe, to a keyframe by depth alone,
        to the frame before where only the IMU tells how the camera moved since.
    chi2 : float or None
        Squared norm of the whitened residual, of 6 degrees of freedom: about 6 where the stated
        covariances are right; None where the earlier frame left the window with the update.
    is_accepted : bool
        False where the window refused the edge.
    """

    reference_ns: int
    kind: LinkKind
    chi2: float | None
    is_accepted: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loop:
    """A frame that was registered against a place seen long before.

    Parameters
    ----------
    stamp_ns, reference_ns : int
        Of the frame, and of the one that saw the place, nanoseconds.
    T_reference_frame : ndarray of float64, shape (4, 4)
        Maps coordinates of the frame to those of the other, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame.
    n_matches, n_inliers : int
        Of the registration.
    effects : ndarray of float64, shape (6, k), optional
        As of an `Edge`.
    reason : str
        Why it does not count; empty where it does.
    """

    stamp_ns: int
    reference_ns: int
    T_reference_frame: FloatArray
    covariance: FloatArray
    n_matches: int
    n_inliers: int
    effects: FloatArray | None = None
    reason: str = ""

    @property
    def edge(self) -> Edge:
        """The measurement for a graph whose frames are named by their stamps."""
        return Edge(
            reference_id=self.reference_ns,
            T_reference_frame=self.T_reference_frame,
            covariance=self.covariance,
            effects=self.effects,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optimum:
    """The poses of a run that fit all that was measured best.

    Parameters
    ----------
    estimates : tuple of Estimate
        Of all frames, by stamp, with marginal covariances; the smoothed ones where no loop counts.
    frames_ns : tuple of int
        Stamps of those frames among them that the edges are between.
    edges : tuple of (int, Edge)
        The stamp of a frame, and its pose in another one; without loops.
    loops : tuple of Loop
        All that were registered; those that do not count have a reason.
    residuals : ndarray of float64, shape (n,)
        Norms of the loops' whitened residuals, about 2.4 where the covariances are right.
    error_before, error : float or None
        Half the sum of the squared whitened residuals, of the smoothed poses and of these; None
        where no loop counts.
    n_iterations : int
    """

    estimates: tuple[Estimate, ...]
    frames_ns: tuple[int, ...]
    edges: tuple[tuple[int, Edge], ...]
    loops: tuple[Loop, ...]
    residuals: FloatArray
    error_before: float | None = None
    error: float | None = None
    n_iterations: int = 0

    def __repr__(self) -> str:
        """Return one line: how many poses, edges and loops."""
        sizes = len(self.estimates), len(self.edges), len(self.loops)
        return "Optimum({} poses, {} edges, {} loops)".format(*sizes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InertialState:
    """What the IMU and the camera tell together, at a frame.

    Parameters
    ----------
    stamp_ns : int
    twist : ndarray of float64, shape (6,)
        Angular velocity and velocity of the frame (of the camera, of a robot) in its own axes,
        rad/s and m/s.
    twist_covariance : ndarray of float64, shape (6, 6)
    up : ndarray of float64, shape (3,)
        The unit vector against gravity, in the axes of the frame.
    gyro_bias, acceleration_bias : ndarray of float64, shape (3,)
        In the axes of the IMU, rad/s and m/s^2.
    sigmas : ndarray of float64, shape (3,)
        Of `up` (rad), and of both biases: of the least certain axis of each.
    """

    stamp_ns: int
    twist: FloatArray
    twist_covariance: FloatArray
    up: FloatArray
    gyro_bias: FloatArray
    acceleration_bias: FloatArray
    sigmas: FloatArray

    def __post_init__(self) -> None:
        """Copy the arrays."""
        vectors = dict.fromkeys(("up", "gyro_bias", "acceleration_bias", "sigmas"), (3,))
        _freeze(self, twist=(6,), twist_covariance=(6, 6), **vectors)

    @property
    def velocity(self) -> FloatArray:
        """The velocity (3,) of the frame, m/s."""
        return self.twist[3:]

    @property
    def velocity_sigma(self) -> float:
        """Standard deviation of the velocity along its least certain axis, m/s."""
        return float(np.sqrt(self.twist_covariance.diagonal()[3:].max()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameResult:
    """What one frame gave.

    Parameters
    ----------
    raw, causal : Estimate
        The pose by the chain of frame-to-frame registrations, and by the window.
    finished : tuple of Estimate
        Smoothed poses of frames that left the window with this one.
    status : Status
        What ties the frame to earlier ones in the window; the raw chain's own is `raw.status`.
    reason : str
        Why the chain could not register the frame; empty where it could.
    n_keypoints, n_points, n_matches, n_inliers, n_links : int
        Keypoints, those measured in 3-D, matches of the chain's registration and those that it
        rests on (0 where a front-end of one's own does not count them), edges that went into
        the window.
    registration : RelativePose or None
        Against the frame that the raw chain goes on from; None where there is none.
    links : tuple of FrameLink
        The edges that were offered to the window with the frame.
    keyframes_ns : tuple of int
        Stamps of the kept frames, oldest first; of this one too, where it became one.
    segment : int
        Counted from 0; another one begins when the camera is lost.
    joins : tuple of SegmentJoin
        Segments that found their place among earlier ones with this frame.
    loops : tuple of Loop
        Those that are confirmed with this frame; of this frame, and of one shortly before.
    T_previous_frame : ndarray of float64, shape (4, 4), or None
        The pose in the frame before, both as the window has them after this one: a correction of
        the past is no motion. None for the first frame.
    T_map_world : ndarray of float64, shape (4, 4)
        What loops correct the causal pose by, as last optimized while the run goes:
        T_map_world @ T_world_frame.
    inertial : InertialState or None
        None without an IMU, and until it has started. Where nothing measured the frame, it is what
        the IMU predicts.
    is_carried : bool
        The IMU led to this frame: nothing else measured it.
    stage_ms : dict of str to float
        Milliseconds by stage.
    """

    raw: Estimate
    causal: Estimate
    finished: tuple[Estimate, ...]
    status: Status
    reason: str
    n_keypoints: int
    n_points: int
    n_matches: int
    n_inliers: int
    n_links: int
    registration: RelativePose | None = None
    links: tuple[FrameLink, ...] = ()
    keyframes_ns: tuple[int, ...] = ()
    segment: int = 0
    joins: tuple[SegmentJoin, ...] = ()
    loops: tuple[Loop, ...] = ()
    T_previous_frame: FloatArray | None = None
    T_map_world: FloatArray = field(default_factory=lambda: np.eye(4))
    inertial: InertialState | None = None
    is_carried: bool = False
    stage_ms: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return one line: the causal pose, and what the registration rests on."""
        return f"FrameResult({self.causal}, {self.n_inliers} inliers of {self.n_matches} matches)"

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.raw.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far work on a recording has come.

    Parameters
    ----------
    n_done, n_total : int
        Frames taken, and images that are expected in all.
    n_tracked : int
        Frames registered to earlier ones.
    """

    n_done: int
    n_total: int
    n_tracked: int
