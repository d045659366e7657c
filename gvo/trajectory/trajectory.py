"""Trajectories: stamps, poses, optional covariances."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from gvo._text import format_stamp as format_stamp
from gvo._text import plain_number, shortened
from gvo.geometry import se3
from gvo.geometry.edges import between
from gvo.types import Edge, Estimate, FloatArray, IntArray

StampsFrom = Literal["file", "times", "rows", "topic"]
PoseLayout = Literal["tum", "kitti", "euroc"]

_ROTATION_TOLERANCE = 1e-3
_BLOCK = 4096  # poses checked at once, which takes several times their memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses over time, sorted by stamp.

    The arrays are copied and read-only.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Strictly increasing, nanoseconds.
    T_world_frame : ndarray of float64, shape (n, 4, 4)
        Map coordinates of the frame (of the camera, a robot's) to the world, metres.
    covariances : ndarray of float64, shape (n, 6, 6), optional
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in that frame.
    effects : ndarray of float64, shape (n, 6, k), optional
        By how much each of k errors that all steps of a chain share moves the poses, right
        perturbations, by one sigma of each; the covariances contain it. See `motion`.
    stamps_from : {"file", "times", "rows", "topic"}
        Origin of the stamps: a column of the file; a separate list of stamps; row numbers, one
        second each; message headers, with the rate and phase of another device.
    has_rotations : bool
        False if only positions were measured, as by GNSS: the rotations are identities without
        meaning, and there are no covariances.
    n_repeated : int
        Rows of the file that were left out, since the next has the same stamp.

    Raises
    ------
    ValueError
        If shapes do not match, values are not finite, stamps do not increase, a pose is no rigid
        transform, or positions alone come with rotations or covariances.
    """

    stamps_ns: IntArray
    T_world_frame: FloatArray
    covariances: FloatArray | None = None
    effects: FloatArray | None = None
    stamps_from: StampsFrom = "file"
    has_rotations: bool = True
    n_repeated: int = 0

    def __post_init__(self) -> None:
        """Check the arrays and keep read-only copies."""
        if self.stamps_from not in get_args(StampsFrom):
            raise ValueError(f"stamps_from must be one of {get_args(StampsFrom)}")
        stamps_ns = _checked_stamps(self.stamps_ns)
        n = len(stamps_ns)
        object.__setattr__(self, "stamps_ns", stamps_ns)
        poses = _checked_array("T_world_frame", self.T_world_frame, (n, 4, 4))
        _check_rigid(poses)
        object.__setattr__(self, "T_world_frame", poses)
        if self.covariances is not None:
            covariances = _checked_array("covariances", self.covariances, (n, 6, 6))
            object.__setattr__(self, "covariances", covariances)
        if self.effects is not None:
            effects = _checked_array("effects", self.effects, (n, 6, np.shape(self.effects)[-1]))
            object.__setattr__(self, "effects", effects)
        if self.has_rotations:
            return
        if self.covariances is not None or not np.all(poses[:, :3, :3] == np.eye(3)):
            raise ValueError("without rotations the poses hold identities and no covariances")

    @classmethod
    def of(cls, estimates: Iterable[Estimate]) -> Trajectory:
        """Collect estimates of different stamps, in any order, with their covariances.

        Where some have effects of shared errors, poses without, such as the first, have zeros.
        """
        ordered = sorted(estimates, key=lambda estimate: estimate.stamp_ns)
        effects: FloatArray | None = None
        for row, estimate in enumerate(ordered):
            if estimate.effects is not None:
                if effects is None:
                    effects = np.zeros((len(ordered), *estimate.effects.shape))
                effects[row] = estimate.effects
        return cls(
            stamps_ns=np.array([estimate.stamp_ns for estimate in ordered], dtype=np.int64),
            T_world_frame=np.array([e.T_world_frame for e in ordered]).reshape(-1, 4, 4),
            covariances=np.array([e.covariance for e in ordered]).reshape(-1, 6, 6),
            effects=effects,
        )

    @classmethod
    def of_positions(
        cls, stamps_ns: IntArray, positions: FloatArray, *, stamps_from: StampsFrom = "file"
    ) -> Trajectory:
        """Return a trajectory of positions without rotations.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (n,)
            Strictly increasing, nanoseconds.
        positions : ndarray of float64, shape (n, 3)
            In the world, metres.
        stamps_from : {"file", "times", "rows", "topic"}
            As of the class.
        """
        positions = np.asarray(positions, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions must have shape (n, 3), got {positions.shape}")
        return cls(
            stamps_ns=stamps_ns,
            T_world_frame=_unrotated(positions),
            stamps_from=stamps_from,
            has_rotations=False,
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        """Return one line: how many poses, over what time and path, and what is known of them."""
        if len(self) == 0:
            return "Trajectory(no poses)"
        start_ns, end_ns = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        seconds, path_m = 1e-9 * (end_ns - start_ns), float(self.distances()[-1])
        rotations = "" if self.has_rotations else ", positions alone"
        covariances = "" if self.covariances is None else ", with covariances"
        return (
            f"Trajectory({len(self)} poses, {seconds:.1f} s from {format_stamp(start_ns)}, "
            f"{path_m:.2f} m{rotations}{covariances})"
        )

    @property
    def positions(self) -> FloatArray:
        """Camera centres in the world, shape (n, 3), metres."""
        return self.T_world_frame[:, :3, 3]

    def distances(self) -> FloatArray:
        """Return the path travelled up to each pose, shape (n,), metres, from zero."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def select(self, indices: ArrayLike | slice) -> Trajectory:
        """Return some of the poses.

        Parameters
        ----------
        indices : array_like of int or bool, or slice
            Increasing indices, a mask of shape (n,), or a slice.

        Returns
        -------
        Trajectory
            With their covariances, if any.
        """
        chosen = indices if isinstance(indices, slice) else np.asarray(indices)
        if not isinstance(chosen, slice) and chosen.size == 0:
            chosen = np.empty(0, dtype=np.int64)  # an empty list would be an array of floats
        covariances, effects = self.covariances, self.effects
        return replace(
            self,
            stamps_ns=self.stamps_ns[chosen],
            T_world_frame=self.T_world_frame[chosen],
            covariances=None if covariances is None else covariances[chosen],
            effects=None if effects is None else effects[chosen],
        )

    def transformed(self, T_frame_other: FloatArray) -> Trajectory:
        """Return the trajectory of another frame, rigidly attached to the present one.

        Parameters
        ----------
        T_frame_other : ndarray of float64, shape (4, 4)
            Maps coordinates of the new frame to the present one, metres.

        Returns
        -------
        Trajectory
            T_world_frame @ T_frame_other, the covariances in the new frame.

        Raises
        ------
        ValueError
            If rotations are unknown and the new frame has another origin.
        """
        T_frame_other = np.asarray(T_frame_other, dtype=np.float64)
        if not self.has_rotations:
            if np.any(T_frame_other[:3, 3] != 0.0):
                raise ValueError("without rotations the positions of another point are not known")
            return self
        covariances, effects = self.covariances, self.effects
        # T exp(xi) B = T B exp(Ad(B^-1) xi)
        T_other_frame = se3.invert(T_frame_other)
        if covariances is not None:
            covariances = se3.transport_covariance(covariances, T_other_frame)
        return replace(
            self,
            T_world_frame=self.T_world_frame @ T_frame_other,
            covariances=covariances,
            effects=None if effects is None else se3.adjoint(T_other_frame) @ effects,
        )

    def motion(self, first: int, last: int) -> Edge:
        """Return the pose of one frame in an earlier one, of a chain with covariances.

        Parameters
        ----------
        first, last : int
            Indices of poses, each of which is the one before moved by an independent measurement:
            those that `gvo run` calls raw.

        Returns
        -------
        Edge
            With the stamp of the first pose as its reference. The covariances of both poses do not
            tell that of the motion where errors are shared: these add up along the way, and only
            what they did before it is common to both.

        Raises
        ------
        ValueError
            If there are no covariances.
        """
        T, covariances = self.motions(np.array([first]), np.array([last]))
        return Edge(
            reference_id=int(self.stamps_ns[first]),
            T_reference_frame=T[0],
            covariance=covariances[0],
        )

    def motions(self, first: IntArray, last: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return many motions as `motion` does: (m, 4, 4), with covariances, (m, 6, 6)."""
        if self.covariances is None:
            raise ValueError("without covariances of the poses those of motions are not known")
        noise, effects = self.covariances, self.effects
        if effects is not None:
            noise = noise - effects @ np.swapaxes(effects, 1, 2)
        T = se3.invert(self.T_world_frame[first]) @ self.T_world_frame[last]
        covariances = noise[last] - se3.transport_covariance(noise[first], se3.invert(T))
        if effects is not None:
            moved = between(effects[first], effects[last], T)
            covariances = covariances + moved @ np.swapaxes(moved, 1, 2)
        return T, covariances

    def moved(self, T_map_world: FloatArray) -> Trajectory:
        """Return the trajectory in another world frame.

        Parameters
        ----------
        T_map_world : ndarray of float64, shape (4, 4)
            Maps coordinates of the present world to the new one, metres.

        Returns
        -------
        Trajectory
            T_map_world @ T_world_frame; the covariances, in the pose's own frame, stay the same.
        """
        T_map_frame = np.asarray(T_map_world, dtype=np.float64) @ self.T_world_frame
        if not self.has_rotations:
            T_map_frame = _unrotated(T_map_frame[:, :3, 3])
        return replace(self, T_world_frame=T_map_frame)

    def write(self, path: str | Path, *, layout: PoseLayout | None = None) -> None:
        """Write the poses as a file that gvo and other tools read; covariances are left out.

        Parameters
        ----------
        path : str or Path
            Overwritten if it exists.
        layout : {"tum", "kitti", "euroc"}, optional
            By default EuRoC's where the name ends in .csv, else TUM's. KITTI's holds no stamps.

        Raises
        ------
        ValueError
            If the layout is unknown, or there are no rotations.
        TrajectoryError
            If the file cannot be written.
        """
        from gvo.trajectory import formats  # which reads trajectories, too

        layout = layout or ("euroc" if Path(path).suffix == ".csv" else "tum")
        if layout not in get_args(PoseLayout):
            raise ValueError(f"layout must be one of {get_args(PoseLayout)}, got {layout!r}")
        getattr(formats, f"write_{layout}")(path, self)

    def interpolate(self, stamps_ns: IntArray, *, max_gap_ns: int | None = None) -> Trajectory:
        """Interpolate poses at given stamps: positions linearly, rotations by SLERP.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (m,)
            Strictly increasing, nanoseconds. Those before the first or after the last pose are
            dropped: nothing is extrapolated.
        max_gap_ns : int, optional
            Stamps between two poses that are farther apart are dropped, too.

        Returns
        -------
        Trajectory
            At most m poses, without covariances.
        """
        wanted = _checked_stamps(stamps_ns)
        if len(self) == 0 or len(wanted) == 0:
            return replace(self.select([]), covariances=None, effects=None)
        wanted = wanted[(wanted >= self.stamps_ns[0]) & (wanted <= self.stamps_ns[-1])]
        after = np.searchsorted(self.stamps_ns, wanted)
        before = np.maximum(after - 1, 0)
        if max_gap_ns is not None:
            is_near = self.stamps_ns[after] - self.stamps_ns[before] <= max_gap_ns
            is_kept = is_near | (self.stamps_ns[after] == wanted)
            wanted, after, before = wanted[is_kept], after[is_kept], before[is_kept]
        # at the first pose both neighbours are that pose, their span zero
        spans = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        shares = ((wanted - self.stamps_ns[before]) / spans)[:, np.newaxis]
        poses = _between(self.T_world_frame[before], self.T_world_frame[after], shares)
        return replace(self, stamps_ns=wanted, T_world_frame=poses, covariances=None, effects=None)


def _checked_stamps(stamps_ns: IntArray) -> IntArray:
    stamps = np.asarray(stamps_ns)
    if stamps.ndim != 1 or (stamps.dtype.kind not in "iu" and len(stamps) > 0):
        raise ValueError(
            f"stamps_ns must be integers of shape (n,), got {stamps.dtype} {stamps.shape}"
        )
    stamps = np.array(stamps, dtype=np.int64)
    falls = np.flatnonzero(stamps[1:] <= stamps[:-1])
    if len(falls) > 0:
        raise ValueError(f"stamps_ns must increase strictly, not so after index {falls[0]}")
    stamps.flags.writeable = False
    return stamps


def _checked_array(name: str, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite")
    array.flags.writeable = False
    return array


def _check_rigid(poses: FloatArray) -> None:
    blocks = (poses[first : first + _BLOCK, :3, :3] for first in range(0, len(poses), _BLOCK))
    checked = [se3.is_rotation(R, tolerance=_ROTATION_TOLERANCE) for R in blocks]
    is_rigid = np.concatenate([np.empty(0, dtype=np.bool_), *checked])
    is_rigid &= np.all(poses[:, 3] == (0.0, 0.0, 0.0, 1.0), axis=1)
    if not np.all(is_rigid):
        index = int(np.argmin(is_rigid))
        fault = se3.transform_fault(poses[index], tolerance=_ROTATION_TOLERANCE)
        raise ValueError(f"T_world_frame[{index}] {fault}")


def _unrotated(positions: FloatArray) -> FloatArray:
    return se3.make_transform(np.tile(np.eye(3), (len(positions), 1, 1)), positions)


def _between(T_before: FloatArray, T_after: FloatArray, shares: FloatArray) -> FloatArray:
    if len(shares) == 0:
        return np.empty((0, 4, 4))
    start = Rotation.from_matrix(T_before[:, :3, :3])
    arcs = (start.inv() * Rotation.from_matrix(T_after[:, :3, :3])).as_rotvec()
    R = (start * Rotation.from_rotvec(shares * arcs)).as_matrix()
    t = (1.0 - shares) * T_before[:, :3, 3] + shares * T_after[:, :3, 3]
    return se3.make_transform(np.asarray(R), t)


def parse_stamp(text: str, *, unit_ns: int) -> int:
    """Return the nanoseconds of a decimal number, without rounding to a float.

    Parameters
    ----------
    text : str
        A number in ASCII, in any notation.
    unit_ns : int
        Nanoseconds of a unit: 1_000_000_000 for seconds, 1 for nanoseconds.

    Returns
    -------
    int
        Rounded to the nanosecond.

    Raises
    ------
    ValueError
        If the text is no number, or does not fit into int64.

    Examples
    --------
    >>> parse_stamp("1305031102.175304", unit_ns=1_000_000_000)
    1305031102175304000
    """
    try:
        stamp = Decimal(plain_number(text)) * unit_ns
    except (ArithmeticError, ValueError):
        raise ValueError(f"the stamp {shortened(text)} is no number") from None
    if not stamp.is_finite() or abs(stamp) >= 2**63 - 1:
        unit = "seconds" if unit_ns > 1 else "nanoseconds"
        raise ValueError(f"the stamp {shortened(text)} is out of range; expected {unit}")
    return round(stamp)
