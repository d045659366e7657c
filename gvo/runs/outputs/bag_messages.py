"""Messages of what odometry computes: poses, paths, points, pictures, diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from gvo.geometry import se3
from gvo.io.convert.bag_messages import Header, MessageWriter, pose_numbers
from gvo.runs.outputs.frames import Twist
from gvo.types import Estimate, FloatArray, ImageArray, IntArray, Status
from gvo.viz.palette import DRAWN, rgb
from gvo.viz.scene import Points

ODOMETRY_TYPE: Final = "nav_msgs/msg/Odometry"
PATH_TYPE: Final = "nav_msgs/msg/Path"
CLOUD_TYPE: Final = "sensor_msgs/msg/PointCloud2"
MARKER_TYPE: Final = "visualization_msgs/msg/Marker"
DIAGNOSTICS_TYPE: Final = "diagnostic_msgs/msg/DiagnosticArray"

_LINE_LIST = 5  # of visualization_msgs/Marker
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
    """Return (6, 6) of (x, y, z, rx, ry, rz) in the parent, of (rx, ..., tz) in the frame."""
    # Exchange the halves and turn both: with the inverse rotation, that is the way back.
    return se3.covariance_from_ros(covariance, R_parent_frame.T)


def write_odometry(
    writer: MessageWriter, topic: str, estimate: Estimate, frames: tuple[str, str], twist: Twist
) -> None:
    """Write a pose in the frames (parent, child), and the velocity of the child in its own axes."""
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
    """Write poses (n, 7), positions and quaternions (x, y, z, w), with their stamps."""
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
    """Write lines (n, 2, 3) in metres; another marker of this name and number replaces it."""
    red, green, blue = (value / 255 for value in rgb(DRAWN["loops"]))
    message = writer.make(
        MARKER_TYPE,
        header=writer.header(header),
        ns=name,
        id=number,
        type=_LINE_LIST,
        pose=_pose(writer, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        scale=writer.make("geometry_msgs/msg/Vector3", x=_LINE_WIDTH_M),
        color=writer.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        points=[
            writer.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
            for x, y, z in segments.reshape(-1, 3).tolist()
        ],
    )
    writer.write("/gvo/loops", MARKER_TYPE, message, header.stamp_ns)


def write_points(
    writer: MessageWriter, topic: str, header: Header, points: Points, intensities: ImageArray
) -> None:
    """Write points with fields x, y, z, intensity (FLOAT32) and inlier (UINT8, 0 or 1)."""
    cloud = np.zeros(len(points.points_cam), dtype=_POINT)
    for name, values in zip("xyz", points.points_cam.T, strict=True):
        cloud[name] = values
    cloud["intensity"], cloud["inlier"] = intensities, points.inliers
    message = writer.make(
        CLOUD_TYPE,
        header=writer.header(header),
        height=1,
        width=len(cloud),
        fields=_point_fields(writer),
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
    """Write the state of a frame, or of what frames come from, to `/diagnostics`."""
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
