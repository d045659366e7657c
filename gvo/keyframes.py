"""The kept frames, and how much the current frame has in common with each of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic

import numpy as np

from gvo.config import WindowConfig
from gvo.frontend.protocol import ObservationsT
from gvo.geometry.camera import StereoCamera
from gvo.keyframe_policy import proximity
from gvo.types import FloatArray

# Enough to tell the share in view to a few percent.
_N_SAMPLES = 64
# Beyond this ratio of depths a point of one image size is not found again.
_MAX_ZOOM = 1.6


class Keyframes(Generic[ObservationsT]):
    """The kept frames and the scores by which the policy judges them.

    Where the observations hold `points_cam` and the camera is known, the score of a keyframe is
    the share of its points that the current frame sees; else it is the proximity of the poses.

    Parameters
    ----------
    camera : StereoCamera or None
    config : WindowConfig
        Distance and angle of the proximity.
    """

    def __init__(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        self._camera = camera
        self._config = config
        self._kept: dict[int, ObservationsT] = {}
        self._samples: dict[int, FloatArray | None] = {}

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the kept frames, oldest first."""
        return list(self._kept)

    def __getitem__(self, stamp_ns: int) -> ObservationsT:
        """Return the observations of a kept frame."""
        return self._kept[stamp_ns]

    def __len__(self) -> int:
        """Return the number of kept frames."""
        return len(self._kept)

    def reconfigure(self, camera: StereoCamera | None, config: WindowConfig) -> None:
        """Score with another camera or configuration from now on; what is kept stays."""
        self._camera = camera
        self._config = config

    def add(self, observations: ObservationsT) -> None:
        """Keep a frame; of one that is kept already, other observations of it."""
        self._kept[observations.stamp_ns] = observations
        points = getattr(observations, "points_cam", None)
        self._samples[observations.stamp_ns] = None if points is None else sample_points(points)

    def drop(self, stamp_ns: int) -> None:
        """Forget a kept frame."""
        del self._kept[stamp_ns], self._samples[stamp_ns]

    def scores(self, T_current_keyframe: Mapping[int, FloatArray]) -> dict[int, float]:
        """Return how much the current frame has in common with keyframes, 0 to 1.

        Parameters
        ----------
        T_current_keyframe : mapping of int to ndarray of float64, shape (4, 4)
            By stamp of the keyframe.
        """
        return {stamp_ns: self._score(stamp_ns, T) for stamp_ns, T in T_current_keyframe.items()}

    def _score(self, stamp_ns: int, T_current_keyframe: FloatArray) -> float:
        points = self._samples[stamp_ns]
        if points is None or self._camera is None:
            return proximity(T_current_keyframe, self._config)
        return _overlap(points, T_current_keyframe, self._camera)


def sample_points(points_cam: FloatArray) -> FloatArray:
    """Return so many of n points, shape (n, 3), as tell the share in view; of these, all."""
    n = len(points_cam)
    chosen = np.linspace(0, n - 1, min(_N_SAMPLES, n))
    return points_cam[chosen.astype(np.int64)]


def _overlap(
    points_keyframe: FloatArray, T_current_keyframe: FloatArray, camera: StereoCamera
) -> float:
    """Return the share of points that another camera sees, at about the same distance."""
    if len(points_keyframe) == 0:
        return 0.0
    T = T_current_keyframe
    x, y, z = T[:3, :3] @ points_keyframe.T + T[:3, 3:]
    zoom = z / points_keyframe[:, 2]
    is_in_view = (zoom > 1.0 / _MAX_ZOOM) & (zoom < _MAX_ZOOM)
    # The limits of the image times z, which is positive where the zoom is right.
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    is_in_view &= (u >= 0.0) & (u < camera.width * z) & (v >= 0.0) & (v < camera.height * z)
    return float(np.count_nonzero(is_in_view)) / len(points_keyframe)
