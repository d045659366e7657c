"""The demonstration: render a drive, write it as a bag, run on that bag."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from gvo.config import Config
from gvo.outputs.bag_writer import convert
from gvo.runs import Progress, RunResult, run_recording
from gvo.sources.opening import open_recording
from gvo.sources.synthetic import SyntheticRecording

BAG_NAME = "drive.mcap"
N_FRAMES = 100


def write_demo_bag(path: Path, *, n_frames: int = N_FRAMES, seed: int = 0) -> None:
    """Render a drive with a stereo camera and write it as a bag with its exact truth.

    Parameters
    ----------
    path : Path
        `.bag`, `.mcap`, or a folder for a ROS 2 bag; replaced where it exists.
    n_frames : int
        Stereo pairs at 10 Hz.
    seed : int
        Of textures, world, motion and noise.
    """
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    convert(
        SyntheticRecording(world="driving", sensor="stereo", n_frames=n_frames, seed=seed), path
    )


def run_demo(out: Path, *, on_progress: Callable[[Progress], None] | None = None) -> RunResult:
    """Write the demo's bag into a folder, run on it, compare with the exact truth.

    Parameters
    ----------
    out : Path
        Folder for the bag and the run's files.
    on_progress : callable, optional
        Called after each frame of the run.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_demo_bag(out / BAG_NAME)
    return run_recording(
        open_recording(out / BAG_NAME), out, config=Config(), on_progress=on_progress
    )
