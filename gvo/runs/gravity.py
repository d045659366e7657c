"""Which way is up in the world of a run: found by its IMU before the run begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

import numpy as np

from gvo.errors import ConfigurationError, said
from gvo.geometry.se3 import make_transform
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import ChosenImages, Source, StampedImage
from gvo.runs.loop import RunLoop
from gvo.types import FaultyFrame, FloatArray, Frame, FrameResult, Progress, Status

# The direction is known well from this sigma on, rad; what the first seconds with an IMU tell is
# taken in any case, nanoseconds; so much of a recording is looked at.
_SURE: Final = np.radians(0.5)
_PATIENCE_NS, _SEARCHED_NS = 5_000_000_000, 60_000_000_000
# Axes of a frame that may tell its heading, the first that is not steeper than 60 degrees: of a
# camera ahead, else the top of the image; of others x, else z.
_STEEP: Final = 0.5
_CAMERA_AXES: Final = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
_BODY_AXES: Final = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def align_with_gravity(
    loop: RunLoop, on_progress: Callable[[Progress], None] | None = None
) -> None:
    """Set the first pose of a run so that z of its world points up.

    The beginning of the recording is tracked to find it. Position and heading of the first pose
    stay, if it was asked for; where it has no heading, the frame heads along x. If the IMU does not
    tell which way is up, the output faults of the loop say so.

    Parameters
    ----------
    loop : RunLoop
        Before its run.
    on_progress : callable, optional
        Called after each frame.

    Raises
    ------
    ConfigurationError
        If no IMU is used.
    """
    info, config = loop.source.info, loop.config
    if info.imu is None or not config.imu.enabled:
        why = "no IMU is used" if info.imu is None else "imu.enabled is false"
        raise ConfigurationError(f"--gravity-aligned: {info.name}: {why}; run without it")
    search = _Search(loop.source)
    beginning = ChosenImages(info=info, images=search.images)
    ahead = RunLoop(beginning, config, BaseFrame(), excerpt=loop.excerpt)
    ahead.on_tracked = search.look
    ahead.run([], on_progress)
    if search.up is not None:
        loop.first_pose = partial(_first_pose, search.up, loop.base_frame, loop.first_pose)
    elif (inertial := ahead.statistics.inertial) is not None:
        why = f"the IMU was not used: {inertial.reason}"
        if search.is_lost:
            why = "the camera was lost before the IMU could tell which way is up"
        fault = f"--gravity-aligned: the world is not turned, {why}"
        loop.output_faults.append(said(fault))


def _first_pose(
    up_cam: FloatArray,
    base_frame: BaseFrame,
    asked: Callable[[int], FloatArray] | None,
    stamp_ns: int,
) -> FloatArray:
    T = np.eye(4) if base_frame.T_initial is None else base_frame.T_initial
    T = T if asked is None else asked(stamp_ns)
    up = base_frame.T_base_cam(stamp_ns)[:3, :3] @ up_cam
    axes = _CAMERA_AXES if base_frame.is_camera else _BODY_AXES
    return make_transform(_upright(T[:3, :3], up, axes), T[:3, 3])


class _Search:
    """Looks at the frames of a run."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._end_ns: int | None = None
        self._is_done = self.is_lost = False
        self.up: FloatArray | None = None

    def images(self) -> Iterator[StampedImage]:
        """Yield images until it is known."""
        for image in self._source.images():
            if self._is_done or (self._end_ns is not None and image.stamp_ns > self._end_ns):
                return
            yield image

    def look(self, frame: Frame | FaultyFrame, result: FrameResult | None) -> None:
        """Take the result of a frame, with poses of the camera."""
        if result is None:
            return
        if self._end_ns is None:
            self._end_ns = result.stamp_ns + _SEARCHED_NS
        state, is_measured = result.inertial, result.status in (Status.OK, Status.RESUMED)
        if result.segment > 0:  # another world has begun
            self._is_done = self.is_lost = True
        if state is None or not is_measured or self.is_lost:
            return
        if self.up is None:
            self._end_ns = min(self._end_ns, result.stamp_ns + _PATIENCE_NS)
        self.up = result.causal.T_world_frame[:3, :3] @ state.up
        self._is_done = bool(state.sigmas[0] < _SURE)


def _upright(
    R_world_frame: FloatArray, up: FloatArray, axes: tuple[tuple[float, ...], ...]
) -> FloatArray:
    """Return the rotation with this heading that turns a unit vector of the frame to z."""
    level = [np.array(axis) - np.dot(axis, up) * up for axis in axes]
    k = 0 if np.linalg.norm(level[0]) > _STEEP else 1
    heading = (R_world_frame @ axes[k]) * [1.0, 1.0, 0.0]
    if np.linalg.norm(heading) < _STEEP:
        heading = np.array([1.0, 0.0, 0.0])
    return _axes(heading, np.array([0.0, 0.0, 1.0])) @ _axes(level[k], up).T


def _axes(ahead: FloatArray, up: FloatArray) -> FloatArray:
    """Return the axes ahead, to the left and up, as columns (3, 3)."""
    ahead = ahead / np.linalg.norm(ahead)
    return np.column_stack([ahead, np.cross(up, ahead), up])
