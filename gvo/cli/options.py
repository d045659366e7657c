"""Options that commands share: parameters, recordings, calibration, topics."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gvo.config import Config
    from gvo.io.opening import RecordingOptions
    from gvo.io.recording import Source

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
Left = Annotated[str | None, typer.Option(metavar="TOPIC", help="Left images.")]
Right = Annotated[str | None, typer.Option(metavar="TOPIC", help="Right images.")]
Color = Annotated[str | None, typer.Option(metavar="TOPIC", help="Colour images.")]
Depth = Annotated[str | None, typer.Option(metavar="TOPIC", help="Depth images.")]
Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")]
Start = Annotated[float, typer.Option(metavar="S", help="Skip the first seconds.")]
Duration = Annotated[float | None, typer.Option(metavar="S", help="Stop after so many seconds.")]
Every = Annotated[int, typer.Option(metavar="N", help="Take every Nth frame.")]


def load(path: Path | None, settings: list[str] | None) -> Config:
    """Return the parameters of a file, changed by settings."""
    from gvo.config import load_configuration

    return load_configuration(path, settings or [])


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

    return open_recording(recordings, config=config, options=options)
