"""Recordings as folders in the ASL layout of the EuRoC MAV data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvo.geometry import se3
from gvo.outputs.conversion import LeftOut, pose_on_body
from gvo.outputs.folder_calibrations import write_sensor_yaml
from gvo.outputs.folder_streams import FolderStreams
from gvo.outputs.image_files import encode_png
from gvo.sources.recording import Source, StampedImage
from gvo.trajectory.formats import write_euroc
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray


class EurocFolder(FolderStreams):
    """Pairs by stamp, raw or rectified, with the calibration of each camera.

    Parameters
    ----------
    folder : Path
        To be made.
    source : Source
        A stereo recording. Where it does not place its cameras on a body, the rectified left
        camera is the body.
    left_out : LeftOut
        Gets what cannot be written.
    rectify : bool
        Write raw images rectified and grey.
    """

    def __init__(self, folder: Path, source: Source, left_out: LeftOut, *, rectify: bool) -> None:
        super().__init__(source, left_out, rectify=rectify)
        self._root = folder / "mav0"
        self._tables: tuple[list[str], list[str]] = ([], [])
        T_body_cam = pose_on_body(source)
        self._T_body_cam = np.eye(4) if T_body_cam is None else T_body_cam
        for name in ("cam0", "cam1"):
            (self._root / name / "data").mkdir(parents=True)

    def add(self, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read."""
        pixels = self.load(image)
        if pixels is None:
            return False
        name = f"{image.stamp_ns}.png"
        (self._root / f"cam{image.stream}" / "data" / name).write_bytes(encode_png(pixels))
        self._tables[image.stream].append(f"{image.stamp_ns},{name}\n")
        return True

    def add_truth(self, truth: Trajectory) -> int:
        """Write the poses of the body."""
        folder = self._root / "state_groundtruth_estimate0"
        folder.mkdir()
        write_euroc(folder / "data.csv", truth.transformed(se3.invert(self._T_body_cam)))
        return len(truth)

    def close(self) -> None:
        """Write the tables of images and the calibrations."""
        for stream, rows in enumerate(self._tables):
            camera = self._root / f"cam{stream}"
            text = "#timestamp [ns],filename\n" + "".join(rows)
            (camera / "data.csv").write_text(text, encoding="utf-8")
            calibration = self.info.calibrations[stream]
            is_ideal = self.is_rectifying or calibration.is_rectified
            R_rectified_raw = np.eye(3) if is_ideal else calibration.R
            write_sensor_yaml(
                camera / "sensor.yaml",
                calibration,
                T_body_sensor=self._T_body_rectified(stream)
                @ se3.make_transform(R_rectified_raw, np.zeros(3)),
                is_rectified=is_ideal,
            )

    def _T_body_rectified(self, stream: int) -> FloatArray:  # noqa: N802 - the field's name
        """Return where the rectified left or right camera sits."""
        left, right = self.info.calibrations
        baseline = float(left.P[0, 3] - right.P[0, 3]) / float(left.P[0, 0])
        t_left_camera = np.array([stream * baseline, 0.0, 0.0])
        return np.asarray(self._T_body_cam @ se3.make_transform(np.eye(3), t_left_camera))
