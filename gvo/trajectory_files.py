"""Trajectory files: read TUM, KITTI and EuRoC, write TUM and KITTI; covariances, both ways."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory import StampsFrom, Trajectory, format_stamp
from gvo.trajectory_rows import (
    Row,
    check_increasing,
    read_numbers,
    read_rows,
    read_stamps,
    refuse,
)
from gvo.types import FloatArray, IntArray

_FORMATS = (
    "8 columns (TUM: stamp tx ty tz qx qy qz qw), 12 (KITTI: the first three rows of the pose) "
    "or 17 (EuRoC state)"
)
_SCALAR_FIRST = re.compile(r"q\w*w\b.*q\w*x\b")
_MAX_HEADER = 2000  # characters; the search takes the square of it
_UPPER = np.triu_indices(6)
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
# text files round: four decimals in TUM's ground truths, seven digits in KITTI's
_ROUNDING = 1e-2

_EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z []"
)

COVARIANCE_HEADER = "stamp_ns," + ",".join(
    f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)
)
"""First line of a covariance file: the upper triangle, row by row."""


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a file of poses; TUM, KITTI or EuRoC by its columns and header.

    A KITTI file holds no stamps. They are read from a `times.txt` of as many rows beside the
    file (or `sequences/NN/times.txt` for `poses/NN.txt`); without one, row n gets n seconds
    and the trajectory says so in `stamps_from`. Of neighbouring rows of a TUM file with one
    stamp the last is kept.

    Parameters
    ----------
    path : str or Path
        Text; fields separated by blanks or commas, comments start with #.

    Returns
    -------
    Trajectory
        T_world_cam of TUM and KITTI files, T_world_body of EuRoC's ground truth.

    Raises
    ------
    TrajectoryError
        Naming file and line, where the file is missing, empty or malformed.
    """
    path = Path(path)
    header, rows = read_rows(path, of="poses")
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses; expected rows of {_FORMATS}")
    n_columns = len(rows[0].fields)
    if n_columns == 17 or (n_columns >= 8 and _SCALAR_FIRST.search(header[:_MAX_HEADER])):
        return _read_euroc(rows)
    if n_columns == 12:
        return _read_kitti(path, rows)
    if n_columns == 8:
        return _read_tum(rows)
    raise rows[0].error(f"expected {_FORMATS}, got {n_columns}")


def read_covariances(path: str | Path) -> tuple[IntArray, FloatArray]:
    """Read the covariances of a run folder, or what `write_covariances` wrote.

    Parameters
    ----------
    path : str or Path
        CSV with `COVARIANCE_HEADER` as its first line.

    Returns
    -------
    stamps_ns : ndarray of int64, shape (n,)
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the camera frame.

    Raises
    ------
    TrajectoryError
        Where the file is missing or malformed.
    """
    path = Path(path)
    _, rows = read_rows(path, of="covariances")
    if not rows or rows[0].fields != COVARIANCE_HEADER.split(","):
        raise TrajectoryError(f"{path}:1: expected the header {COVARIANCE_HEADER[:32]}...")
    values = read_numbers(rows[1:], slice(1, None), n_columns=22)
    covariances = np.zeros((len(values), 6, 6))
    covariances[:, _UPPER[0], _UPPER[1]] = values
    covariances[:, _UPPER[1], _UPPER[0]] = values
    return read_stamps(rows[1:], unit_ns=1), covariances


def format_tum_line(stamp_ns: int, T_world_cam: FloatArray) -> str:
    """Return one line of a TUM file, without its line end.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds; written in seconds with nine decimals.
    T_world_cam : ndarray of float64, shape (4, 4)
        Metres.

    Returns
    -------
    str
        `stamp tx ty tz qx qy qz qw` with qw >= 0; nanometres, and twelve decimals of the
        quaternion.
    """
    # adding zero turns -0.0 into 0.0
    t = " ".join(f"{round(value, 9) + 0.0:.9f}" for value in T_world_cam[:3, 3].tolist())
    q = " ".join(f"{round(value, 12) + 0.0:.12f}" for value in se3.quaternion(T_world_cam[:3, :3]))
    return f"{format_stamp(stamp_ns)} {t} {q}"


