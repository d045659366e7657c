"""Which frames stay in the window, and which of them the current frame is linked to."""

from __future__ import annotations

import numpy as np

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray, Observations

# Enough to tell the share in view to a few percent.
_N_SAMPLES = 64
# Beyond this ratio of depths a descriptor of one octave is not found again.
_MAX_ZOOM = 1.6


class Keyframes:
    """The kept frames and the share of their points that the current frame sees.

    Parameters
    ----------
    camera : StereoCamera
    config : WindowConfig
        Number of keyframes, thresholds of overlap.
    """

    def __init__(self, camera: StereoCamera, config: WindowConfig) -> None:
        self._camera = camera
        self._config = config
        self._kept: dict[int, Observations] = {}
        self._samples: dict[int, FloatArray] = {}

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the kept frames, oldest first."""
        return list(self._kept)

    def __getitem__(self, stamp_ns: int) -> Observations:
        """Return the observations of a kept frame."""
        return self._kept[stamp_ns]

    def add(self, observations: Observations) -> None:
        """Keep a frame."""
        self._kept[observations.stamp_ns] = observations
        chosen = np.linspace(0, len(observations) - 1, min(_N_SAMPLES, len(observations)))
        self._samples[observations.stamp_ns] = observations.points_cam[chosen.astype(np.int64)]

    def drop(self, stamp_ns: int) -> None:
        """Forget a kept frame."""
        del self._kept[stamp_ns], self._samples[stamp_ns]

    def overlaps(self, T_current_keyframe: dict[int, FloatArray]) -> dict[int, float]:
        """Return the share of each keyframe's points that the current frame sees.

        Parameters
        ----------
        T_current_keyframe : dict of int to ndarray of float64, shape (4, 4)
            By stamp of the keyframe.
        """
        return {
            stamp_ns: self._overlap(self._samples[stamp_ns], T)
            for stamp_ns, T in T_current_keyframe.items()
        }

    def _overlap(self, points_keyframe: FloatArray, T_current_keyframe: FloatArray) -> float:
        if len(points_keyframe) == 0:
            return 0.0
        points = se3.transform_points(T_current_keyframe, points_keyframe)
        zoom = points[:, 2] / points_keyframe[:, 2]
        points = points[(zoom > 1.0 / _MAX_ZOOM) & (zoom < _MAX_ZOOM)]
        u, v = self._camera.project(points).T
        is_in_view = (u >= 0) & (u < self._camera.width) & (v >= 0) & (v < self._camera.height)
        return float(np.count_nonzero(is_in_view)) / len(points_keyframe)

    def is_needed(self, overlaps: dict[int, float]) -> bool:
        """Tell whether the current frame sees so much new that it should be kept."""
        return max(overlaps.values(), default=0.0) < self._config.keyframe_overlap

    def choose_links(self, overlaps: dict[int, float], *, exclude: int) -> list[int]:
        """Choose the keyframes to register the current frame against.

        Half of them see the most of it, the others are the oldest that still see enough: these
        hold the drift.
        """
        n = self._config.n_links - 1
        usable = [
            stamp_ns
            for stamp_ns, overlap in overlaps.items()
            if overlap >= self._config.min_overlap and stamp_ns != exclude
        ]
        by_age = sorted(usable)[: (n + 1) // 2]
        rest = sorted(set(usable) - set(by_age), key=lambda stamp: (-overlaps[stamp], stamp))
        return by_age + rest[: n - len(by_age)]

    def choose_released(self, overlaps: dict[int, float]) -> list[int]:
        """Choose the keyframes to let go: out of view, and the least seen beyond the limit."""
        out_of_view = [
            stamp_ns for stamp_ns, overlap in overlaps.items() if overlap < self._config.min_overlap
        ]
        rest = sorted(set(overlaps) - set(out_of_view), key=lambda stamp: (overlaps[stamp], stamp))
        n_over = max(len(self._kept) - len(out_of_view) - self._config.n_keyframes, 0)
        return out_of_view + rest[:n_over]
