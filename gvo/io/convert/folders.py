"""Recordings written as folders in the layouts of KITTI, EuRoC and TUM."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.geometry.imu import Imu
from gvo.io.calibration.forms import IMU_DENSITIES, TIMESHIFT
from gvo.io.convert.plan import Form, pose_of_right, pose_on_body
from gvo.io.datasets.imu_table import write_imu_table
from gvo.io.datasets.tum import DEFAULT_SCALE
from gvo.io.frames import paired
from gvo.io.images import MAX_COUNT, MILLIMETRES, encode_image, is_in_counts, to_counts
from gvo.io.recording import Source, StampedImage
from gvo.trajectory.formats import write_euroc, write_kitti, write_tum
from gvo.trajectory.trajectory import Trajectory, format_stamp
from gvo.types import DepthArray, FaultyFrame, FloatArray

_EUROC_MODELS = {"plumb_bob": "radial-tangential"}
_SCALES = (MILLIMETRES, DEFAULT_SCALE)
# Half as far again as the first image shows must fit.
_RESERVE = 1.5


class KittiForm(Form):
    """Rectified pairs by number: `image_0` and `image_1`, in colour `image_2` and `image_3`.

    The stamp of a pair is that of the left image; unpaired images are left out.
    """

    holds_imu = False

    def __init__(self, path: Path, source: Source, **options: Any) -> None:  # noqa: ANN401
        super().__init__(path, source, **options)
        self._stamps_ns: list[int] = []
        self._folders: tuple[str, str] | None = None
        path.mkdir()

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of pairs, left before right; what cannot be read keeps its number."""
        for pair in paired(self.recorded(), self.info.sensor, self.sync):
            if isinstance(pair, FaultyFrame):
                self.leave_out(0, pair.stamp_ns, pair.reason)
            else:
                self._stamps_ns.append(pair[0].stamp_ns)
                yield from pair

    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write an image under the number of its pair."""
        if self._folders is None:
            self._folders = ("image_2", "image_3") if pixels.ndim == 3 else ("image_0", "image_1")
            for name in self._folders:
                (self.path / name).mkdir()
        number = len(self._stamps_ns) - 1
        path = self.path / self._folders[image.stream] / f"{number:06d}.png"
        path.write_bytes(encode_image(pixels, ".png"))

    def finish(self) -> None:
        """Write stamps, calibration, and a pose for each pair where all of them have one."""
        if self.truth is not None:
            self._write_truth(self.truth)
        times = "".join(f"{format_stamp(stamp_ns)}\n" for stamp_ns in self._stamps_ns)
        (self.path / "times.txt").write_text(times, encoding="utf-8")
        # P of left and right: `PN` of `image_N`.
        names = self._folders or ("image_0", "image_1")
        lines = [
            f"P{name[-1]}: {' '.join(map(repr, _numbers(calibration.P)))}\n"
            for name, calibration in zip(names, self.calibrations, strict=True)
        ]
        (self.path / "calib.txt").write_text("".join(lines), encoding="utf-8")

    def _write_truth(self, truth: Trajectory) -> None:
        at_frames = truth.interpolate(np.array(self._stamps_ns, dtype=np.int64))
        if len(at_frames) < len(self._stamps_ns):
            self.notes.append(
                f"poses.txt: {len(at_frames)} of {len(self._stamps_ns)} pairs lie between true "
                "poses, all are needed"
            )
            return
        # The layout's poses are those of the camera that P is stated for: P = K [I | t_cam_cam0].
        P = self.info.calibrations[0].P
        t_cam_cam0 = np.linalg.solve(P[:, :3], P[:, 3])
        T_cam_cam0 = se3.make_transform(np.eye(3), np.asarray(t_cam_cam0))
        write_kitti(self.path / "poses.txt", at_frames.transformed(T_cam_cam0))
        self.n_poses = len(at_frames)


class EurocForm(Form):
    """Pairs by stamp, raw or rectified, with the calibration of each camera.

    Where the recording does not place its cameras on a body, the rectified left camera is it. An
    IMU becomes `imu0`.
    """

    def __init__(self, path: Path, source: Source, **options: Any) -> None:  # noqa: ANN401
        super().__init__(path, source, **options)
        self._root = path / "mav0"
        self._tables: tuple[list[str], list[str]] = ([], [])
        T_body_cam = pose_on_body(self.source)
        self._T_body_cam = np.eye(4) if T_body_cam is None else T_body_cam
        for name in ("cam0", "cam1"):
            (self._root / name / "data").mkdir(parents=True)

    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write an image, and its row of the table."""
        name = f"{image.stamp_ns}.png"
        path = self._root / f"cam{image.stream}" / "data" / name
        path.write_bytes(encode_image(pixels, ".png"))
        self._tables[image.stream].append(f"{image.stamp_ns},{name}\n")

    def finish(self) -> None:
        """Write the tables of images, the calibrations, and the true poses of the body."""
        for stream, rows in enumerate(self._tables):
            camera = self._root / f"cam{stream}"
            text = "#timestamp [ns],filename\n" + "".join(rows)
            (camera / "data.csv").write_text(text, encoding="utf-8")
            written = self.calibrations[stream]
            T_left_rectified = pose_of_right(self.info) if stream == 1 else np.eye(4)
            T_rectified_written = se3.make_transform(written.R, np.zeros(3))
            T_body_written = self._T_body_cam @ T_left_rectified @ T_rectified_written
            _write_sensor_yaml(camera / "sensor.yaml", written, T_body_written)
        if self.info.imu is not None:
            folder = self._root / "imu0"
            folder.mkdir()
            write_imu_table(folder / "data.csv", self.imu_samples())
            _write_imu_yaml(folder / "sensor.yaml", self.info.imu.imu, self._T_body_cam)
        if self.truth is not None:
            folder = self._root / "state_groundtruth_estimate0"
            folder.mkdir()
            write_euroc(folder / "data.csv", self.truth.transformed(se3.invert(self._T_body_cam)))
            self.n_poses = len(self.truth)