def format_covariance_line(stamp_ns: int, covariance: FloatArray) -> str:
    """Return one line of a covariance file, without its line end and without loss.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz); the upper triangle is written.
    """
    return ",".join([str(int(stamp_ns)), *(repr(float(value)) for value in covariance[_UPPER])])


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write stamps and poses as a TUM file.

    Parameters
    ----------
    path : str or Path
        Replaced where it exists.
    trajectory : Trajectory
        Its covariances are not written.

    Raises
    ------
    ValueError
        Where it holds positions without rotations.
    TrajectoryError
        Where the file cannot be written.
    """
    _check_rotations(trajectory)
    poses = zip(trajectory.stamps_ns, trajectory.T_world_cam, strict=True)
    _write_lines(path, (format_tum_line(int(stamp_ns), T) for stamp_ns, T in poses))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write poses, without their stamps, as a KITTI file.

    Parameters
    ----------
    path : str or Path
        Replaced where it exists.
    trajectory : Trajectory
        Its stamps and covariances are not written.

    Raises
    ------
    ValueError
        Where it holds positions without rotations.
    TrajectoryError
        Where the file cannot be written.
    """
    _check_rotations(trajectory)
    rows = trajectory.T_world_cam[:, :3].reshape(-1, 12)
    _write_lines(path, (" ".join(f"{value:.12e}" for value in row) for row in rows))


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write stamps and poses as the ground truth of an EuRoC folder, without loss.

    Parameters
    ----------
    path : str or Path
        File to write.
    trajectory : Trajectory
        Of the body.

    Raises
    ------
    ValueError
        Where it holds positions without rotations.
    TrajectoryError
        Where the file cannot be written.
    """
    _check_rotations(trajectory)
    quaternions_xyzw = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3]).as_quat()
    rows = zip(trajectory.stamps_ns, trajectory.positions, quaternions_xyzw, strict=True)
    lines = (
        ",".join([str(int(stamp_ns)), *(repr(float(x)) for x in (*t, w, *xyz))])
        for stamp_ns, t, (*xyz, w) in rows
    )
    _write_lines(path, [_EUROC_HEADER, *lines])


def write_covariances(path: str | Path, trajectory: Trajectory) -> None:
    """Write the covariances of a trajectory as CSV, a header and a line per pose, without loss.

    Parameters
    ----------
    path : str or Path
        Replaced where it exists.
    trajectory : Trajectory
        With covariances.

    Raises
    ------
    ValueError
        Where the trajectory holds none.
    TrajectoryError
        Where the file cannot be written.
    """
    if trajectory.covariances is None:
        raise ValueError("the trajectory holds no covariances")
    values = zip(trajectory.stamps_ns, trajectory.covariances, strict=True)
    lines = (format_covariance_line(int(stamp_ns), C) for stamp_ns, C in values)
    _write_lines(path, [COVARIANCE_HEADER, *lines])


def _check_rotations(trajectory: Trajectory) -> None:
    if not trajectory.has_rotations:
        raise ValueError("a file of poses cannot hold positions without rotations")


def _write_lines(path: str | Path, lines: Iterable[str]) -> None:
    try:
        with Path(path).open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(f"{line}\n" for line in lines)
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be written: {error.strerror}") from error


def _read_tum(rows: list[Row]) -> Trajectory:
    values = read_numbers(rows, slice(1, 8), n_columns=8)
    stamps_ns = read_stamps(rows, unit_ns=1_000_000_000)
    # TUM's own ground truths repeat stamps, rounded to 0.1 ms; their tools keep the last row
    is_last = np.diff(stamps_ns, append=stamps_ns[-1] + 1) != 0
    rows = [row for row, is_kept in zip(rows, is_last, strict=True) if is_kept]
    values = values[is_last]
    R = _rotations_of_quaternions(rows, values[:, 3:])
    return Trajectory(
        stamps_ns=check_increasing(rows, stamps_ns[is_last]),
        T_world_cam=se3.make_transform(R, values[:, :3]),
    )


def _read_euroc(rows: list[Row]) -> Trajectory:
    values = read_numbers(rows, slice(1, 8), n_columns=len(rows[0].fields))
    stamps_ns = check_increasing(rows, read_stamps(rows, unit_ns=1))
    R = _rotations_of_quaternions(rows, values[:, [4, 5, 6, 3]])
    return Trajectory(stamps_ns=stamps_ns, T_world_cam=se3.make_transform(R, values[:, :3]))


def _read_kitti(path: Path, rows: list[Row]) -> Trajectory:
    P = read_numbers(rows, slice(0, 12), n_columns=12).reshape(-1, 3, 4)
    M = P[:, :, :3]
    residuals = np.abs(M @ np.swapaxes(M, 1, 2) - np.eye(3)).max(axis=(1, 2))
    is_wrong = (residuals > _ROUNDING) | (np.linalg.det(M) <= 0)
    refuse(rows, is_wrong, "the first three columns of the pose are no rotation")
    stamps_ns, stamps_from = _kitti_stamps(path, len(rows))
    return Trajectory(
        stamps_ns=stamps_ns,
        T_world_cam=se3.make_transform(se3.nearest_rotation(M), P[:, :, 3]),
        stamps_from=stamps_from,
    )


def _kitti_stamps(path: Path, n_rows: int) -> tuple[IntArray, StampsFrom]:
    beside = path.parent / "times.txt"
    official = path.parent.parent / "sequences" / path.stem / "times.txt"
    for times in (beside, official):
        if times.is_file():
            _, rows = read_rows(times, of="stamps")
            if len(rows) == n_rows:
                return check_increasing(rows, read_stamps(rows, unit_ns=1_000_000_000)), "times"
    return np.arange(n_rows, dtype=np.int64) * 1_000_000_000, "rows"


def _rotations_of_quaternions(rows: list[Row], quaternions_xyzw: FloatArray) -> FloatArray:
    norms = np.linalg.norm(quaternions_xyzw, axis=1)
    refuse(rows, np.abs(norms - 1.0) > _ROUNDING, "the quaternion is not of length one")
    return np.asarray(Rotation.from_quat(quaternions_xyzw).as_matrix())
