"""Recordings as folders of the KITTI odometry benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gvo.config import SyncConfig
from gvo.geometry import se3
from gvo.outputs.conversion import LeftOut
from gvo.outputs.folder_calibrations import write_projections
from gvo.outputs.folder_streams import FolderStreams
from gvo.outputs.image_files import encode_png
from gvo.sources.frames import paired
from gvo.sources.recording import Source, StampedImage
from gvo.trajectory.formats import write_kitti
from gvo.trajectory.trajectory import Trajectory, format_stamp
from gvo.types import FaultyFrame


class KittiFolder(FolderStreams):
    """Rectified pairs by number: `image_0` and `image_1`, in colour `image_2` and `image_3`.

    Parameters
    ----------
    folder : Path
        To be made.
    source : Source
        A stereo recording.
    left_out : LeftOut
        Gets what cannot be written.
    sync : SyncConfig
        Which images are a pair; its stamp is that of the left one.
    """

    def __init__(self, folder: Path, source: Source, left_out: LeftOut, sync: SyncConfig) -> None:
        super().__init__(source, left_out, rectify=True)
        self._folder = folder
        self._sync = sync
        self._stamps_ns: list[int] = []
        self._folders: tuple[str, str] | None = None
        folder.mkdir()

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Yield the images of pairs, left before right."""
        for pair in paired(images, self.info.sensor, self._sync):
            if isinstance(pair, FaultyFrame):
                self.left_out.add_image(
                    f"{self.info.stream_names[0]} image", pair.stamp_ns, pair.reason
                )
            else:
                yield from pair

    def add(self, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read: its number stays free."""
        if image.stream == 0:
            self._stamps_ns.append(image.stamp_ns)
        pixels = self.load(image)
        if pixels is None:
            return False
        if self._folders is None:
            self._folders = ("image_2", "image_3") if pixels.ndim == 3 else ("image_0", "image_1")
            for name in self._folders:
                (self._folder / name).mkdir()
        number = len(self._stamps_ns) - 1
        path = self._folder / self._folders[image.stream] / f"{number:06d}.png"
        path.write_bytes(encode_png(pixels))
        return True

    def add_truth(self, truth: Trajectory) -> int:
        """Write a pose for each pair, where there is one for all of them."""
        at_frames = truth.interpolate(np.array(self._stamps_ns, dtype=np.int64))
        if len(at_frames) < len(self._stamps_ns):
            self.left_out.add(
                f"poses.txt: {len(at_frames)} of {len(self._stamps_ns)} pairs lie between true "
                "poses, all are needed"
            )
            return 0
        # The layout's poses are those of the camera that P is stated for: P = K [I | t_cam_cam0].
        P = self.info.calibrations[0].P
        t_cam_cam0 = np.linalg.solve(P[:, :3], P[:, 3])
        T_cam_cam0 = se3.make_transform(np.eye(3), np.asarray(t_cam_cam0))
        write_kitti(self._folder / "poses.txt", at_frames.transformed(T_cam_cam0))
        return len(at_frames)

    def close(self) -> None:
        """Write stamps and calibration."""
        lines = [f"{format_stamp(stamp_ns)}\n" for stamp_ns in self._stamps_ns]
        (self._folder / "times.txt").write_text("".join(lines), encoding="utf-8")
        names = self._folders or ("image_0", "image_1")
        write_projections(self._folder / "calib.txt", names, self.info.calibrations)
