"""The demonstration: render a drive, write it as a bag, run on that bag."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gvo.errors import RecordingError, write_faults
from gvo.io.convert.bag_messages import BagWriter, FramePose, write_transforms
from gvo.io.convert.convert import convert
from gvo.io.opening import open_recording
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.io.run_folder.line_file import check_new
from gvo.io.run_folder.writer import check_unused
from gvo.io.synthetic import SyntheticRecording
from gvo.runs.result import RunResult
from gvo.trajectory.trajectory import Trajectory
from gvo.types import ImageArray, Progress

_LOGGER = logging.getLogger(__name__)

BAG_NAME = "drive.mcap"
ROBOT_NAME = "robot.mcap"
N_FRAMES = 450  # the lap closes after 370

# The camera looks ahead, 0.5 m in front of the robot's middle and 1.2 m high: x forward, z up.
_T_BASE_CAM = np.array([[0.0, 0, 1, 0.5], [-1, 0, 0, 0.1], [0, -1, 0, 1.2], [0, 0, 0, 1]])


def write_demo_bags(folder: Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Render a drive with a stereo camera; write it, and the tf of the robot that carries it.

    Parameters
    ----------
    folder : Path
        Gets `drive.mcap`, with the exact truth of the camera, and `robot.mcap`, which has
        `map` to `base_link` in `/tf`, and `base_link` to the camera in `/tf_static`. Both are
        replaced where they exist.
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When a file cannot be written.
    """
    drive = _drive(N_FRAMES)
    with write_faults(RecordingError, folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (BAG_NAME, ROBOT_NAME):
            (folder / name).unlink(missing_ok=True)
        write_robot_bag(drive.ground_truth(), folder / ROBOT_NAME)
    with _processes() as pool:
        convert(_RenderedAhead(drive, pool), folder / BAG_NAME, progress=progress)


@lru_cache(maxsize=1)
def _drive(n_frames: int) -> SyntheticRecording:
    return SyntheticRecording("block", "stereo", n_frames=n_frames, scale=0.5)


@lru_cache(maxsize=1)
def _images(n_frames: int) -> list[StampedImage]:
    return list(_drive(n_frames).images())


def _render(n_frames: int, index: int) -> ImageArray:
    return np.asarray(_images(n_frames)[index].load())


class _RenderedAhead:
    """The drive, its images rendered by other processes before they are asked for."""

    def __init__(self, drive: SyntheticRecording, pool: Executor) -> None:
        self._drive, self._pool = drive, pool

    @property
    def info(self) -> RecordingInfo:
        return self._drive.info

    def images(self) -> Iterator[StampedImage]:
        images = list(self._drive.images())
        render = partial(_render, len(images) // 2)
        rendered = self._pool.map(render, range(len(images)), chunksize=4)
        for image, pixels in zip(images, rendered, strict=True):
            yield replace(image, load=partial(np.asarray, pixels))

    def ground_truth(self) -> Trajectory:
        return self._drive.ground_truth()


@contextmanager
def _processes() -> Iterator[Executor]:
    """Yield workers on all cores; an error or an interrupt stops them at once."""
    pool = ProcessPoolExecutor(
        max_workers=os.cpu_count(),
        mp_context=multiprocessing.get_context("spawn"),
        # The first process alone answers to Ctrl-C.
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )
    try:
        yield pool
    except BaseException:
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def write_robot_bag(truth: Trajectory, path: Path) -> None:
    """Write the tf of a robot that carries the left camera of a stereo bag of gvo's own."""
    with TemporaryDirectory(dir=path.parent, prefix=".gvo-part-") as part:
        with BagWriter(Path(part) / path.name) as bag:
            stamps_ns = truth.stamps_ns.tolist()
            mount = FramePose(stamps_ns[0], "base_link", "camera_left_optical", _T_BASE_CAM)
            write_transforms(bag, "/tf_static", [mount], is_latched=True)
            poses = _T_BASE_CAM @ truth.T_world_frame @ np.linalg.inv(_T_BASE_CAM)
            for stamp_ns, T_map_base in zip(stamps_ns, poses, strict=True):
                write_transforms(bag, "/tf", [FramePose(stamp_ns, "map", "base_link", T_map_base)])
        bag.result.rename(path)


def check_place(out: Path, *, force: bool = False) -> None:
    """Refuse a folder that holds a result or a recording of these names, unless forced.

    Raises
    ------
    RecordingError, OutputError
        With what to do.
    """
    check_unused(out, force=force)
    for name in () if force else (BAG_NAME, ROBOT_NAME):
        check_new(out / name, otherwise="--force to replace it")


def run_demo(
    out: Path,
    *,
    force: bool = False,
    on_rendered: Callable[[int], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_written: Callable[[], None] | None = None,
) -> RunResult:
    """Write the demo's bags into a folder, run on the drive, compare with the exact truth.

    Parameters
    ----------
    out : Path
        Folder for the bags and the run's files.
    force : bool
        Let earlier ones be replaced.
    on_rendered : callable, optional
        Called with the number of images written to the bag so far.
    on_progress, on_written : callable, optional
        As of `run_recording`.

    Raises
    ------
    RecordingError
        When the folder holds something else of these names, or cannot be written.
    """
    check_place(out, force=force)
    # Kernels are compiled, once on a machine, while the drive is rendered.
    command = [sys.executable, "-m", "gvo.kernels"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as compiler:  # noqa: S603
        write_demo_bags(out, progress=on_rendered)
        if compiler.poll() is None:
            _LOGGER.warning("compiling, once on this machine")
    from gvo.runs.run import run_recording

    source = open_recording(out / BAG_NAME)
    return run_recording(source, out, force=True, on_progress=on_progress, on_written=on_written)
