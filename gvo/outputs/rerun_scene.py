"""What a run computes, as archetypes of the Rerun viewer.

`rerun` is imported with this module: import it where a file is written, no earlier.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera
from gvo.io.convert.bag_messages import pose_numbers
from gvo.io.images import encode_jpeg
from gvo.types import Estimate, FloatArray, FrameLink, ImageArray, RelativePose, Status
from gvo.viz import palette

Colour: TypeAlias = tuple[int, int, int]

KEYFRAMES: Final = "keyframes"
N_SIGMAS: Final = 3.0
"""Half-axes of an ellipsoid, in standard deviations."""
SHOWN_WIDTH_PX: Final = 640
"""Images in the scene are halved until they are no wider."""

_LEVELS: Final = {
    Status.OK: rr.TextLogLevel.INFO,
    Status.RESUMED: rr.TextLogLevel.WARN,
    Status.COASTING: rr.TextLogLevel.WARN,
    Status.LOST: rr.TextLogLevel.ERROR,
    Status.SKIPPED: rr.TextLogLevel.ERROR,
}
# Of the viewer, so that they are seen from any distance.
_LINE: Final = rr.Radius.ui_points(1.5)
_THIN_LINE: Final = rr.Radius.ui_points(0.75)
_DOT: Final = rr.Radius.ui_points(4.0)
_SMALL_DOT: Final = rr.Radius.ui_points(1.5)


def colour_of(code: str) -> Colour:
    """Return `#RRGGBB` as three numbers."""
    red, green, blue = bytes.fromhex(code.removeprefix("#"))
    return red, green, blue


COLOURS: Final[Mapping[str, Colour]] = {
    **{name: colour_of(code) for name, code in palette.ESTIMATES.items()},
    KEYFRAMES: colour_of(palette.LINKS["keyframe"]),
}
COUNT_COLOURS: Final = {
    name: colour_of(palette.COUNTS[name]) for name in ("matches", "inliers", "points")
}
STAGE_COLOURS: Final = {name: colour_of(code) for name, code in palette.STAGES.items()}
LINK_COLOURS: Final = {kind: colour_of(code) for kind, code in palette.LINKS.items()}
_INLIER, _OUTLIER = colour_of(palette.INLIERS), colour_of(palette.OUTLIERS)


def make_transform(T_parent_child: FloatArray) -> rr.Transform3D:
    """Return a pose (4, 4) as a transform of an entity."""
    numbers = pose_numbers(T_parent_child)
    return rr.Transform3D(translation=numbers[:3], quaternion=rr.Quaternion(xyzw=numbers[3:]))


def make_marker(name: str) -> rr.Points3D:
    """Return a dot at the origin of a frame, in the colour of its estimate."""
    return rr.Points3D([np.zeros(3)], colors=COLOURS[name], radii=_DOT)


def make_path(name: str, positions: FloatArray) -> rr.LineStrips3D:
    """Return positions (n, 3) as one line in the colour of its estimate."""
    strips = [positions] if len(positions) > 1 else []
    return rr.LineStrips3D(strips, colors=COLOURS[name], radii=_LINE)


def make_keyframes(keyframes: Sequence[Estimate]) -> rr.Points3D:
    """Return poses as dots."""
    return rr.Points3D(_positions(keyframes), colors=COLOURS[KEYFRAMES], radii=_DOT)


def make_links(links: Sequence[FrameLink], segments: FloatArray) -> rr.LineStrips3D:
    """Return edges as lines.

    Parameters
    ----------
    links : sequence of FrameLink
        Those that the window refused have a colour of their own.
    segments : ndarray of float64, shape (n, 2, 3)
        Where each of them begins and ends, in the world, metres.
    """
    codes = [palette.LINKS[link.kind] if link.is_accepted else palette.REFUSED for link in links]
    colours = [colour_of(code) for code in codes]
    return rr.LineStrips3D(list(segments), colors=colours or None, radii=_THIN_LINE)


def make_ellipsoids(name: str, estimates: Sequence[Estimate]) -> rr.Ellipsoids3D:
    """Return the 3-sigma ellipsoids of positions, in the world.

    Those that are not known to be finite are left out.

    Parameters
    ----------
    name : str
        A key of `COLOURS`.
    estimates : sequence of Estimate
    """
    known = [e for e in estimates if np.isfinite(e.covariance).all()]
    axes = [_axes(estimate) for estimate in known]
    return rr.Ellipsoids3D(
        centers=_positions(known),
        half_sizes=np.array([half_sizes for half_sizes, _ in axes]).reshape(-1, 3),
        quaternions=np.array([quaternion for _, quaternion in axes]).reshape(-1, 4),
        colors=COLOURS[name],
        line_radii=_THIN_LINE,
    )


def _axes(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return half-axes (3,) in metres and the quaternion (x, y, z, w) that turns them."""
    # The covariance is stated along the axes of the frame: the pose turns it into the world.
    variances, directions = np.linalg.eigh(estimate.covariance[3:, 3:])
    if np.linalg.det(directions) < 0:
        directions = -directions
    R = estimate.T_world_cam[:3, :3] @ directions
    half_sizes = N_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    return half_sizes, np.asarray(Rotation.from_matrix(R).as_quat())


