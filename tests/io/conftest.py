"""Tiny recordings, made by hand."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.types import FaultyFrame, Frame, StereoFrame
from tests.make.recordings import Held, Item, held

_WIDTH, _HEIGHT = 48, 32


class Tiny:
    """Makers of small images, folders and sources."""

    size = (_WIDTH, _HEIGHT)
    camera = PinholeCamera(fx=50.0, fy=50.0, cx=23.5, cy=15.5, width=_WIDTH, height=_HEIGHT)

    def texture(self, seed: int, *, is_color: bool = False) -> NDArray[np.uint8]:
        shape = (_HEIGHT, _WIDTH, 3) if is_color else (_HEIGHT, _WIDTH)
        return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)

    def counts(self, seed: int) -> NDArray[np.uint16]:
        """Return depth of 1 to 3 m at 5000 counts per metre, with two holes."""
        rng = np.random.default_rng(seed)
        values = rng.integers(5000, 15000, (_HEIGHT, _WIDTH), dtype=np.uint16)
        values[0, :2] = 0, 65535
        return values

    def depth(self, seed: int) -> NDArray[np.float32]:
        depth = self.counts(seed).astype(np.float32) / np.float32(5000)
        depth[0, :2] = np.nan
        return depth

    def stereo(self, items: Sequence[Item], **options: Any) -> Held:
        left = Calibration.from_camera(self.camera)
        right = Calibration.from_camera(self.camera, baseline=0.5)
        return held("stereo", items, **({"calibrations": (left, right)} | options))

    def rgbd(self, items: Sequence[Item], **options: Any) -> Held:
        calibration = Calibration.from_camera(self.camera)
        return held("rgbd", items, **({"calibrations": (calibration,)} | options))

    def ros_camera(self, **changes: object) -> dict[str, object]:
        """Return a calibration in the form of ROS; keys of value None are left out."""
        content: dict[str, object] = {
            "image_width": _WIDTH,
            "image_height": _HEIGHT,
            "camera_matrix": {"rows": 3, "cols": 3, "data": self.camera.K.ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        }
        return {key: value for key, value in (content | changes).items() if value is not None}

    def ros_pair(self, baseline: float = 1.0) -> dict[str, object]:
        P = [50.0, 0, 23.5, -50.0 * baseline, 0, 50.0, 15.5, 0, 0, 0, 1, 0]
        return {
            "left": self.ros_camera(),
            "right": self.ros_camera(projection_matrix={"data": P}),
        }

    def write_image(self, path: Path, pixels: NDArray[Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), pixels)

    def write_kitti(
        self, folder: Path, n_frames: int = 3, *, cameras: Sequence[int] = (0, 1)
    ) -> Path:
        """Write a KITTI folder; cameras 2 and 3 are in colour and set off from camera 0."""
        offsets = {0: (0, 0, 0), 1: (-25, 0, 0), 2: (3, 0.1, 0.002), 3: (-22, 0.1, 0.002)}
        rows = {
            camera: np.hstack([self.camera.K, np.reshape(offset, (3, 1))]).ravel()
            for camera, offset in offsets.items()
        }
        lines = [f"P{camera}: {' '.join(map(repr, row.tolist()))}" for camera, row in rows.items()]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "calib.txt").write_text("\n".join(lines) + "\n")
        (folder / "times.txt").write_text("".join(f"{0.1 * n:.6e}\n" for n in range(n_frames)))
        poses = [f"1 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in range(n_frames)]
        (folder / "poses.txt").write_text("".join(poses))
        for camera in cameras:
            for n in range(n_frames):
                pixels = self.texture(10 * n + camera, is_color=camera > 1)
                self.write_image(folder / f"image_{camera}" / f"{n:06d}.png", pixels)
        return folder

    def euroc_camera(self, T_body_cam: NDArray[Any], **changes: object) -> str:
        """Return the text of a `sensor.yaml`; keys of value None are left out."""
        camera = self.camera
        content: dict[str, object] = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": np.ravel(T_body_cam).tolist()},
            "resolution": list(self.size),
            "camera_model": "pinhole",
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [0.0, 0.0, 0.0, 0.0],
        }
        kept = {key: value for key, value in (content | changes).items() if value is not None}
        return yaml.safe_dump(kept)

    def write_euroc(self, folder: Path, stamps_ns: Sequence[int], sensors: Sequence[str]) -> Path:
        """Write an EuRoC folder with images of these stamps; a text of `sensor.yaml` a camera."""
        for n, sensor in enumerate(sensors):
            camera = folder / "mav0" / f"cam{n}"
            rows = ["#timestamp [ns],filename"]
            for k, stamp_ns in enumerate(stamps_ns):
                self.write_image(camera / "data" / f"{stamp_ns}.png", self.texture(10 * k + n))
                rows.append(f"{stamp_ns},{stamp_ns}.png")
            (camera / "data.csv").write_text("\r\n".join(rows) + "\r\n")
            (camera / "sensor.yaml").write_text(sensor)
        return folder

    def write_tum(self, folder: Path, color: Sequence[str], depth: Sequence[str]) -> Path:
        """Write a TUM folder with images of these stamps and a `calibration.yaml`."""
        for stream, stamps in (("rgb", color), ("depth", depth)):
            rows = [f"# {stream} images"]
            for n, stamp in enumerate(stamps):
                pixels = self.texture(n, is_color=True) if stream == "rgb" else self.counts(n)
                self.write_image(folder / stream / f"{stamp}.png", pixels)
                rows.append(f"{stamp} {stream}/{stamp}.png")
            (folder / f"{stream}.txt").write_text("\n".join(rows) + "\n")
        (folder / "calibration.yaml").write_text(yaml.safe_dump(self.ros_camera()))
        return folder

    def fingerprint(self, frame: Frame | FaultyFrame) -> tuple[object, ...]:
        """Return all that a frame holds, comparable bit by bit."""
        if isinstance(frame, FaultyFrame):
            return ("faulty", frame.stamp_ns, frame.reason)
        if isinstance(frame, StereoFrame):
            return ("stereo", frame.stamp_ns, frame.left.tobytes(), frame.right.tobytes())
        return ("rgbd", frame.stamp_ns, frame.image.tobytes(), frame.depth.tobytes())


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    """Return the makers of tiny recordings."""
    return Tiny()
