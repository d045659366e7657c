"""One recording in every container: ROS 1, ROS 2 in sqlite3 and MCAP, plain and compressed."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import gvo
from gvo.geometry.camera import Calibration
from gvo.geometry.lens import DistortionModel
from gvo.io.convert.convert import convert
from gvo.io.recording import Sensor, Source
from gvo.io.synthetic import SyntheticRecording
from gvo.types import FloatArray, RgbdFrame, StereoFrame
from tests.make.recordings import Held, hold

pytestmark = pytest.mark.acceptance

_CONTAINERS = {"a.bag": True, "a.mcap": False, "b.mcap": True, "folder": False}
"""Whether its images are PNG."""
_N_FRAMES = 6
_LENSES: dict[DistortionModel, list[float]] = {
    "plumb_bob": [-0.12, 0.03, 1e-3, -5e-4, 0.0],
    "rational_polynomial": [-0.2, 0.05, 5e-4, 5e-4, 0.01, -0.05, 0.02, 0.003],
    "equidistant": [-0.03, 0.01, -0.002, 0.0],
}
_EVERY = 3  # of the frames of the world, so that the camera moves between two of them


def _walk(sensor: Sensor) -> Held:
    source = SyntheticRecording("handheld", sensor, n_frames=_EVERY * _N_FRAMES, scale=0.35)
    return hold(source, every=_EVERY)


_STEREO, _RGBD = _walk("stereo"), _walk("rgbd")


def _raw_pair(model: DistortionModel) -> Held:
    """Return the pair as cameras with lenses, turned against each other, would see it."""
    turns = [0.01, -0.004, 0.006], [-0.006, 0.005, -0.01]
    pairs = zip(_STEREO.info.calibrations, turns, strict=True)
    cameras = tuple(_raw(ideal, model, turn) for ideal, turn in pairs)
    seen = replace(_STEREO, info=replace(_STEREO.info, calibrations=cameras))
    for stream, camera in enumerate(cameras):
        seen = seen.with_pixels(partial(_remapped, _distortion_maps(camera)), stream=stream)
    return seen


def _remapped(maps: tuple[NDArray[Any], NDArray[Any]], image: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC))


def _in_millimetres(depth: NDArray[Any]) -> NDArray[Any]:
    """Round depth to whole millimetres, as sensors give it."""
    return np.asarray(np.round(depth * 1000).astype(np.float32) / np.float32(1000))


def _raw(ideal: Calibration, model: DistortionModel, turn: list[float]) -> Calibration:
    """Return a camera whose rectified image is the ideal one, its view a little wider."""
    K = ideal.K * np.array([[0.9, 1, 1], [1, 0.9, 1], [1, 1, 1]])
    return replace(
        ideal,
        K=K,
        D=np.array(_LENSES[model]),
        R=np.asarray(Rotation.from_rotvec(turn).as_matrix()),
        is_rectified=False,
        model=model,
    )


def _distortion_maps(camera: Calibration) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where in the ideal image each raw pixel lies: the inverse of the rectification."""
    grid = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack(grid, axis=-1).reshape(-1, 2).astype(np.float64)
    rays: FloatArray = (
        np.linalg.inv(camera.K) @ np.column_stack([pixels, np.ones(len(pixels))]).T
    ).T
    for _ in range(50):
        errors = pixels - camera.lens.project(rays)
        rays[:, :2] += errors / np.diag(camera.K)[:2]
    assert np.abs(errors).max() < 1e-6
    u, v, w = camera.P[:, :3] @ camera.R @ rays.T
    shape = (camera.height, camera.width)
    return (u / w).astype(np.float32).reshape(shape), (v / w).astype(np.float32).reshape(shape)


def _frames(source: Source) -> list[tuple[int, bytes, bytes]]:
    found = []
    for frame in gvo.frames(source, gvo.Config()):
        if isinstance(frame, StereoFrame):
            found.append((frame.stamp_ns, frame.left.tobytes(), frame.right.tobytes()))
        else:
            assert isinstance(frame, RgbdFrame)
            found.append((frame.stamp_ns, frame.image.tobytes(), frame.depth.tobytes()))
    assert len(found) == _N_FRAMES
    return found


_SOURCES: dict[str, Source] = {
    "rectified": _STEREO,
    "raw": _raw_pair("plumb_bob"),
    "metres": _RGBD,
    "millimetres": _RGBD.with_pixels(_in_millimetres, stream=1),
}


@pytest.fixture(scope="module", params=sorted(_SOURCES))
def origin(request: pytest.FixtureRequest) -> tuple[Source, list[tuple[int, bytes, bytes]]]:
    """Return a recording and its frames."""
    source = _SOURCES[request.param]
    return source, _frames(source)


@pytest.mark.parametrize(("name", "is_png"), _CONTAINERS.items())
def test_every_container_gives_the_same_frames_and_cameras_bit_by_bit(
    origin: tuple[Source, list[tuple[int, bytes, bytes]]], tmp_path: Path, name: str, is_png: bool
) -> None:
    source, frames = origin
    convert(source, tmp_path / name, compress=is_png)
    copy = gvo.open_recording(tmp_path / name)
    assert _frames(copy) == frames
    for mine, theirs in zip(copy.info.calibrations, source.info.calibrations, strict=True):
        for matrix in "KDRP":
            np.testing.assert_array_equal(getattr(mine, matrix), getattr(theirs, matrix))
    with AnyReader([tmp_path / name]) as reader:
        suffixes = [topic.rpartition("/")[2] for topic in reader.topics]
    n_compressed = suffixes.count("compressed") + suffixes.count("compressedDepth")
    # Depth that is not of whole millimetres stays as it is.
    assert n_compressed == ((1 if source is _RGBD else 2) if is_png else 0)


@pytest.mark.parametrize("model", sorted(_LENSES))
def test_images_rectified_on_the_fly_are_those_rectified_beforehand(
    tmp_path: Path, model: DistortionModel
) -> None:
    raw = _raw_pair(model)
    convert(raw, tmp_path / "raw.mcap")
    convert(raw, tmp_path / "rectified.bag", rectify=True)
    on_the_fly, beforehand = (
        gvo.open_recording(tmp_path / name) for name in ("raw.mcap", "rectified.bag")
    )
    assert [each.info.calibrations[0].is_rectified for each in (on_the_fly, beforehand)] == [
        *(False, True),
    ]
    assert on_the_fly.info.camera == beforehand.info.camera
    assert _frames(on_the_fly) == _frames(beforehand)
