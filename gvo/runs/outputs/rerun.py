"""A run as a file for the Rerun viewer, written while the run goes.

Entities

===========================================  ======================================================
`world`                                      x right, y down, z forward, or x forward, z up
`world/NAME/frame`                           poses; NAME: raw, causal, smoothed, global
`world/NAME/path`, `world/NAME/recent`       where it was up to the last full second, and since
`world/NAME/covariance`                      3-sigma ellipsoid of the position; NAME: raw, causal
`world/causal/frame/camera`                  how the camera sits in the frame
`world/causal/frame/camera/image`            its pinhole model and the image
`world/causal/frame/camera/points`           matched points: inliers blue, outliers orange
`world/keyframes`, `.../covariance`          the kept frames as they were placed when they came
`world/links`                                the edges that came with the frame
`world/loops`                                lines between causal poses, when confirmed
`world/global/loops`                         lines between global poses, at the end
`world/cloud`                                points of each keyframe, placed when it came
`overlay`                                    matches drawn over the image
`counts/...`, `milliseconds/...`             matches, inliers, points; time by stage
`chi2/...`                                   of the accepted edges by kind, their mean
`status`, `configuration`                    a line per frame; what was set
===========================================  ======================================================

All is logged on two timelines: `stamp`, and `frame`, the number of the frame, faulty ones counted.
Stamps before the year 2000 are durations, others dates. A pose has its own stamp, a smoothed one
too; lines, ellipsoids and numbers have that of the frame with which they were known.

Whole paths are written at each full second of the recording and at the end. The ones in between
hold every pose, every second, every fourth ... so that there are at most 500 and the file grows
with the length of the run, not with its square; those at the end hold all poses. The viewer keeps
positions in single precision.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gvo.config import Config, describe_configuration
from gvo.errors import ConfigurationError, RecordingError, missing_extra
from gvo.geometry.camera import PinholeCamera
from gvo.io.run_folder.line_file import PartFile
from gvo.runs.outputs.frames import RunFrames
from gvo.types import Estimate, FaultyFrame, Frame, FrameResult, Optimum, Status

if TYPE_CHECKING:
    from gvo.runs.outputs.rerun_writer import RerunWriter

SUFFIX: Final = ".rrd"
N_FRAMES_HELD: Final = 20
"""Frames after which what was logged must be in the file."""


class RunRerun(AbstractContextManager["RunRerun"]):
    """A Rerun file of the results of a run, open inside a `with` block.

    It is written under another name in the same folder and takes its own when it is closed, also
    where the run is interrupted. Without a single frame no file is left. No viewer is needed, and
    none is started.

    Parameters
    ----------
    path : Path
        Ends in `.rrd`. Its folder is made where it is missing.
    camera : PinholeCamera or StereoCamera
        Of the rectified frames.
    frames : RunFrames, optional
        Whose poses they are, and how the camera sits there.
    config : Config, optional
        Shown beside the scene.

    Raises
    ------
    ConfigurationError
        When rerun-sdk is missing, or switched off by the environment variable RERUN.
    RecordingError
        When the path exists, ends otherwise or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        camera: PinholeCamera,
        frames: RunFrames | None = None,
        *,
        config: Config | None = None,
    ) -> None:
        self.path = Path(path)
        self._n_frames = 0
        self._is_open = True
        if importlib.util.find_spec("rerun") is None:
            raise missing_extra("--rerun needs rerun-sdk", "rerun")
        if self.path.suffix != SUFFIX:
            raise RecordingError(
                f"{path}: expected a name ending in {SUFFIX}, got {self.path.name}"
            )
        self._file = PartFile(self.path, RuntimeError)  # which rerun raises
        text = "" if config is None else describe_configuration(config)
        with self._file.refused_on_error():
            self._writer = self._open(camera, frames or RunFrames(), text)

    def _open(self, camera: PinholeCamera, frames: RunFrames, text: str) -> RerunWriter:
        from gvo.runs.outputs.rerun_writer import RerunStream, RerunWriter

        stream = RerunStream(self._file.part, self.path.stem)
        if not stream.is_enabled:
            with self._file.completed(is_kept=False):
                pass
            raise ConfigurationError(
                "--rerun: the environment variable RERUN switches rerun off; unset it"
            )
        return RerunWriter(stream, camera, frames, text)

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Write the result of a frame.

        Parameters
        ----------
        frame : StereoFrame or RgbdFrame
            Whose image is shown.
        result : FrameResult
            Its poses are those of the base frame.

        Raises
        ------
        RecordingError
            When the file cannot be written.
        """
        self._writer.add_frame(frame, result)
        self._n_frames += 1
        if self._n_frames % N_FRAMES_HELD == 0:
            with self._file.refused_on_error():
                self._writer.stream.flush()

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses of the base frame that are final, in any order."""
        self._writer.add_smoothed(estimates)

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses of the base frame, and the loops that count."""
        self._writer.add_optimum(optimum)

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write a frame without a pose to the log."""
        self._writer.add_status(frame.stamp_ns, Status.SKIPPED, f"skipped: {frame.reason}")

    def close(self) -> None:
        """Write the whole paths and give the file its name; a second call does nothing.

        Raises
        ------
        RecordingError
            When the file cannot be written.
        """
        if not self._is_open:
            return
        self._is_open = False
        with self._file.completed(is_kept=self._n_frames > 0):
            try:
                if self._n_frames > 0:
                    self._writer.add_paths()
            finally:
                self._writer.stream.close()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()
