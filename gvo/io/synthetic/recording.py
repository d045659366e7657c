"""Rendered recordings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration
from gvo.geometry.imu import ImuStream
from gvo.geometry.se3 import invert, make_transform
from gvo.io.recording import RecordingInfo, Sensor, StampedImage, shown
from gvo.io.synthetic.imu import RenderedImu
from gvo.io.synthetic.rendering import scale_camera, to_uint8
from gvo.io.synthetic.rig_error import BentRig, RigError
from gvo.io.synthetic.sensor import SensorNoise, expose, spoil_depth
from gvo.io.synthetic.world import WORLDS, World, WorldName
from gvo.trajectory.trajectory import Trajectory
from gvo.types import DepthArray, FloatArray, IntArray

_START_NS = 1_700_000_000_000_000_000


class SyntheticRecording:
    """A recording rendered frame by frame when its images are loaded.

    Frames do not depend on one another, nor on `n_frames`: the same seed gives the same bytes,
    in any order and from several threads.

    Parameters
    ----------
    world : {"driving", "handheld", "turning", "hovering", "block"} or World
        `driving`: around a block of houses with KITTI's cameras at 10 Hz. `handheld`: a camera
        held in the hand in a furnished room, 640 x 480 at 30 Hz. `turning`: the same, turned to
        and fro at up to 85 deg/s. `hovering`: a drone in the room flies for 2 s, hovers for 3 s,
        and so on. `block`: the car closes its lap of 400 m, drives 80 m of it again, turns and
        comes back in the other lane, 570 m in 60 s; two opposite sides of the block look the
        same. Or a `World` of your own.
    sensor : {"stereo", "rgbd"}
    n_frames : int
        Length; the drive closes its lap of 400 m after about 480 frames.
    seed : int
        Of scene and noise, and in `turning`, `hovering` and `block` of the motion. Not negative.
    scale : float
        Size of the images relative to the full one; the intrinsics follow.
    noise : SensorNoise, optional
        Default: `SensorNoise()`, for driving with depth up to 80 m.
    readout_ms : float
        A rolling shutter: milliseconds from the first row to the one after the last. Row v of a
        frame is seen from the pose at its stamp + readout_ms * (v / height - 1/2), in both images
        of a stereo camera; stamps and ground truth are those of the middle row. Depth is
        registered to the colour image without error, along the axis of the row's pose. What
        moves in a world stands still during the readout. 0: all rows at once.
    rig_error : RigError, optional
        Images, and depth, are those of a rig that differs from the ideal one, whose calibration
        and ground truth are given.
    imu : RenderedImu, optional
        An IMU beside the camera, see `rendered_imu`.

    Raises
    ------
    ValueError
        Unknown world or sensor, no frames; a seed, a scale or a readout out of range.

    Examples
    --------
    >>> recording = SyntheticRecording("handheld", "stereo", n_frames=2, scale=0.25)
    >>> [image.load().shape for image in recording.images()]
    [(120, 160), (120, 160), (120, 160), (120, 160)]
    """

    def __init__(
        self,
        world: WorldName | World = "driving",
        sensor: Sensor = "stereo",
        *,
        n_frames: int = 100,
        seed: int = 0,
        scale: float = 1.0,
        noise: SensorNoise | None = None,
        readout_ms: float = 0.0,
        rig_error: RigError | None = None,
        imu: RenderedImu | None = None,
    ) -> None:
        _check(world, sensor, n_frames, seed, scale)
        self._world = world if isinstance(world, World) else WORLDS[world]
        frame_ms = 1e3 / self._world.rate_hz
        if not 0.0 <= readout_ms <= frame_ms:
            raise ValueError(f"readout_ms must be in [0, {frame_ms:.1f}], got {readout_ms}")
        self._sensor, self._seed, self._readout_s = sensor, seed, 1e-3 * readout_ms
        self._camera = scale_camera(self._world.camera, scale)
        self._noise = noise or SensorNoise(max_depth_m=self._world.max_depth_m)
        frames = np.arange(n_frames, dtype=np.int64)
        self._elapsed_ns: IntArray = frames * 1_000_000_000 // self._world.rate_hz
        self._move = self._world.motion(seed)
        self._T_map_cam = self._move(np.asarray(1e-9 * self._elapsed_ns, dtype=np.float64))
        self._scene = self._world.scene(seed)
        self._bent = None
        if rig_error is not None:
            constants = rig_error.draw(self._camera, is_stereo=sensor == "stereo")
            self._bent = BentRig(self._camera, self._world.baseline_m, constants)
        self._imu = imu

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        left = Calibration.from_camera(self._camera)
        right = Calibration.from_camera(self._camera, baseline=self._world.baseline_m)
        return RecordingInfo(
            name=f"{self._world.name}-{self._sensor}",
            sensor=self._sensor,
            calibrations=(left, right) if self._sensor == "stereo" else (left,),
            n_images=len(self._elapsed_ns),
            decisions=[f"rendered: world {self._world.name}, seed {self._seed}"],
            imu=self._stream(),
        )

    def _stream(self) -> ImuStream | None:
        if self._imu is None:
            return None
        length_s = self._elapsed_s(-1)
        samples = partial(self._imu.samples, self._move, _START_NS, length_s, self._seed)
        return ImuStream(name="rendered", imu=self._imu.imu, samples=lambda _: samples())

    __repr__ = shown

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both streams, frame by frame."""
        for index, elapsed_ns in enumerate(self._elapsed_ns):
            for stream in (0, 1):
                yield StampedImage(
                    stream=stream,
                    stamp_ns=_START_NS + int(elapsed_ns),
                    load=partial(self._load, index, stream),
                )

    def ground_truth(self) -> Trajectory:
        """Return the exact T_world_cam of the left or colour camera; the first is the identity."""
        T_world_cam = invert(self._T_map_cam[0]) @ self._T_map_cam
        T_world_cam[0] = np.eye(4)
        return Trajectory(stamps_ns=_START_NS + self._elapsed_ns, T_world_frame=T_world_cam)

    def render_depth(self, index: int, stream: int = 0) -> DepthArray:
        """Return the exact depth of a frame.

        Parameters
        ----------
        index : int
            Of the frame.
        stream : int
            1 is the right camera of a stereo recording.

        Returns
        -------
        ndarray of float32, shape (height, width)
            Metres along the optical axis at the centre of each pixel, of a rolling shutter from
            the pose of its row.
        """
        return self._scene.depth(self._elapsed_s(index), self._view(index, stream), self._camera)

    def _elapsed_s(self, index: int) -> float:
        return 1e-9 * float(self._elapsed_ns[index])

    def _view(self, index: int, stream: int) -> FloatArray:
        """Return the pose or poses of a stream's camera; that of depth is the colour camera."""
        T_map_cam = self._poses(index)
        if stream == 0 or self._sensor == "rgbd":
            return T_map_cam
        T_left_right = make_transform(np.eye(3), np.array([self._world.baseline_m, 0.0, 0.0]))
        return T_map_cam @ T_left_right

    def _poses(self, index: int) -> FloatArray:
        """Return the pose of a frame, shape (4, 4), or those of its rows, (height, 4, 4)."""
        if self._readout_s == 0.0:
            return np.asarray(self._T_map_cam[index])
        height = self._camera.height
        rows_s = self._readout_s * (np.arange(height) / height - 0.5)
        return self._move(self._elapsed_s(index) + rows_s)

    def _load(self, index: int, stream: int) -> NDArray[Any]:
        rng = np.random.default_rng([self._seed, index, stream])
        bent = self._bent
        if stream == 1 and self._sensor == "rgbd":
            depth = self.render_depth(index)
            return spoil_depth(depth if bent is None else bent.bend_depth(depth), self._noise, rng)
        elapsed_s = self._elapsed_s(index)
        grey = self._scene.image(elapsed_s, self._view(index, stream), self._camera)
        if bent is not None:
            grey = bent.bend(grey, self.render_depth(index, 1) if stream == 1 else None)
        return to_uint8(expose(grey, self._noise, rng, stream=stream, elapsed_s=elapsed_s))


def _check(world: WorldName | World, sensor: str, n_frames: int, seed: int, scale: float) -> None:
    if not isinstance(world, World) and world not in WORLDS:
        raise ValueError(f"world must be one of {sorted(WORLDS)}, got {world!r}")
    if sensor not in get_args(Sensor):
        raise ValueError(f"sensor must be one of {sorted(get_args(Sensor))}, got {sensor!r}")
    if n_frames < 1 or seed < 0:
        raise ValueError(f"n_frames must be positive, seed not negative: {n_frames}, {seed}")
    if not 0.05 <= scale <= 4.0:
        raise ValueError(f"scale must be in [0.05, 4], got {scale}")
