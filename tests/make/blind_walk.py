"""A walk with an IMU on which the camera is blind for a while, and what is true of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.io.recording import Source
from gvo.io.synthetic import SyntheticRecording, rendered_imu
from gvo.io.synthetic.worlds.motion import look_around
from gvo.testing import Black, FaultySource
from gvo.types import FloatArray, IntArray

N_FRAMES = 66
BLIND = range(54, 62)
"""The frames without light."""
_STEP_S = 1e-4


@cache
def blind_walk(**imu: Any) -> Source:
    """Return the recording, 30 frames per second, with changes of its IMU."""
    worn = replace(rendered_imu(), **imu)
    walk = SyntheticRecording("handheld", "stereo", n_frames=N_FRAMES, scale=0.3, imu=worn)
    return FaultySource(walk, Black(first=BLIND.start, end=BLIND.stop))


def stamps_of(source: Source) -> IntArray:
    """Return the stamps of all frames."""
    truth = source.ground_truth()
    assert truth is not None
    return truth.stamps_ns


def true_poses(times_s: FloatArray, T_base_cam: FloatArray) -> FloatArray:
    """Return the poses (n, 4, 4) of a frame on which the camera is mounted, z up."""
    return np.asarray(look_around(times_s) @ np.linalg.inv(T_base_cam))


def true_twists(times_s: FloatArray, T_base_cam: FloatArray) -> FloatArray:
    """Return angular velocity and velocity (n, 6) of that frame in its own axes."""
    before, after = (true_poses(times_s + s, T_base_cam) for s in (-_STEP_S, _STEP_S))
    R = np.swapaxes(before[:, :3, :3], 1, 2)
    turn = Rotation.from_matrix(R @ after[:, :3, :3]).as_rotvec()
    shift = (R @ (after - before)[:, :3, 3:])[..., 0]
    return np.asarray(np.hstack([turn, shift]) / (2.0 * _STEP_S))


def true_ups(times_s: FloatArray, T_base_cam: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) upwards in the axes of that frame."""
    return true_poses(times_s, T_base_cam)[:, 2, :3]
