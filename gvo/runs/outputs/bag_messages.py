"""Messages of what odometry computes: poses, paths, points, pictures, diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from gvo.geometry import se3
from gvo.io.bag.topics import COMPRESSED_TYPE
from gvo.io.convert.bag_messages import Header, MessageWriter, pose_numbers
from gvo.runs.outputs.frames import Twist
from gvo.types import Estimate, FloatArray, IntArray, RelativePose, Status
from gvo.viz.palette import ESTIMATES

ODOMETRY_TYPE: Final = "nav_msgs/msg/Odometry"
PATH_TYPE: Final = "nav_msgs/msg/Path"
CLOUD_TYPE: Final = "sensor_msgs/msg/PointCloud2"
MARKER_TYPE: Final = "visualization_msgs/msg/Marker"
DIAGNOSTICS_TYPE: Final = "diagnostic_msgs/msg/DiagnosticArray"

_LINE_LIST, _ADD = 5, 0  # of visualization_msgs/Marker
_LINE_WIDTH_M = 0.03

# Three bytes of padding: four-byte fields that start at multiples of four are read anywhere.
_POINT: Final = np.dtype(
    [*((name, "<f4") for name in ("x", "y", "z", "intensity")), ("inlier", "u1")], align=True
)
_UINT8, _FLOAT32 = 2, 7  # of sensor_msgs/PointField
_LEVELS: Final = {
    Status.OK: 0,
    Status.RESUMED: 1,
    Status.COASTING: 1,
    Status.LOST: 2,
    Status.SKIPPED: 2,
}


def covariance_to_ros(covariance: FloatArray, R_parent_frame: FloatArray) -> FloatArray:
    """Return the covariance of a pose as messages of ROS state it.

    Parameters
    ----------
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame.
    R_parent_frame : ndarray of float64, shape (3, 3)
        Rotation of the pose.

    Returns
    -------
    ndarray of float64, shape (6, 6)
        Of (x, y, z, rx, ry, rz): the position in the parent frame, and the rotation about the
        fixed axes of the parent frame.
    """
    # Exchange the halves and turn both: with the inverse rotation, that is the way back.
    return se3.covariance_from_ros(covariance, R_parent_frame.T)


def write_odometry(
    writer: MessageWriter, topic: str, estimate: Estimate, frames: tuple[str, str], twist: Twist
) -> None:
    """Write a pose and a velocity with their covariances as `nav_msgs/Odometry`.

    A covariance of the velocity that is not known has -1 on its diagonal.

    Parameters
    ----------
    writer : MessageWriter
    topic : str
        Where to.
    estimate : Estimate
        Pose of the child frame in the parent frame.
    frames : (str, str)
        Parent and child.
    twist : Twist
        Of the child frame, in its own axes.
    """
    parent, child = frames
    R = estimate.T_world_frame[:3, :3]
    message = writer.make(
        ODOMETRY_TYPE,
        header=writer.header(Header(estimate.stamp_ns, parent)),
        child_frame_id=child,
        pose=writer.make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_pose(writer, pose_numbers(estimate.T_world_frame).tolist()),
            covariance=covariance_to_ros(estimate.covariance, R).ravel(),
        ),
        twist=_twist(writer, twist),
    )
    writer.write(topic, ODOMETRY_TYPE, message, estimate.stamp_ns)


def write_path(
    writer: MessageWriter, topic: str, header: Header, stamps_ns: IntArray, poses: FloatArray
) -> None:
    """Write poses as `nav_msgs/Path`.

    Parameters
    ----------
    writer : MessageWriter
    topic : str
        Where to.
    header : Header
        Stamp of the message, and the frame of the poses.
    stamps_ns : ndarray of int64, shape (n,)
        Of the poses.
    poses : ndarray of float64, shape (n, 7)
        Position in metres and quaternion (x, y, z, w).
    """
    stamped = [
        writer.make(
            "geometry_msgs/msg/PoseStamped",
            header=writer.header(Header(stamp_ns, header.frame_id)),
            pose=_pose(writer, numbers),
        )
        for stamp_ns, numbers in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    ]
    message = writer.make(PATH_TYPE, header=writer.header(header), poses=stamped)
    writer.write(topic, PATH_TYPE, message, header.stamp_ns)


def write_lines(
    writer: MessageWriter, header: Header, segments: FloatArray, *, name: str, number: int
) -> None:
    """Write the lines of loops as a `visualization_msgs/Marker` to `/gvo/loops`.

    Parameters
    ----------
    writer : MessageWriter
    header : Header
        Stamp, and the frame of the lines.
    segments : ndarray of float64, shape (n, 2, 3)
        Where each begins and ends, metres.
    name, number : str, int
        Namespace and id: another marker of both replaces this one.
    """
    red, green, blue = (value / 255 for value in bytes.fromhex(ESTIMATES["global"][1:]))
    message = writer.make(
        MARKER_TYPE,
        header=writer.header(header),
        ns=name,
        id=number,
        type=_LINE_LIST,
        action=_ADD,
        pose=_pose(writer, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        scale=writer.make("geometry_msgs/msg/Vector3", x=_LINE_WIDTH_M, y=0.0, z=0.0),
        color=writer.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=writer.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[
            writer.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
            for x, y, z in segments.reshape(-1, 3).tolist()
        ],
        colors=[],
        text="",
        mesh_resource="",
        mesh_use_embedded_materials=False,
        **({} if writer.is_ros1 else _untextured(writer)),
    )
    writer.write("/gvo/loops", MARKER_TYPE, message, header.stamp_ns)


def _untextured(writer: MessageWriter) -> dict[str, object]:
    """Return what the markers of ROS 2 hold besides."""
    nothing = np.zeros(0, dtype=np.uint8)
    header = writer.header(Header(0, ""))
    return {
        "texture_resource": "",
        "texture": writer.make(COMPRESSED_TYPE, header=header, format="", data=nothing),
        "uv_coordinates": [],
        "mesh_file": writer.make("visualization_msgs/msg/MeshFile", filename="", data=nothing),
    }


def write_points(
    writer: MessageWriter, topic: str, header: Header, found: RelativePose, intensities: FloatArray
) -> None:
    """Write matched points as an unorganised `sensor_msgs/PointCloud2`.

    Its fields are x, y, z and intensity (FLOAT32), and inlier (UINT8, 0 or 1); points that are
    not finite are left out.

    Parameters
    ----------
    writer : MessageWriter
    topic : str
        Where to.
    header : Header
        Stamp, and the frame of the points.
    found : RelativePose
        Its n points, and which are inliers.
    intensities : ndarray of float64, shape (n,)
    """
    points = found.points_current
    is_finite = np.isfinite(points).all(axis=1)
    cloud = np.zeros(int(np.count_nonzero(is_finite)), dtype=_POINT)
    for name, values in zip("xyz", points[is_finite].T, strict=True):
        cloud[name] = values
    cloud["intensity"], cloud["inlier"] = intensities[is_finite], found.inliers[is_finite]
    message = writer.make(
        CLOUD_TYPE,
        header=writer.header(header),
        height=1,
        width=len(cloud),
        fields=_point_fields(writer),
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=cloud.nbytes,
        data=cloud.view(np.uint8).reshape(-1),
        is_dense=True,
    )
    writer.write(topic, CLOUD_TYPE, message, header.stamp_ns)


def write_diagnostics(
    writer: MessageWriter,
    header: Header,
    status: Status,
    text: str,
    values: Mapping[str, object],
    *,
    of: str = "odometry",
) -> None:
    """Write the state of a frame, or of what frames come from, to `/diagnostics`.

    Its level is OK for a frame registered to its predecessors, WARN where it coasts or has resumed,
    ERROR where it is lost or was skipped.

    Parameters
    ----------
    writer : MessageWriter
    header : Header
        Stamp of the frame, and what it was seen by: the hardware.
    status : Status
        Of the frame.
    text : str
        One line.
    values : mapping of str to object
        Numbers to show.
    of : str
        Its name.
    """
    message = writer.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=_LEVELS[status],
        name=f"gvo: {of}",
        message=text,
        hardware_id=header.frame_id,
        values=[
            writer.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ],
    )
    array = writer.make(
        DIAGNOSTICS_TYPE, header=writer.header(Header(header.stamp_ns, "")), status=[message]
    )
    writer.write("/diagnostics", DIAGNOSTICS_TYPE, array, header.stamp_ns)


def _pose(writer: MessageWriter, numbers: Sequence[float]) -> Any:  # noqa: ANN401 - made at run time
    x, y, z, *q = numbers
    return writer.make(
        "geometry_msgs/msg/Pose",
        position=writer.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=writer.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
    )


def _twist(writer: MessageWriter, twist: Twist) -> Any:  # noqa: ANN401 - made at run time
    covariance = -np.eye(6) if twist.covariance is None else twist.covariance
    angular, linear = (
        writer.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        for x, y, z in twist.velocity.reshape(2, 3).tolist()
    )
    return writer.make(
        "geometry_msgs/msg/TwistWithCovariance",
        twist=writer.make("geometry_msgs/msg/Twist", linear=linear, angular=angular),
        # In the child's own axes: nothing is turned, rotation and translation change places.
        covariance=covariance_to_ros(covariance, np.eye(3)).ravel(),
    )


def _point_fields(writer: MessageWriter) -> list[Any]:
    return [
        writer.make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=offset,
            datatype=_UINT8 if dtype == np.uint8 else _FLOAT32,
            count=1,
        )
        for name, (dtype, offset, *_) in (_POINT.fields or {}).items()
    ]
