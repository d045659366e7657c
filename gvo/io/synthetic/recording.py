"""Rendered recordings, and the noise of their sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.geometry.se3 import invert, make_transform
from gvo.io.recording import RecordingInfo, Sensor, StampedImage
from gvo.io.synthetic.moving_scene import MovingScene
from gvo.io.synthetic.rendering import scale_camera, to_uint8
from gvo.io.synthetic.scene import Scene
from gvo.io.synthetic.worlds import deceptive, motion, room, street
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, DepthArray, FloatArray, IntArray

_EXPOSURE_PERIOD_S = 7.3
_BLOB_PX = 14
_STEP_SHARE = 0.03
WorldName: TypeAlias = Literal[
    "driving", "handheld", "turning", "hovering", "traffic", "facade", "mirror", "wall", "block",
    "rooms",
]  # fmt: skip
_START_NS = 1_700_000_000_000_000_000


class SyntheticRecording:
    """A recording rendered frame by frame when its images are loaded.

    Frames do not depend on one another, nor on `n_frames`: the same seed gives the same bytes,
    in any order and from several threads.

    Parameters
    ----------
    world : {"driving", "handheld", "turning", "hovering", "traffic", "facade", "mirror", "wall", \
             "block", "rooms"}
        `driving`: around a block of houses with KITTI's cameras at 10 Hz. `handheld`: a camera
        held in the hand in a furnished room, 640 x 480 at 30 Hz. `turning`: the same, turned to
        and fro at up to 85 deg/s. `hovering`: a drone there that flies for 2 s to another place,
        comes to rest but for a few millimetres, and flies on 3 s later. Seeds of these two move
        in different ways. The others deceive, each with the cameras of one of these. `traffic`:
        the car halts, and a bus fills two thirds of the image; from 3 to 10 s. `facade`: sideways
        along a house whose windows repeat exactly, by more than half a window per frame. `mirror`:
        the room with a large mirror that swings: what is seen in it moves as one. A stereo camera
        sees the virtual room behind the glass; the depth of an RGB-D camera is that of the glass,
        as of dusty ones, while its image shows what is reflected. `wall`: the hand turns to a
        wall of one grey, which fills the image from 3.8 to 7.0 s, and turns back. Two are for
        loops. `block`: the car closes its lap of 400 m, drives 80 m of it again, turns and comes
        back in the other lane, 570 m in 60 s; the houses, trees and posts of one side of the block
        stand again along its opposite side, and look the same to who drives there. `rooms`: the
        hand walks through three rooms furnished alike, along the corridor between them, in 36 s.
    sensor : {"stereo", "rgbd"}
    n_frames : int
        Length; the drive closes its lap of 400 m after about 480 frames.
    seed : int
        Of scene and noise, not negative.
    scale : float
        Size of the images relative to the full one; the intrinsics follow.
    noise : SensorNoise, optional
        Default: `SensorNoise()`, for driving with depth up to 80 m.
    readout_ms : float
        A rolling shutter: milliseconds from the first row to the one after the last. Row v of a
        frame is seen from the pose at its stamp + readout_ms * (v / height - 1/2), in both images
        of a stereo camera; stamps and ground truth are those of the middle row. Depth is that of
        what the pixel of the colour image shows, as of a driver that registers it perfectly, along
        the axis of the row's pose. What moves in a world stands still during the readout. 0: all
        rows at once.

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
        world: WorldName = "driving",
        sensor: Sensor = "stereo",
        *,
        n_frames: int = 100,
        seed: int = 0,
        scale: float = 1.0,
        noise: SensorNoise | None = None,
        readout_ms: float = 0.0,
    ) -> None:
        _check(world, sensor, n_frames, seed, scale)
        setting = _WORLDS[world]
        frame_ms = 1e3 / setting.rate_hz
        if not 0.0 <= readout_ms <= frame_ms:
            raise ValueError(f"readout_ms must be in [0, {frame_ms:.1f}], got {readout_ms}")
        self._readout_s, self._move = 1e-3 * readout_ms, setting.motion(seed)
        self._world, self._sensor, self._seed = world, sensor, seed
        self._camera = scale_camera(setting.camera, scale)
        self._baseline = setting.baseline
        self._noise = noise or SensorNoise(max_depth_m=setting.max_depth_m)
        frames = np.arange(n_frames, dtype=np.int64)
        self._elapsed_ns: IntArray = frames * 1_000_000_000 // setting.rate_hz
        self._T_map_cam = self._move(np.asarray(1e-9 * self._elapsed_ns, dtype=np.float64))
        built = setting.build(seed)
        self._moving_scene = built if isinstance(built, MovingScene) else MovingScene(scene=built)

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
            the pose of its row; of a mirror what is seen in it for stereo, its glass for RGB-D.
        """
        T_map_cam, camera = self._view(index, stream)
        is_reflected = self._sensor == "stereo"
        return self._moving_scene.render_depth(
            self._elapsed_s(index), T_map_cam, camera, is_reflected=is_reflected
        )

    def _elapsed_s(self, index: int) -> float:
        return 1e-9 * float(self._elapsed_ns[index])

    def _view(self, index: int, stream: int) -> tuple[FloatArray, PinholeCamera]:
        """Return pose or poses and camera of a stream; the depth camera is the colour camera."""
        T_map_cam = self._poses(index)
        if stream == 0 or self._sensor == "rgbd":
            return T_map_cam, self._camera
        T_left_right = make_transform(np.eye(3), np.array([self._baseline, 0.0, 0.0]))
        shifted = replace(self._camera, cx=self._camera.cx - self._noise.disparity_offset_px)
        return T_map_cam @ T_left_right, shifted

    def _poses(self, index: int) -> FloatArray:
        """Return the pose of a frame, shape (4, 4), or those of its rows, (height, 4, 4)."""
        if self._readout_s == 0.0:
            return np.asarray(self._T_map_cam[index])
        height = self._camera.height
        rows_s = self._readout_s * (np.arange(height) / height - 0.5)
        return self._move(self._elapsed_s(index) + rows_s)

    def _load(self, index: int, stream: int) -> NDArray[Any]:
        rng = np.random.default_rng([self._seed, index, stream])
        if stream == 1 and self._sensor == "rgbd":
            return spoil_depth(self.render_depth(index), self._noise, rng)
        T_map_cam, camera = self._view(index, stream)
        elapsed_s = self._elapsed_s(index)
        grey = self._moving_scene.render_image(elapsed_s, T_map_cam, camera)
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


# T_map_cam (n, 4, 4) of seconds since the start (n,).
_Motion: TypeAlias = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class _World:
    """A scene and a motion through it, by their seed, and the cameras that fit."""

    build: Callable[[int], Scene | MovingScene]
    motion: Callable[[int], _Motion]
    camera: PinholeCamera
    baseline: float
    rate_hz: int
    max_depth_m: float


_by_car = partial(
    _World,
    camera=PinholeCamera(
        fx=707.0912, fy=707.0912, cx=601.8873, cy=183.1104, width=1226, height=370
    ),
    baseline=0.53715,
    rate_hz=10,
    max_depth_m=80.0,
)
_by_hand = partial(
    _World,
    camera=PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480),
    baseline=0.11,
    rate_hz=30,
    max_depth_m=8.0,
)


def _always(move: _Motion) -> Callable[[int], _Motion]:
    """Return the same motion for all seeds."""
    return lambda _: move


def _by_seed(move: Callable[[int, FloatArray], FloatArray]) -> Callable[[int], _Motion]:
    """Return the motion of each seed."""
    return lambda seed: partial(move, seed)


_WORLDS = {
    "driving": _by_car(street.street, _always(motion.drive)),
    "handheld": _by_hand(room.room, _always(motion.look_around)),
    "turning": _by_hand(room.room, _by_seed(motion.turn_fast)),
    "hovering": _by_hand(room.room, _by_seed(motion.hover)),
    "traffic": _by_car(deceptive.traffic, _always(deceptive.traffic_drive)),
    "facade": _by_car(deceptive.facade, _always(deceptive.ride)),
    "mirror": _by_hand(deceptive.mirror_room, _always(motion.look_around)),
    "wall": _by_hand(deceptive.blank_room, _always(deceptive.turn_away)),
    "block": _by_car(street.block, _by_seed(motion.drive_block)),
    "rooms": _by_hand(deceptive.rooms, _by_seed(deceptive.walk)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Noise and limits of the sensor.

    Parameters
    ----------
    grey_sigma : float
        Gaussian noise of each pixel, grey values.
    exposure_drift : float
        Amplitude of the brightness that comes and goes within seconds, relative.
    exposure_mismatch : float
        How much brighter the right image is, relative.
    disparity_offset_px : float
        What the calibration does not know: the right image's principal point is shifted to
        the left by so much, and every disparity is larger.
    depth_sigma : float
        Gaussian noise of the inverse depth, 1/m: sigma_z = depth_sigma * z^2.
    depth_step : float
        Quantum of the inverse depth, 1/m; 0: none.
    hole_share : float
        Share of the depth image that is lost in blobs.
    edge_radius_px : int
        Depth is lost so far around steps of more than 3 %, pixels; 0: nowhere.
    min_depth_m, max_depth_m : float
        Depth out of this range is unknown.
    """

    grey_sigma: float = 2.0
    exposure_drift: float = 0.05
    exposure_mismatch: float = 0.02
    disparity_offset_px: float = 0.0
    depth_sigma: float = 0.0014
    depth_step: float = 0.002
    hole_share: float = 0.02
    edge_radius_px: int = 1
    min_depth_m: float = 0.4
    max_depth_m: float = 8.0

    def __post_init__(self) -> None:
        """Refuse what no sensor has."""
        sizes = (self.grey_sigma, self.depth_sigma, self.depth_step, self.edge_radius_px)
        if min(sizes) < 0 or not 0 <= self.hole_share < 1:
            raise ValueError(f"sigmas must not be negative, shares in [0, 1): {self}")

    @classmethod
    def none(cls) -> SensorNoise:
        """Return a perfect sensor."""
        return cls(
            grey_sigma=0.0,
            exposure_drift=0.0,
            exposure_mismatch=0.0,
            depth_sigma=0.0,
            depth_step=0.0,
            hole_share=0.0,
            edge_radius_px=0,
            min_depth_m=0.0,
            max_depth_m=np.inf,
        )


