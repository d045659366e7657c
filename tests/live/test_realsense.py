"""A RealSense camera without hardware, fed to `gvo live -`."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gvo
from tests.conftest import GVO

pytestmark = pytest.mark.realsense
rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

SCRIPTS = Path(__file__).parents[2] / "scripts"
UNITS_M = 0.00025
N_FRAMES = 10
KINDS = {
    "rgbd": [(rs.stream.color, 0, rs.format.bgr8, 3), (rs.stream.depth, 0, rs.format.z16, 2)],
    "stereo": [(rs.stream.infrared, side, rs.format.y8, 1) for side in (1, 2)],
}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(SCRIPTS)
    import feed_realsense  # type: ignore[import-not-found]

    return feed_realsense


class Camera:
    """A device of software that shows a rendered room."""

    def __init__(self, script: Any, sensor: Any) -> None:
        self.source = gvo.SyntheticRecording("handheld", sensor, n_frames=N_FRAMES, scale=0.5)
        self._device, self._pipeline = rs.software_device(), rs.pipeline()
        self._shown = [self._add(uid, *kind) for uid, kind in enumerate(KINDS[sensor])]
        camera, across = self.source.info.camera, rs.extrinsics()
        baseline = camera.baseline if isinstance(camera, gvo.StereoCamera) else 0.0
        across.rotation, across.translation = np.eye(3).ravel().tolist(), [-baseline, 0.0, 0.0]
        first, second = (profile for _, profile, _ in self._shown)
        first.register_extrinsics_to(second, across)
        self._device.create_matcher(rs.matchers.dlr_c)
        self._pipeline.set_device(self._device)
        self.profile = script.start(self._pipeline, sensor, (camera.width, camera.height), 30)

    def _add(self, uid: int, stream: Any, index: int, format_: Any, n_bytes: int) -> Any:
        camera, found, video = self.source.info.camera, rs.intrinsics(), rs.video_stream()
        found.width, found.height = camera.width, camera.height
        found.fx, found.fy, found.ppx, found.ppy = camera.fx, camera.fy, camera.cx, camera.cy
        found.model, found.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        video.type, video.index, video.uid, video.fps = stream, index, uid, 30
        video.fmt, video.bpp, video.intrinsics = format_, n_bytes, found
        video.width, video.height = camera.width, camera.height
        sensor = self._device.add_sensor(f"sensor {uid}")
        if stream == rs.stream.depth:
            sensor.add_read_only_option(rs.option.depth_units, UNITS_M)
        return sensor, sensor.add_video_stream(video, True), n_bytes

    def framesets(self) -> Iterator[Any]:
        """Yield what the device gives for each rendered frame."""
        for number, frame in enumerate(gvo.frames(self.source)):
            images = (
                (frame.left, frame.right)
                if isinstance(frame, gvo.StereoFrame)
                else (np.dstack([frame.image] * 3), counts(frame.depth))  # type: ignore[union-attr]
            )
            for (sensor, profile, n_bytes), pixels in zip(self._shown, images, strict=True):
                shown = rs.software_video_frame()
                shown.pixels, shown.bpp = np.ascontiguousarray(pixels), n_bytes
                shown.stride, shown.frame_number = n_bytes * pixels.shape[1], number + 1
                shown.timestamp = 1e-6 * frame.stamp_ns
                shown.domain, shown.depth_units = rs.timestamp_domain.system_time, UNITS_M
                shown.profile = profile.as_video_stream_profile()
                sensor.on_video_frame(shown)
            yield self._pipeline.wait_for_frames(60_000)


def counts(depth: Any) -> Any:
    return np.nan_to_num(np.rint(depth / UNITS_M)).astype(np.uint16)


@pytest.fixture(params=["rgbd", "stereo"])
def camera(script: Any, request: pytest.FixtureRequest) -> Camera:
    return Camera(script, request.param)


def test_the_calibration_is_that_of_the_device(camera: Camera, script: Any, tmp_path: Path) -> None:
    info = camera.source.info
    content = script.calibration(camera.profile, info.sensor)
    (tmp_path / "camera.yaml").write_text(json.dumps(content))
    rig = gvo.Rig(tmp_path / "camera.yaml", sensor=info.sensor)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(rig.camera, name) == pytest.approx(getattr(info.camera, name))
    if isinstance(info.camera, gvo.StereoCamera):
        assert isinstance(rig.camera, gvo.StereoCamera)
        assert rig.camera.baseline == pytest.approx(info.camera.baseline)
    else:
        assert rig.depth_scale == pytest.approx(1.0 / UNITS_M)


@pytest.mark.acceptance
def test_what_the_device_sees_is_tracked(
    camera: Camera, script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor, path, out = camera.source.info.sensor, tmp_path / "camera.yaml", tmp_path / "out"
    path.write_text(json.dumps(script.calibration(camera.profile, sensor)))
    options = ["--sensor", sensor, "--calibration", path, "--queue=1000", "--no-report"]
    command = [*GVO, "live", "-", *map(str, options), f"--out={out}"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        monkeypatch.setattr(sys, "stdout", SimpleNamespace(buffer=process.stdin))
        # One that did not change is waited for, too, as where two rates differ.
        script.feed(each for each in camera.framesets() for _ in range(2))
        answer, errors = process.communicate()
    assert process.returncode == 0, errors
    assert f"{N_FRAMES} frames, all tracked".encode() in answer
    poses = gvo.read_trajectory(out / "smoothed.txt")
    assert gvo.evaluate(camera.source.ground_truth(), poses, name=sensor).ate_m < 0.02
