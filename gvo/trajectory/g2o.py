"""Pose graphs in g2o's text format: lines parsed and formatted.

Poses are `VERTEX_SE3:QUAT id x y z qx qy qz qw`, measurements `EDGE_SE3:QUAT a b x y z qx qy qz
qw` with the upper triangle of the information matrix, and `FIX id ...` names poses that hold
the world. `VERTEX3` and `EDGE3` are the older form with roll, pitch, yaw in place of the
quaternion. An edge a b is T_a_b: it maps coordinates of b to a.

The information matrix is taken as GTSAM takes it: that of `EDGE_SE3:QUAT` in the order (x, y, z,
rx, ry, rz), with rotations in radians; that of `EDGE3` in the order (rx, ry, rz, x, y, z), and
the identity where it is left out. g2o itself minimizes the vector part of the quaternion, which
is half the rotation: by its reading the same numbers mean twice the sigmas of rotation.

References
----------
R. Kuemmerle et al., "g2o: A general framework for graph optimization", ICRA 2011,
doi:10.1109/ICRA.2011.5979949.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import plain_floats, plain_number
from gvo.geometry import se3
from gvo.trajectory.formats import MAX_POSITION_M, from_upper_triangle, upper_triangle
from gvo.types import FloatArray, FrameId, GraphEdge

_UNIT_INFORMATION = list(map(repr, upper_triangle(np.eye(6)).tolist()))
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])
# Which number of the upper triangle is an element of the matrix; with swapped axes.
_ORDER = from_upper_triangle(np.arange(21.0)).astype(np.int64)
_SWAPPED_ORDER = _ORDER[np.ix_(_SWAPPED, _SWAPPED)]
_NORM_TOLERANCE = 1e-2
_ROUNDING = 1e-9  # of an information matrix, relative
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_KINDS = {"z, roll, pitch": ": a planar graph", ", ".join(_AXES): ": the edge says nothing"}
_QUATERNION_TAGS = ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
_ANGLE_TAGS = ("VERTEX3", "EDGE3")

MEASUREMENT_TAGS = ("EDGE_SE3:QUAT", "EDGE3")
"""Supported tags of measurements."""
TAGS = (*_QUATERNION_TAGS, *_ANGLE_TAGS, "FIX")
"""All supported tags."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vertex:
    """A pose: `T_world_frame` of shape (4, 4), metres."""

    frame_id: int
    T_world_frame: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """A relative pose between two poses, as in the file.

    Parameters
    ----------
    reference_id, frame_id : int
        First and second id of the line.
    T_reference_frame : ndarray of float64, shape (4, 4)
        Maps coordinates of the frame to the reference, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame; NaN where there is a fault.
    fault : str
        What is wrong with the information matrix; empty if nothing.
    """

    reference_id: int
    frame_id: int
    T_reference_frame: FloatArray
    covariance: FloatArray
    fault: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """Poses that are held fixed."""

    frame_ids: tuple[int, ...]


Line: TypeAlias = Vertex | Measurement | Fix