def _positions(estimates: Sequence[Estimate]) -> FloatArray:
    return np.array([e.T_world_cam[:3, 3] for e in estimates]).reshape(-1, 3)


def make_matches(found: RelativePose) -> rr.Points3D:
    """Return the matched points in the camera's frame, inliers and outliers coloured."""
    points = found.points_current
    is_finite = np.isfinite(points).all(axis=1)
    is_inlier = found.inliers[: len(points)]
    colours = np.where(is_inlier[:, np.newaxis], _INLIER, _OUTLIER)
    return _points(points[is_finite], colours[is_finite])


def make_cloud(found: RelativePose, image: ImageArray, T_world_cam: FloatArray) -> rr.Points3D:
    """Return the inliers' points in the world, as grey as the image is there.

    Parameters
    ----------
    found : RelativePose
    image : ndarray of uint8, shape (height, width)
        The current one.
    T_world_cam : ndarray of float64, shape (4, 4)
        Maps camera coordinates to the world, metres.
    """
    points, pixels = found.points_current, found.pixels_current
    n = min(len(points), len(pixels))
    is_shown = found.inliers[:n] & np.isfinite(points[:n]).all(axis=1)
    is_shown &= np.isfinite(pixels[:n]).all(axis=1)
    height, width = image.shape
    u, v = np.rint(pixels[:n][is_shown]).astype(np.int64).T
    greys = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    points_world = points[:n][is_shown] @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return _points(points_world, np.repeat(greys[:, np.newaxis], 3, axis=1))


def _points(points: FloatArray, colours: FloatArray | ImageArray) -> rr.Points3D:
    # No colour for no point: an empty array would be taken for one of a shape it has not.
    kept = colours.astype(np.uint8) if len(points) > 0 else None
    return rr.Points3D(points.reshape(-1, 3), colors=kept, radii=_SMALL_DOT)


def make_image(image: ImageArray) -> rr.EncodedImage:
    """Return an image, grey or BGR, as a JPEG file."""
    return rr.EncodedImage(contents=encode_jpeg(image), media_type="image/jpeg")


def halve(image: ImageArray) -> ImageArray:
    """Return an image (height, width) for the scene, at most `SHOWN_WIDTH_PX` wide."""
    n = shrinkage(image.shape[1])
    if n == 1:
        return image
    height, width = (size // n for size in image.shape)
    cropped = image[: height * n, : width * n]
    return np.asarray(cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA))


def make_pinhole(camera: PinholeCamera) -> rr.Pinhole:
    """Return the camera of what `halve` returns."""
    n = shrinkage(camera.width)
    # Pixel (0, 0) is the centre of the first pixel: its corner is where sizes are scaled about.
    return rr.Pinhole(
        focal_length=[camera.fx / n, camera.fy / n],
        principal_point=[(camera.cx + 0.5) / n - 0.5, (camera.cy + 0.5) / n - 0.5],
        resolution=[camera.width // n, camera.height // n],
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def shrinkage(width: int) -> int:
    """Return by what an image of this width is divided for the scene: 1, 2, 4, ..."""
    n = 1
    while width // n > SHOWN_WIDTH_PX:
        n *= 2
    return n


def make_series(name: str, colour: Colour | None = None) -> rr.SeriesLines:
    """Return how a number is drawn over time."""
    return rr.SeriesLines(names=name, colors=None if colour is None else colour, widths=1.5)


def make_status(status: Status, text: str) -> rr.TextLog:
    """Return a line of the log."""
    return rr.TextLog(text, level=_LEVELS[status])


def make_axes(*, is_optical: bool) -> rr.AsComponents:
    """Return the axes of the world: a camera's, or x forward, y left, z up."""
    return rr.ViewCoordinates.RDF if is_optical else rr.ViewCoordinates.FLU
