"""Coloured points of frames, accumulated and thinned to what a page can show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.config import DepthConfig
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, Frame, ImageArray, RelativePose, RgbdFrame

# Points (n, 3) in metres and their colours (n, 3), red, green, blue.
Cloud: TypeAlias = tuple[NDArray[np.float32], NDArray[np.uint8]]
MAX_FRAME_POINTS = 5_000
MAX_POINTS = 200_000
# Points that are kept of all keyframes together, before they are thinned.
_MAX_KEPT = 1_000_000
# Size of the first voxels, relative to the median distance of a point from its camera.
_VOXEL_SHARE = 0.01
_MIN_VOXEL_M = 1e-4
_VOXEL_BITS = 21  # of each of three coordinates in one integer


def empty_cloud() -> Cloud:
    """Return a cloud without points."""
    return np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.uint8)


def frame_cloud(
    frame: Frame, registration: RelativePose | None, camera: PinholeCamera, config: DepthConfig
) -> Cloud:
    """Return the points that a frame measured, in the `cam` frame.

    Parameters
    ----------
    frame : StereoFrame or RgbdFrame
    registration : RelativePose or None
        Of a stereo frame: its inliers are the points; none without it.
    camera : PinholeCamera
    config : DepthConfig
        Range of the depths of an RGB-D frame, of which a grid of at most 5,000 is taken.

    Returns
    -------
    points_cam : ndarray of float32, shape (n, 3)
    colours : ndarray of uint8, shape (n, 3)
        Grey of the image at the points.
    """
    if isinstance(frame, RgbdFrame):
        return _depth_cloud(frame, camera, config)
    if registration is None or len(registration.points_current) == 0:
        return empty_cloud()
    inliers = registration.inliers
    points = registration.points_current[inliers].astype(np.float32)
    pixels = np.rint(registration.pixels_current[inliers]).astype(np.int64)
    columns = np.clip(pixels[:, 0], 0, frame.left.shape[1] - 1)
    rows = np.clip(pixels[:, 1], 0, frame.left.shape[0] - 1)
    return points, _as_colours(frame.left[rows, columns])


def _depth_cloud(frame: RgbdFrame, camera: PinholeCamera, config: DepthConfig) -> Cloud:
    height, width = frame.depth.shape
    step = max(math.ceil(math.sqrt(height * width / MAX_FRAME_POINTS)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    rows, columns = rows[:MAX_FRAME_POINTS], columns[:MAX_FRAME_POINTS]
    depths = frame.depth[rows, columns].astype(np.float64)
    # NaN compares as out of range.
    is_known = (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
    rows, columns, depths = rows[is_known], columns[is_known], depths[is_known]
    rays = camera.unproject(np.stack([columns, rows], axis=1).astype(np.float64))
    points = (rays * depths[:, np.newaxis]).astype(np.float32)
    return points, _as_colours(frame.image[rows, columns])


def _as_colours(greys: ImageArray) -> NDArray[np.uint8]:
    return np.repeat(greys.astype(np.uint8)[:, np.newaxis], 3, axis=1)


class KeyframeClouds:
    """The clouds of keyframes, in bounded memory: halved when there are too many points."""

    def __init__(self) -> None:
        self._clouds: dict[int, Cloud] = {}
        self._n_points = 0
        self._step = 1

    def __len__(self) -> int:
        """Return the number of points that are kept."""
        return self._n_points

    def add(self, index: int, cloud: Cloud) -> None:
        """Keep the cloud of a frame, by the frame's index."""
        self._clouds[index] = _every(cloud, self._step)
        self._n_points += len(self._clouds[index][0])
        while self._n_points > _MAX_KEPT:
            self._step *= 2
            self._clouds = {index: _every(cloud, 2) for index, cloud in self._clouds.items()}
            self._n_points = sum(len(points) for points, _ in self._clouds.values())

    def select(self, T_world_cams: Mapping[int, FloatArray]) -> list[tuple[FloatArray, Cloud]]:
        """Pair poses, by index of the frame, with the clouds of the frames."""
        return [(T, self._clouds[index]) for index, T in T_world_cams.items()]


def accumulate(clouds: Sequence[tuple[FloatArray, Cloud]]) -> Cloud:
    """Place clouds in the world and thin them to at most 200,000 points.

    Parameters
    ----------
    clouds : sequence of (T_world_frame, cloud)
        T_world_frame has shape (4, 4).

    Returns
    -------
    points_world : ndarray of float32, shape (n, 3)
    colours : ndarray of uint8, shape (n, 3)
    """
    if sum(len(points) for _, (points, _) in clouds) == 0:
        return empty_cloud()
    points_cam = [points.astype(np.float64) for _, (points, _) in clouds]
    points = np.concatenate(list(map(se3.transform_points, [T for T, _ in clouds], points_cam)))
    colours = np.concatenate([colours for _, (_, colours) in clouds])
    median_m = float(np.median(np.linalg.norm(np.concatenate(points_cam), axis=1)))
    chosen = thin(points, _VOXEL_SHARE * median_m)
    return points[chosen].astype(np.float32), colours[chosen]


def thin(points: FloatArray, voxel_m: float, *, n_max: int = MAX_POINTS) -> NDArray[np.intp]:
    """Choose one point per voxel.

    Parameters
    ----------
    points : ndarray of float64, shape (n, 3)
        Metres.
    voxel_m : float
        Edge of the voxels; doubled until few enough points are left.
    n_max : int
        How many may be left.

    Returns
    -------
    ndarray of int, shape (m,)
        Indices of the chosen points, ascending.
    """
    indices = np.arange(len(points))
    lowest = points.min(axis=0) if len(points) else np.zeros(3)
    extent = float((points - lowest).max()) if len(points) else 0.0
    voxel_m = max(voxel_m, extent / (2**_VOXEL_BITS - 2), _MIN_VOXEL_M)
    while len(indices) > 0:
        cells = ((points[indices] - lowest) / voxel_m).astype(np.int64)
        keys = (cells[:, 0] << 2 * _VOXEL_BITS) | (cells[:, 1] << _VOXEL_BITS) | cells[:, 2]
        indices = np.sort(indices[np.unique(keys, return_index=True)[1]])
        if len(indices) <= n_max:
            break
        voxel_m *= 2.0
    return indices


def _every(cloud: Cloud, step: int) -> Cloud:
    return cloud[0][::step], cloud[1][::step]