def expose(
    grey: DepthArray, noise: SensorNoise, rng: np.random.Generator, *, stream: int, elapsed_s: float
) -> DepthArray:
    """Return grey values with the brightness of the moment, and noise.

    Parameters
    ----------
    grey : ndarray of float32, shape (height, width)
    noise : SensorNoise
    rng : Generator
    stream : int
        1 is the right image.
    elapsed_s : float
        Since the start of the recording.
    """
    gain = 1.0 + noise.exposure_drift * np.sin(2 * np.pi * elapsed_s / _EXPOSURE_PERIOD_S)
    if stream == 1:
        gain *= 1.0 + noise.exposure_mismatch
    exposed = grey * np.float32(gain)
    if noise.grey_sigma > 0:
        white = rng.standard_normal(grey.shape, dtype=np.float32)
        exposed += np.float32(noise.grey_sigma) * white
    return exposed


def spoil_depth(depth: DepthArray, noise: SensorNoise, rng: np.random.Generator) -> DepthArray:
    """Return depth as a structured-light camera measures it: inverse, in steps, with holes.

    Parameters
    ----------
    depth : ndarray of float32, shape (height, width)
        Exact, metres.
    noise : SensorNoise
    rng : Generator

    Returns
    -------
    ndarray of float32, shape (height, width)
        Metres, NaN = unknown.

    References
    ----------
    K. Khoshelham, S. O. Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 12(2), 2012, doi:10.3390/s120201437.
    """
    white = rng.standard_normal(depth.shape, dtype=np.float32)
    inverse_depths = 1.0 / depth + np.float32(noise.depth_sigma) * white
    if noise.depth_step > 0:
        step = np.float32(noise.depth_step)
        inverse_depths = np.rint(inverse_depths / step) * step
    is_known = (depth >= noise.min_depth_m) & (depth <= noise.max_depth_m) & (inverse_depths > 0)
    if noise.hole_share > 0:
        is_known &= ~_blobs(depth.shape, noise.hole_share, rng)
    if noise.edge_radius_px > 0:
        is_known &= ~_edges(depth, noise.edge_radius_px)
    spoilt = np.full(depth.shape, np.nan, dtype=np.float32)
    spoilt[is_known] = 1.0 / inverse_depths[is_known]
    return spoilt


def _blobs(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> BoolArray:
    height, width = shape
    coarse = rng.standard_normal((height // _BLOB_PX + 2, width // _BLOB_PX + 2))
    field = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
    return np.asarray(field > np.quantile(field, 1.0 - share))


def _edges(depth: DepthArray, radius: int) -> BoolArray:
    """Tell where the depth jumps; the inverse depth of a plane is linear, so its Laplacian 0."""
    inverse_depths = np.nan_to_num(1.0 / depth, nan=0.0)
    curvature = np.abs(np.asarray(cv2.Laplacian(inverse_depths, cv2.CV_32F)))
    is_step = (curvature > _STEP_SHARE * inverse_depths).astype(np.uint8)
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(is_step, kernel)) > 0
