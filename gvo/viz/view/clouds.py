"""Coloured points of frames, accumulated and thinned to what a page can show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.config import DepthConfig
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, Frame, ImageArray, RgbdFrame
from gvo.viz.scene import Points, grey_values

# Points (n, 3) in metres and their colours (n, 3), red, green, blue.
Cloud: TypeAlias = tuple[NDArray[np.float32], NDArray[np.uint8]]
MAX_FRAME_POINTS = 5_000
MAX_POINTS = 200_000
NO_CLOUD: Cloud = np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.uint8)


def frame_cloud(frame: Frame, points: Points, camera: PinholeCamera, config: DepthConfig) -> Cloud:
    """Return the points that a frame measured, in the `cam` frame, as grey as the image is there.

    Of a stereo frame they are the matched inliers, of an RGB-D frame a grid of its depths.
    """
    if isinstance(frame, RgbdFrame):
        return _depth_cloud(frame, camera, config)
    kept = points.points_cam[points.inliers].astype(np.float32)
    return kept, _as_colours(grey_values(frame.left, points.pixels[points.inliers]))


def _depth_cloud(frame: RgbdFrame, camera: PinholeCamera, config: DepthConfig) -> Cloud:
    height, width = frame.depth.shape
    step = max(math.ceil(math.sqrt(height * width / MAX_FRAME_POINTS)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    depths = frame.depth[rows, columns].astype(np.float64)
    # NaN compares as out of range.
    is_known = (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
    rows, columns, depths = rows[is_known], columns[is_known], depths[is_known]
    rays = camera.unproject(np.stack([columns, rows], axis=1).astype(np.float64))
    points = (rays * depths[:, np.newaxis]).astype(np.float32)
    return points, _as_colours(frame.image[rows, columns])


def _as_colours(greys: ImageArray) -> NDArray[np.uint8]:
    return np.repeat(greys.astype(np.uint8)[:, np.newaxis], 3, axis=1)


def accumulate(clouds: Sequence[tuple[FloatArray, Cloud]]) -> Cloud:
    """Place clouds in the world by their T_world_frame (4, 4)."""
    placed = [se3.transform_points(T, points.astype(np.float64)) for T, (points, _) in clouds]
    points = np.concatenate([NO_CLOUD[0], *placed]).astype(np.float32)
    return points, np.concatenate([NO_CLOUD[1], *(colours for _, (_, colours) in clouds)])


def halve(cloud: Cloud) -> Cloud:
    """Return every second point; of a single one none."""
    return cloud[0][1::2].copy(), cloud[1][1::2].copy()
