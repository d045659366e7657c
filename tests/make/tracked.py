"""Short rendered recordings, tracked once, and what hangs on a robot."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.config import Config
from gvo.geometry.se3 import make_transform
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording, WorldName
from gvo.odometry.odometry import Odometry
from gvo.runs.outputs.frames import RunFrames
from gvo.types import Estimate, FloatArray, Frame, FrameResult
from tests.make.recordings import frames_of

N_FRAMES = 12
SECOND_NS = 10**9
START_NS = 1_403_636_584_763_555_584
# A camera that looks ahead and 20 degrees down, on a robot whose x points ahead and z up.
T_BASE_CAM = make_transform(
    np.asarray(Rotation.from_euler("ZYX", [-90, 0, -110], degrees=True).as_matrix()),
    np.array([0.3, -0.1, 0.5]),
)
MOUNTED = RunFrames(base="base_link", camera="/left_optical", T_base_cam=T_BASE_CAM)


@dataclass(frozen=True)
class Tracked:
    """A recording of 12 frames, and what odometry gave."""

    recording: SyntheticRecording
    frames: list[Frame]
    results: list[FrameResult]
    last: tuple[Estimate, ...]

    def pairs(self) -> list[tuple[Frame, FrameResult]]:
        return list(zip(self.frames, self.results, strict=True))


@cache
def tracked(world: WorldName, sensor: Sensor) -> Tracked:
    recording = SyntheticRecording(world, sensor, n_frames=N_FRAMES, scale=0.5)
    odometry = Odometry(recording.info.camera, Config())
    frames = frames_of(recording)
    results = [odometry.track(frame) for frame in frames]
    return Tracked(recording=recording, frames=frames, results=results, last=odometry.finish())


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
    """Return a transform without a turn."""
    return make_transform(np.eye(3), np.array([x, y, z]))


def by_stamp(estimates: Iterable[Estimate]) -> dict[int, Estimate]:
    return {estimate.stamp_ns: estimate for estimate in estimates}
