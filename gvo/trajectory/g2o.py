"""Pose graphs in g2o's text format: lines parsed and formatted, one at a time.

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

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import plain_number
from gvo.geometry import se3
from gvo.trajectory.formats import MAX_POSITION_M, from_upper_triangle, upper_triangle
from gvo.types import FloatArray, FrameId, GraphEdge

_UNIT_INFORMATION = list(map(repr, upper_triangle(np.eye(6)).tolist()))
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])
_NORM_TOLERANCE = 1e-2
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
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame; NaN if the information
        matrix is singular.
    """

    reference_id: int
    frame_id: int
    T_reference_frame: FloatArray
    covariance: FloatArray


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
    fields = text.partition("#")[0].split()
    if not fields or fields[0] not in TAGS:
        return None
    tag = fields[0]
    if tag == "FIX":
        return Fix(frame_ids=tuple(_id(field) for field in fields[1:]))
    n_ids = 2 if tag in MEASUREMENT_TAGS else 1
    n_pose = 7 if tag in _QUATERNION_TAGS else 6
    n_expected = 1 + n_ids + n_pose + (21 if n_ids == 2 else 0)
    if tag == "EDGE3" and len(fields) == 1 + n_ids + n_pose:
        fields += _UNIT_INFORMATION
    if len(fields) != n_expected:
        raise ValueError(f"{tag} needs {n_expected - 1} numbers, got {len(fields) - 1}")
    ids = [_id(field) for field in fields[1 : 1 + n_ids]]
    numbers = np.array([float(plain_number(field)) for field in fields[1 + n_ids :]])
    T = _transform(numbers[:n_pose])
    if n_ids == 1:
        return Vertex(frame_id=ids[0], T_world_frame=T)
    return Measurement(
        reference_id=ids[0],
        frame_id=ids[1],
        T_reference_frame=T,
        covariance=_covariance(numbers[n_pose:], is_swapped=tag in _QUATERNION_TAGS),
    )


def _id(text: str) -> int:
    try:
        return int(plain_number(text))
    except ValueError:
        raise ValueError(f"the id {text!r} is no whole number") from None


def _transform(numbers: FloatArray) -> FloatArray:
    """Return the pose of x, y, z and a quaternion (x, y, z, w), or roll, pitch, yaw."""
    if np.any(np.abs(numbers) > MAX_POSITION_M):
        raise ValueError(f"a number of the pose is beyond {MAX_POSITION_M:g}")
    if len(numbers) == 6:
        if not np.all(np.isfinite(numbers[3:])):
            raise ValueError("an angle is not finite")
        R = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
        return se3.make_transform(np.asarray(R), numbers[:3])
    norm = math.hypot(*numbers[3:])
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        raise ValueError(f"the quaternion is of length {norm:.4g}, expected 1")
    return se3.make_transform(np.asarray(Rotation.from_quat(numbers[3:]).as_matrix()), numbers[:3])


def _covariance(upper: FloatArray, *, is_swapped: bool) -> FloatArray:
    information = from_upper_triangle(upper)
    if is_swapped:
        information = information[np.ix_(_SWAPPED, _SWAPPED)]
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    return np.asarray(0.5 * covariance + 0.5 * covariance.T)  # halves first: no overflow


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
    line = parse_line(text)
    if not isinstance(line, Measurement) or text.split()[0] != "EDGE3":
        return text
    numbers = text.partition("#")[0].split()[9:] or _UNIT_INFORMATION
    order = from_upper_triangle(np.arange(21.0))[np.ix_(_SWAPPED, _SWAPPED)]
    # The numbers as written, reordered: nothing is rounded.
    upper = " ".join(numbers[int(i)] for i in upper_triangle(order))
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
    is_numbered = all(
        isinstance(frame_id, int | np.integer) and frame_id >= 0 for frame_id in poses
    )
    numbers = {
        frame_id: frame_id if is_numbered else number for number, frame_id in enumerate(poses)
    }
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
