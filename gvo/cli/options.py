"""Options that commands share: parameters, recordings, calibration, topics."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gvo.config import Config
    from gvo.io.opening import RecordingOptions
    from gvo.io.recording import Source

_LOGGER = logging.getLogger(__name__)
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change a parameter; repeatable."),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="YAML, see `gvo config`.")
]
Recordings = Annotated[
    list[Path], typer.Argument(metavar="RECORDING...", help="Bags, or one data-set folder.")
]
CalibrationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE", help="ROS, Kalibr or EuRoC YAML, repeatable; replaces the recording's."
    ),
]
Left = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic of the left images.")]
Right = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic of the right images.")]
Color = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic of the colour images.")]
Depth = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic of the depth images.")]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder to write; gvo-RECORDING if omitted.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace earlier results.")]
Bag = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write a .mcap (ROS 2) or .bag (ROS 1) too.")
]
Report = Annotated[
    bool, typer.Option("--report/--no-report", help="Draw the picture and report.html.")
]
Start = Annotated[float, typer.Option(metavar="S", help="Seconds to skip at the start.")]
Duration = Annotated[float | None, typer.Option(metavar="S", help="Seconds to read from there.")]
Every = Annotated[int, typer.Option(metavar="N", help="Take every Nth frame.")]


Loops = Annotated[
    bool | None,
    typer.Option("--loops/--no-loops", help="Find loops, write global poses; loops.enabled."),
]


def with_loops(settings: list[str] | None, loops: bool | None) -> list[str]:
    """Return the settings, that of loops behind the others where it is given."""
    return [*(settings or []), *([] if loops is None else [f"loops.enabled={str(loops).lower()}"])]


def load(path: Path | None, settings: list[str] | None) -> Config:
    """Return the parameters of a file, changed by settings."""
    from gvo.config import load_configuration

    config = load_configuration(path, settings or [])
    _LOGGER.debug("parameters: %s", config.model_dump(exclude_defaults=True) or "defaults")
    return config


def new_folder(
    out: Path | None, recording: str | Path, *, what: str = "", force: bool = False
) -> Path:
    """Return the folder to write, a new one if none is given; refused before any work."""
    from gvo.io.run_folder.writer import check_unused, free_folder

    folder = free_folder(recording, what) if out is None else out
    check_unused(folder, force=force)
    return folder


def recording_options(
    calibration: Sequence[Path] | None,
    left: str | None,
    right: str | None,
    color: str | None,
    depth: str | None,
) -> RecordingOptions:
    """Return the options of a recording."""
    from gvo.io.opening import RecordingOptions

    return RecordingOptions(
        calibration=tuple(calibration or ()), left=left, right=right, color=color, depth=depth
    )


def open_source(recordings: Sequence[Path], config: Config, options: RecordingOptions) -> Source:
    """Open a recording as the options say."""
    from gvo.io.opening import open_recording

    source = open_recording(recordings, config=config, options=options)
    _LOGGER.debug("opened %s: %s", source.info.name, "; ".join(source.info.decisions))
    return source
