"""What a run writes besides the tables of its folder."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gvo.errors import ConfigurationError, RecordingError, named_faults, write_faults
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.io.run_folder.line_file import check_folder, check_new
from gvo.runs.loop import RunLoop
from gvo.runs.outputs.file import FileOutput
from gvo.runs.outputs.frames import RunFrames


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutputs:
    """What a run writes besides the tables of its folder.

    Parameters
    ----------
    bag : Path, optional
        A `.mcap` or `.bag` with transforms, odometry, paths, points, overlays.
    world : str
        The fixed frame in that bag, and in the file for Rerun.
    overlay : Path, optional
        A film of the matches: `.webm`, `.mp4`, or a folder of PNG files.
    rerun : Path, optional
        A `.rrd` for the Rerun viewer.
    report : bool
        Draw `trajectories.png` and write `report.html` into the run folder.
    plots : Path, optional
        Folder for each plot of the report as PNG and PDF.
    """

    bag: Path | None = None
    world: str = "world"
    overlay: Path | None = None
    rerun: Path | None = None
    report: bool = True
    plots: Path | None = None

    def __post_init__(self) -> None:
        """Refuse contradictory options."""
        if self.plots is not None and not self.report:
            raise ConfigurationError("--plots are those of the report, which is not written")

    @property
    def files(self) -> list[Path]:
        """The bag, the film and the file for Rerun, as far as they are asked for."""
        return [path for path in (self.bag, self.overlay, self.rerun) if path is not None]

    def check(self, *, force: bool = False) -> None:
        """Refuse files that exist or cannot be written, before any work; nothing is made.

        Parameters
        ----------
        force : bool
            Let plots be replaced.

        Raises
        ------
        RecordingError
            With what to do.
        """
        for path in self.files:
            check_new(path)
        if self.plots is not None:
            check_folder(self.plots)
            if not force:
                check_new(self.plots, otherwise="--force to replace its plots")

    def open(self, loop: RunLoop, stack: ExitStack) -> list[FileOutput]:
        """Open the files that are written as the run goes.

        Parameters
        ----------
        loop : RunLoop
            Before its run.
        stack : ExitStack
            Closes what is opened.

        Returns
        -------
        list of FileOutput

        Raises
        ------
        ConfigurationError
            When a frame's name is invalid, or a package is not installed.
        RecordingError
            When a file cannot be written.
        """
        outputs: list[FileOutput] = []
        if self.plots is not None:
            with write_faults(RecordingError, self.plots):
                self.plots.mkdir(parents=True, exist_ok=True)
        if self.bag is not None or self.rerun is not None:
            names = name_frames(
                loop.source, loop.base_frame, is_placed=loop.is_placed, world=self.world
            )
        if self.bag is not None:
            from gvo.runs.outputs.bag import RunBag

            outputs.append(stack.enter_context(RunBag(self.bag, names)))
        if self.overlay is not None:
            from gvo.runs.outputs.video import RunOverlay

            film = RunOverlay(self.overlay, loop.source.info.camera)
            outputs.append(stack.enter_context(film))
        if self.rerun is not None:
            from gvo.runs.outputs.rerun import RunRerun

            rerun = RunRerun(self.rerun, loop.source.info.camera, names, config=loop.config)
            outputs.append(stack.enter_context(rerun))
        return outputs


def name_frames(
    source: Source, base_frame: BaseFrame, *, is_placed: bool, world: str, is_robot: bool = False
) -> RunFrames:
    """Name the frames of a run for a bag.

    Parameters
    ----------
    source : Source
        The recording.
    base_frame : BaseFrame
        Whose poses are written.
    is_placed : bool
        Whether an initial pose was asked for: the world is not that of the first frame.
    world : str
        The fixed frame.
    is_robot : bool
        See `RunFrames`.

    Raises
    ------
    ConfigurationError
        When a frame's name is invalid.
    """
    make = partial(RunFrames, world=world, camera=source.info.frame_id, is_robot=is_robot)
    fixed = base_frame.fixed_mount
    mount = base_frame.T_base_cam if fixed is None else fixed
    with named_faults(ConfigurationError, f"--world {world}", others=(ValueError,)):
        if base_frame.is_camera:
            return make(is_world_optical=not is_placed)
        return make(base=base_frame.name, T_base_cam=mount)
