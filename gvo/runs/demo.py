"""The demonstration: render a drive, write it as a bag, run on that bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.convert.bag_writer import write_bag
from gvo.io.opening import open_recording
from gvo.io.synthetic.recording import SyntheticRecording
from gvo.runs.run import RunResult, run_recording
from gvo.types import Progress

BAG_NAME = "drive.mcap"
N_FRAMES = 100


def write_demo_bag(path: Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Render a drive with a stereo camera and write it as a bag with its exact truth.

    Parameters
    ----------
    path : Path
        `.bag` or `.mcap` file; replaced where it exists.
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
    drive = SyntheticRecording(world="driving", sensor="stereo", n_frames=N_FRAMES)
    write_bag(drive, path, progress=progress)


def run_demo(
    out: Path,
    *,
    on_rendered: Callable[[int], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> RunResult:
    """Write the demo's bag into a folder, run on it, compare with the exact truth.

    Parameters
    ----------
    out : Path
        Folder for the bag and the run's files.
    on_rendered : callable, optional
        Called with the number of images written to the bag so far.
    on_progress : callable, optional
        Called after each frame of the run.
    """
    write_demo_bag(out / BAG_NAME, progress=on_rendered)
    return run_recording(
        open_recording(out / BAG_NAME), out, config=Config(), on_progress=on_progress
    )
