"""Configurations, settings and calibrations: YAML that is nearly right."""

from functools import cache
from pathlib import Path

import numpy as np

from gvo.config import Config, describe_configuration, load_configuration
from gvo.errors import GvoError
from gvo.io.calibration.files import read_cameras
from gvo.io.recording import Sensor
from gvo.types import FloatArray
from tests.fuzz.mutations import mutate_text
from tests.fuzz.target import Folder, Target
from tests.fuzz.texts import CALIBRATION, SENSOR

_KALIBR = b"""cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
cam1:
  T_cn_cnm1:
    - [1.0, 0.0, 0.0, -0.11]
    - [0.0, 1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0, 0.0]
    - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: equidistant
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
"""
_OPENCV = b"""%YAML:1.0
---
LEFT.height: 480
LEFT.width: 752
LEFT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.28, 0.07, 0.0002, 1.8e-05, 0.0]
LEFT.K: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [458, 0, 367, 0, 457, 248, 0, 0, 1]}
RIGHT.height: 480
RIGHT.width: 752
RIGHT.K: &k !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [458, 0, 367, 0, 457, 248, 0, 0, 1]}
RIGHT.P: !!opencv-matrix {data: [458, 0, 367, -47, 0, 457, 248, 0, 0, 0, 1, 0]}
"""
_INFO = b"""width: 8
height: 6
distortion_model: plumb_bob
k: [8, 0, 4, 0, 8, 3, 0, 0, 1]
d: [0.1, 0, 0, 0, 0]
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [8, 0, 4, 0, 0, 8, 3, 0, 0, 0, 1, 0]
binning_x: 2
roi: {x_offset: 1, y_offset: 1, width: 4, height: 4}
depth_scale: 5000
---
width: 9
"""


_USES: tuple[tuple[Sensor, bool], ...] = (
    ("stereo", False),
    ("stereo", True),
    ("rgbd", False),
    ("rgbd", True),
)


@cache
def _folder() -> Folder:
    return Folder()


def _file(data: bytes) -> Path:
    return _folder().write("file.yaml", data)


def _configuration(data: bytes) -> None:
    describe_configuration(load_configuration(_file(data)))


def _settings(data: bytes) -> None:
    texts = data.decode(errors="surrogateescape").split("\n")
    describe_configuration(load_configuration(None, texts))


def _calibration(data: bytes) -> None:
    path = _file(data)
    refusals = []
    for sensor, is_rectified in _USES:
        try:
            cameras = read_cameras(path, sensor=sensor, is_rectified=is_rectified)
        except GvoError as error:
            refusals.append(error)
        else:
            _check_finite([camera.P for camera in cameras.calibrations])
    if len(refusals) == len(_USES):
        raise refusals[0]


def _check_finite(matrices: list[FloatArray]) -> None:
    if not all(np.all(np.isfinite(matrix)) for matrix in matrices):
        raise AssertionError("a calibration that is not finite was taken")


def _whole_configuration() -> bytes:
    lines = describe_configuration(Config()).splitlines()
    return "\n".join(line.partition("  #")[0].rstrip() for line in lines).encode()


TARGETS = (
    Target(
        name="configurations",
        run=_configuration,
        seeds=lambda: [b"images:\n  black: 3\nwindow: {size: 4}\n", _whole_configuration()[:2000]],
        mutate=mutate_text,
    ),
    Target(
        name="settings",
        run=_settings,
        seeds=lambda: [b"window.n_links=3", b"klt.n_corners=300\nsync.stamps=recording"],
        mutate=mutate_text,
    ),
    Target(
        name="calibrations",
        run=_calibration,
        seeds=lambda: [CALIBRATION, SENSOR % b"0", _KALIBR, _OPENCV, _INFO],
        mutate=mutate_text,
    ),
)
