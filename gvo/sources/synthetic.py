"""A rendered recording: known scene, known poses, the faults of a sensor on request."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.geometry.se3 import invert, make_transform
from gvo.sources.recording import RecordingInfo, Sensor, StampedImage
from gvo.sources.rendering import to_uint8
from gvo.sources.scene import Scene
from gvo.sources.sensor_noise import SensorNoise, expose, spoil_depth
from gvo.sources.stage import Stage
from gvo.sources.worlds.deceptive_rooms import blank_room, mirror_room, turn_away
from gvo.sources.worlds.facade import facade, ride
from gvo.sources.worlds.motion import drive, look_around
from gvo.sources.worlds.room import room
from gvo.sources.worlds.street import street
from gvo.sources.worlds.traffic import traffic, traffic_drive
from gvo.trajectory.trajectory import Trajectory
from gvo.types import DepthArray, FloatArray, ImageArray, IntArray

WorldName: TypeAlias = Literal["driving", "handheld", "traffic", "facade", "mirror", "wall"]

_START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _World:
    """A scene, a motion through it, and the cameras that fit."""

    build: Callable[[int], Scene | Stage]
    move: Callable[[FloatArray], FloatArray]
    camera: PinholeCamera
    baseline: float
    rate_hz: int
    max_depth_m: float


def _by_car(
    build: Callable[[int], Scene | Stage], move: Callable[[FloatArray], FloatArray]
) -> _World:
    return _World(
        build=build,
        move=move,
        camera=PinholeCamera(
            fx=707.0912, fy=707.0912, cx=601.8873, cy=183.1104, width=1226, height=370
        ),
        baseline=0.53715,
        rate_hz=10,
        max_depth_m=80.0,
    )


def _by_hand(
    build: Callable[[int], Scene | Stage], move: Callable[[FloatArray], FloatArray]
) -> _World:
    return _World(
        build=build,
        move=move,
        camera=PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480),
        baseline=0.11,
        rate_hz=30,
        max_depth_m=8.0,
    )


_WORLDS = {
    "driving": _by_car(street, drive),
    "handheld": _by_hand(room, look_around),
    "traffic": _by_car(traffic, traffic_drive),
    "facade": _by_car(facade, ride),
    "mirror": _by_hand(mirror_room, look_around),
    "wall": _by_hand(blank_room, turn_away),
}


class SyntheticRecording:
    """A recording rendered frame by frame when its images are loaded.

    Frames do not depend on one another, nor on `n_frames`: the same seed gives the same bytes,
    in any order and from several threads.

    Parameters
    ----------
    world : {"driving", "handheld", "traffic", "facade", "mirror", "wall"}
        `driving`: around a block of houses with KITTI's cameras at 10 Hz. `handheld`: a camera
        held in the hand in a furnished room, 640 x 480 at 30 Hz. The others deceive, each with
        the cameras of one of these. `traffic`: the car halts, and a bus fills two thirds of the
        image; from 3 to 10 s. `facade`: sideways along a house whose windows repeat exactly, by
        more than half a window per frame. `mirror`: the room with a large mirror that swings:
        what is seen in it moves as one. A stereo camera sees the virtual room behind the glass;
        the depth of an RGB-D camera is that of the glass, as of dusty ones, while its image
        shows what is reflected. `wall`: the hand turns to a wall of one grey, which fills the
        image from 3.8 to 7.0 s, and turns back.
    sensor : {"stereo", "rgbd"}
    n_frames : int
        Length; the drive closes its lap of 400 m after about 480 frames.
    seed : int
        Of scene and noise, not negative.
    scale : float
        Size of the images relative to the full one; the intrinsics follow.
    noise : SensorNoise, optional
        Default: `SensorNoise()`, for driving with depth up to 80 m.

    Raises
    ------
    ValueError
        Unknown world or sensor, no frames, a seed or a scale out of range.

    Examples
    --------
    >>> recording = SyntheticRecording("handheld", "stereo", n_frames=2, scale=0.25)
    >>> [image.load().shape for image in recording.images()]
    [(120, 160), (120, 160), (120, 160), (120, 160)]
    """

    def __init__(
        self,
        world: WorldName = "driving",
        sensor: Sensor = "stereo",
        *,
        n_frames: int = 100,
        seed: int = 0,
        scale: float = 1.0,
        noise: SensorNoise | None = None,
    ) -> None:
        _check(world, sensor, n_frames, seed, scale)
        setting = _WORLDS[world]
        self._world, self._sensor, self._seed = world, sensor, seed
        self._camera = _scale(setting.camera, scale)
        self._baseline = setting.baseline
        self._noise = noise or SensorNoise(max_depth_m=setting.max_depth_m)
        frames = np.arange(n_frames, dtype=np.int64)
        self._elapsed_ns: IntArray = frames * 1_000_000_000 // setting.rate_hz
        self._T_map_cam = setting.move(np.asarray(1e-9 * self._elapsed_ns, dtype=np.float64))
        built = setting.build(seed)
        self._stage = built if isinstance(built, Stage) else Stage(scene=built)

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        left = Calibration.from_camera(self._camera)
        right = Calibration.from_camera(self._camera, baseline=self._baseline)
        return RecordingInfo(
            name=f"{self._world}-{self._sensor}",
            sensor=self._sensor,
            calibrations=(left, right) if self._sensor == "stereo" else (left,),
            n_images=len(self._elapsed_ns),
            decisions=[f"rendered: world {self._world}, seed {self._seed}"],
        )

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
        return Trajectory(stamps_ns=_START_NS + self._elapsed_ns, T_world_cam=T_world_cam)

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
            Metres along the optical axis at the centre of each pixel; of a mirror what is seen in
            it for stereo, its glass for RGB-D.
        """
        T_map_cam, camera = self._view(index, stream)
        is_reflected = self._sensor == "stereo"
        return self._stage.render_depth(
            self._elapsed_s(index), T_map_cam, camera, is_reflected=is_reflected
        )

    def _elapsed_s(self, index: int) -> float:
        return 1e-9 * float(self._elapsed_ns[index])

    def _view(self, index: int, stream: int) -> tuple[FloatArray, PinholeCamera]:
        """Return pose and camera of a stream; the depth camera is the colour camera."""
        if stream == 0 or self._sensor == "rgbd":
            return self._T_map_cam[index], self._camera
        T_left_right = make_transform(np.eye(3), np.array([self._baseline, 0.0, 0.0]))
        shifted = replace(self._camera, cx=self._camera.cx - self._noise.disparity_offset_px)
        return self._T_map_cam[index] @ T_left_right, shifted

    def _load(self, index: int, stream: int) -> NDArray[Any]:
        rng = np.random.default_rng([self._seed, index, stream])
        if stream == 1 and self._sensor == "rgbd":
            return spoil_depth(self.render_depth(index), self._noise, rng)
        return self._load_image(index, stream, rng)

    def _load_image(self, index: int, stream: int, rng: np.random.Generator) -> ImageArray:
        T_map_cam, camera = self._view(index, stream)
        elapsed_s = self._elapsed_s(index)
        grey = self._stage.render_image(elapsed_s, T_map_cam, camera)
        return to_uint8(expose(grey, self._noise, rng, stream=stream, elapsed_s=elapsed_s))


def _check(world: str, sensor: str, n_frames: int, seed: int, scale: float) -> None:
    if world not in _WORLDS:
        raise ValueError(f"world must be one of {sorted(_WORLDS)}, got {world!r}")
    if sensor not in get_args(Sensor):
        raise ValueError(f"sensor must be one of {sorted(get_args(Sensor))}, got {sensor!r}")
    if n_frames < 1 or seed < 0:
        raise ValueError(f"n_frames must be positive, seed not negative: {n_frames}, {seed}")
    if not 0.05 <= scale <= 4.0:
        raise ValueError(f"scale must be in [0.05, 4], got {scale}")


def _scale(camera: PinholeCamera, scale: float) -> PinholeCamera:
    """Return the camera with images of another size; pixel (0, 0) stays the first's centre."""
    return PinholeCamera(
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=scale * (camera.cx + 0.5) - 0.5,
        cy=scale * (camera.cy + 0.5) - 0.5,
        width=round(scale * camera.width),
        height=round(scale * camera.height),
    )