class TumForm(Form):
    """Colour and depth by stamp, with `calibration.yaml`."""

    holds_imu = False

    def __init__(self, path: Path, source: Source, **options: Any) -> None:  # noqa: ANN401
        super().__init__(path, source, **options)
        self._tables: tuple[list[str], list[str]] = ([], [])
        self._scale: float | None = None
        self._n_cut = 0
        for name in ("rgb", "depth"):
            (path / name).mkdir(parents=True)

    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write an image, and its row of the table."""
        name = f"{('rgb', 'depth')[image.stream]}/{format_stamp(image.stamp_ns)}.png"
        if image.stream == 1:
            if self._scale is None:
                self._scale = _choose_scale(pixels)
            pixels, n_cut = to_counts(pixels, self._scale or DEFAULT_SCALE)
            self._n_cut += n_cut
        (self.path / name).write_bytes(encode_image(pixels, ".png"))
        self._tables[image.stream].append(f"{format_stamp(image.stamp_ns)} {name}\n")

    def finish(self) -> None:
        """Write the tables of images, the calibration and the true poses."""
        scale = self._scale or DEFAULT_SCALE
        for name, rows in zip(("rgb", "depth"), self._tables, strict=True):
            text = f"# {name} images\n# stamp filename\n" + "".join(rows)
            (self.path / f"{name}.txt").write_text(text, encoding="utf-8")
        path = self.path / "calibration.yaml"
        _write_camera_info_yaml(path, self.calibrations[0], depth_scale=scale)
        if self._n_cut:
            self.notes.append(
                f"depth: {self._n_cut} pixels beyond {MAX_COUNT / scale:.1f} m became unknown"
            )
        if self.truth is not None:
            write_tum(self.path / "groundtruth.txt", self.truth)
            self.n_poses = len(self.truth)


def _choose_scale(depth: DepthArray) -> float | None:
    """Return counts per metre: those that the depth was made of, where it shows them."""
    if not np.any(np.isfinite(depth)):
        return None
    for scale in _SCALES:
        if is_in_counts(depth, scale):
            return scale
    farthest = _RESERVE * float(np.nanmax(depth))
    return DEFAULT_SCALE if DEFAULT_SCALE * farthest < MAX_COUNT else MILLIMETRES


def _write_sensor_yaml(path: Path, calibration: Calibration, T_body_sensor: FloatArray) -> None:
    """Write the `sensor.yaml` of one camera of an EuRoC folder, as its images are written."""
    K = calibration.K
    content: dict[str, Any] = {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": _numbers(T_body_sensor)},
        "resolution": [calibration.width, calibration.height],
        "camera_model": "pinhole",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "distortion_model": _EUROC_MODELS.get(calibration.model, calibration.model),
        "distortion_coefficients": _numbers(calibration.D),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _write_imu_yaml(path: Path, imu: Imu, T_body_cam: FloatArray) -> None:
    """Write the `sensor.yaml` of an IMU, and Kalibr's time shift; null where it is not known."""
    content: dict[str, Any] = {"sensor_type": "imu"}
    if imu.T_camera_imu is not None:
        T_body_imu = T_body_cam @ imu.T_camera_imu
        content["T_BS"] = {"cols": 4, "rows": 4, "data": _numbers(T_body_imu)}
    content |= {key: float(getattr(imu, name)) for name, key in IMU_DENSITIES.items()}
    content[TIMESHIFT] = None if imu.delay_s is None else 0.0 - imu.delay_s
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _write_camera_info_yaml(path: Path, calibration: Calibration, *, depth_scale: float) -> None:
    """Write a calibration as ROS's camera_calibration does, with the depth's counts per metre."""
    D = calibration.D
    content = {
        "image_width": calibration.width,
        "image_height": calibration.height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": _numbers(calibration.K)},
        "distortion_model": calibration.model,
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": _numbers(D)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": _numbers(calibration.R)},
        "projection_matrix": {"rows": 3, "cols": 4, "data": _numbers(calibration.P)},
        "depth_scale": depth_scale,
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _numbers(values: FloatArray) -> list[float]:
    return [float(value) for value in np.ravel(values)]
