"""What every recording gives: two streams of raw images, their calibrations, the truth.

A source knows files or messages, nothing of pairing or rectification. `frames` is the one
way from any source to frames: pair by stamp, decode, check, make grey, rectify.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from gvo.geometry.camera import Calibration, PinholeCamera, StereoCamera, stereo_camera
from gvo.geometry.imu import ImuStream
from gvo.geometry.rig import LearntRig
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, ImageArray

Sensor = Literal["stereo", "rgbd"]

OTHER_SIZE = (
    "give that of these images by --calibration FILE, unless they were cut out of larger ones"
)
"""What to do where a camera is calibrated for images of another size."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StampedImage:
    """An image of one stream, not decoded yet.

    Parameters
    ----------
    stream : int
        0: left or colour; 1: right or depth.
    stamp_ns : int
        Of the header, nanoseconds.
    load : callable
        Returns the raw pixels: uint8 (h, w) grey or (h, w, 3) in BGR order; depth as float32
        metres (h, w), NaN = unknown. Raises `RecordingError` where the image is faulty.
    log_time_ns : int, optional
        When it was recorded, by the recording's own clock; None where there is no such clock.
    n_bytes : int
        Memory that it holds until it is loaded, where that is known.
    """

    stream: int
    stamp_ns: int
    load: Callable[[], NDArray[Any]]
    log_time_ns: int | None = None
    n_bytes: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """The camera that sees the depth, where that is not the colour camera.

    Parameters
    ----------
    calibration : Calibration
        Of the depth images.
    T_color_depth : ndarray of float64, shape (4, 4)
        Maps coordinates of the rectified depth camera to the rectified colour camera, metres.
    """

    calibration: Calibration
    T_color_depth: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordingInfo:
    """What a source found out before the first image.

    Parameters
    ----------
    name : str
        Of the folder or file.
    sensor : {"stereo", "rgbd"}
    calibrations : tuple of Calibration
        Of stream 0 and, for stereo, of stream 1.
    n_images : int
        Announced images of stream 0.
    decisions : list of str
        What was chosen and why, a line each.
    depth_view : DepthView, optional
        Of depth that is not registered to colour; None where each pixel of depth belongs to that
        of the colour image.
    frame_id : str
        Name of stream 0's camera frame in `/tf`; empty where the recording names none.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the rectified camera to the body the calibration names, metres.
    rig : LearntRig, optional
        What an earlier run learnt of the camera.
    masks : tuple of ndarray of uint8, shape (h, w)
        Of the raw left and right images, or of the colour images: 0 = not used; empty for none.
    imu : ImuStream, optional
        The IMU beside the camera.
    """

    name: str
    sensor: Sensor
    calibrations: tuple[Calibration, ...]
    n_images: int
    decisions: list[str] = field(default_factory=list)
    depth_view: DepthView | None = None
    frame_id: str = ""
    T_body_cam: FloatArray | None = None
    rig: LearntRig | None = None
    masks: tuple[ImageArray, ...] = ()
    imu: ImuStream | None = None

    def __repr__(self) -> str:
        """Return one line: name, sensor, number and size of the images."""
        first = self.calibrations[0]
        images = f"{self.n_images} images of {first.width}x{first.height}"
        return f"RecordingInfo({self.name}: {self.sensor}, {images})"

    @property
    def stream_names(self) -> tuple[str, str]:
        """What stream 0 and 1 are called in messages."""
        return ("left", "right") if self.sensor == "stereo" else ("colour", "depth")

    @property
    def doubt(self) -> str:
        """Why a camera seems to be calibrated for images of another size; empty for none."""
        depth = None if self.depth_view is None else self.depth_view.calibration
        views = zip(self.stream_names, (*self.calibrations, depth), strict=False)
        return next((f"{name}: {v.doubt}" for name, v in views if v and v.doubt), "")

    @property
    def camera(self) -> StereoCamera | PinholeCamera:
        """The camera of the rectified frames."""
        is_stereo = self.sensor == "stereo"
        camera = stereo_camera(*self.calibrations) if is_stereo else self.calibrations[0].pinhole()
        return replace(camera, rig=self.rig)


class Source(Protocol):
    """A recording on disk."""

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both streams in the order of the recording."""

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of stream 0's rectified camera, where the recording holds it."""


def shown(source: Source) -> str:
    """Return a source as one line: name, sensor, number and size of the images."""
    return repr(source.info).replace(RecordingInfo.__name__, type(source).__name__, 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChosenImages:
    """Some images of a recording, or changed ones, as a recording without ground truth.

    Parameters
    ----------
    info : RecordingInfo
    images : callable
        Yields them in the order of the recording.
    camera_info_changes : mapping of str to int, optional
        As of `BagSource`; None where the recording has no `CameraInfo`.
    """

    info: RecordingInfo
    images: Callable[[], Iterator[StampedImage]]
    camera_info_changes: Mapping[str, int] | None = None

    def ground_truth(self) -> Trajectory | None:
        """Return nothing."""
        return None