def parse_line(text: str) -> Line | None:
    """Parse one line.

    Parameters
    ----------
    text : str
        A line of a file.

    Returns
    -------
    Vertex, Measurement, Fix or None
        None for an empty line, a comment, or a tag that is not in `TAGS`.

    Raises
    ------
    ValueError
        If a line with a supported tag is malformed.

    Examples
    --------
    >>> parse_line("VERTEX_SE3:QUAT 7 1 2 3 0 0 0 1").T_world_frame[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    return parse_lines([text])[0]


def parse_lines(texts: Sequence[str]) -> list[Line | None]:
    """Parse many lines at once, which takes a fourth of the time."""
    lines: list[Line | None] = [None] * len(texts)
    rows: dict[str, list[tuple[int, list[int], list[float]]]] = {}
    for index, text in enumerate(texts):
        fields = text.partition("#")[0].split()
        if not fields or fields[0] not in TAGS:
            continue
        if fields[0] == "FIX":
            lines[index] = Fix(frame_ids=tuple(_id(field) for field in fields[1:]))
        else:
            rows.setdefault(fields[0], []).append((index, *_numbers(fields)))
    for tag, found in rows.items():
        for (index, *_), line in zip(found, _lines_of(tag, found), strict=True):
            lines[index] = line
    return lines


def _numbers(fields: list[str]) -> tuple[list[int], list[float]]:
    """Return the ids and the numbers of a line."""
    tag = fields[0]
    n_ids = 2 if tag in MEASUREMENT_TAGS else 1
    n_pose = 7 if tag in _QUATERNION_TAGS else 6
    n_expected = 1 + n_ids + n_pose + (21 if n_ids == 2 else 0)
    if tag == "EDGE3" and len(fields) == 1 + n_ids + n_pose:
        fields = fields + _UNIT_INFORMATION
    if len(fields) != n_expected:
        raise ValueError(f"{tag} needs {n_expected - 1} numbers, got {len(fields) - 1}")
    ids = [_id(field) for field in fields[1 : 1 + n_ids]]
    return ids, plain_floats(fields[1 + n_ids :])


def _lines_of(tag: str, rows: Sequence[tuple[int, list[int], list[float]]]) -> Iterator[Line]:
    """Yield the values of lines of one tag, from their ids and numbers."""
    numbers = np.array([row for _, _, row in rows])
    n_pose = 7 if tag in _QUATERNION_TAGS else 6
    transforms = transforms_of(numbers[:, :n_pose])
    if tag not in MEASUREMENT_TAGS:
        for (_, ids, _), T in zip(rows, transforms, strict=True):
            yield Vertex(frame_id=ids[0], T_world_frame=T)
        return
    order = _SWAPPED_ORDER if tag in _QUATERNION_TAGS else _ORDER
    information = numbers[:, n_pose:][:, order]
    faults = [_fault(matrix) for matrix in information]
    noises = zip(_inverses(information, faults), faults, strict=True)
    for (_, (a, b), _), T, (covariance, fault) in zip(rows, transforms, noises, strict=True):
        yield Measurement(
            reference_id=a, frame_id=b, T_reference_frame=T, covariance=covariance, fault=fault
        )


def _id(text: str) -> int:
    try:
        return int(plain_number(text))
    except ValueError:
        raise ValueError(f"the id {text!r} is not a whole number") from None


def transforms_of(numbers: FloatArray) -> FloatArray:
    """Return the poses of rows of x, y, z and a quaternion (x, y, z, w), or roll, pitch, yaw.

    Raises
    ------
    ValueError
        If a number is beyond `MAX_POSITION_M`, or a quaternion not of length one.
    """
    if np.any(np.abs(numbers) > MAX_POSITION_M):
        raise ValueError(f"a number of the pose is beyond {MAX_POSITION_M:g}")
    if numbers.shape[1] == 6:
        if not np.all(np.isfinite(numbers[:, 3:])):
            raise ValueError("an angle is not finite")
        R = Rotation.from_euler("xyz", numbers[:, 3:]).as_matrix()
        return se3.make_transform(np.asarray(R), numbers[:, :3])
    norms = np.linalg.norm(numbers[:, 3:], axis=1)
    is_wrong = ~(np.abs(norms - 1.0) <= _NORM_TOLERANCE)
    if is_wrong.any():
        raise ValueError(f"the quaternion is of length {norms[is_wrong][0]:.4g}, expected 1")
    R = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    return se3.make_transform(np.asarray(R), numbers[:, :3])


def _inverses(information: FloatArray, faults: Sequence[str]) -> FloatArray:
    """Return the inverses of matrices, shape (n, 6, 6); NaN of those with a fault."""
    is_sound = np.array([not fault for fault in faults], dtype=np.bool_)
    inverses = np.full_like(information, np.nan)
    inverses[is_sound] = np.linalg.inv(information[is_sound])
    # halves first: no overflow
    return np.asarray(0.5 * inverses + 0.5 * inverses.transpose(0, 2, 1))


def _fault(information: FloatArray) -> str:
    """Say why a matrix of (rx, ry, rz, tx, ty, tz) is no information; empty if it is one."""
    fault = se3.covariance_fault(information)
    if not fault.endswith("definite"):
        return f"information {fault}" if fault else ""
    values = np.linalg.eigvalsh(information)
    if values[0] < -_ROUNDING * np.abs(values).max():
        return "information is not positive definite"
    rows = zip(_AXES, information[_SWAPPED], strict=True)
    zeros = ", ".join(name for name, row in rows if not np.any(row))
    return (
        f"information is singular ({zeros} are zero{_KINDS.get(zeros, '')})"
        if zeros
        else "information is singular"
    )


def format_vertex(frame_id: int | str, T_world_frame: FloatArray) -> str:
    """Return a line `VERTEX_SE3:QUAT` of T_world_frame (4, 4), without line end or loss."""
    return f"VERTEX_SE3:QUAT {frame_id} {_pose_fields(T_world_frame)}"


def format_edge(
    reference_id: int | str, frame_id: int | str, T: FloatArray, covariance: FloatArray
) -> str:
    """Return a line `EDGE_SE3:QUAT`, without line end.

    Parameters
    ----------
    reference_id, frame_id : int or str
    T : ndarray of float64, shape (4, 4)
        T_reference_frame, metres.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame; positive definite.
    """
    information = np.linalg.inv(covariance)[np.ix_(_SWAPPED, _SWAPPED)]
    information = 0.5 * (information + information.T)
    upper = " ".join(map(repr, upper_triangle(information).tolist()))
    return f"EDGE_SE3:QUAT {reference_id} {frame_id} {_pose_fields(T)} {upper}"


def convert_line(text: str) -> str:
    """Return a line with `EDGE3` converted to `EDGE_SE3:QUAT`; other lines are returned as is."""
    text = text.strip()
    line = parse_line(text) if text.startswith("EDGE3") else None
    if not isinstance(line, Measurement):
        return text
    numbers = text.partition("#")[0].split()[9:] or _UNIT_INFORMATION
    # The numbers as written, reordered: nothing is rounded.
    upper = " ".join(numbers[int(i)] for i in upper_triangle(_SWAPPED_ORDER))
    T = line.T_reference_frame
    return f"EDGE_SE3:QUAT {line.reference_id} {line.frame_id} {_pose_fields(T)} {upper}"


def g2o_lines(poses: Mapping[FrameId, FloatArray], graph: Sequence[GraphEdge]) -> Iterator[str]:
    """Yield the lines of a pose graph: vertices and edges, without line ends.

    Frames with non-negative integer ids keep them; others are numbered in order, with their id as
    a comment behind the vertex. Priors are left out: the format has no common line for them.

    Parameters
    ----------
    poses : mapping of hashable to ndarray of float64, shape (4, 4)
        T_world_frame.
    graph : sequence of GraphEdge
    """
    is_numbered = all(isinstance(each, int | np.integer) and each >= 0 for each in poses)
    numbers = {each: each if is_numbered else number for number, each in enumerate(poses)}
    for frame_id, T in poses.items():
        comment = "" if is_numbered else f"  # {frame_id!r}"
        yield f"{format_vertex(str(numbers[frame_id]), T)}{comment}"
    for edge in graph:
        if edge.reference_id is not None:
            yield format_edge(
                str(numbers[edge.reference_id]),
                str(numbers[edge.frame_id]),
                edge.T_reference_frame,
                edge.covariance,
            )


def _pose_fields(T: FloatArray) -> str:
    quaternion = se3.quaternions(T[:3, :3])
    return " ".join(repr(float(value) + 0.0) for value in (*T[:3, 3], *quaternion))
