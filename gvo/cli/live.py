"""The command for a camera that is running."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gvo.cli.options import Bag, ConfigFile, Force, Out, Report, Settings, load, new_folder
from gvo.cli.terminal import Command, ended_by_a_signal, report, say, told_where_it_stands
from gvo.errors import ConfigurationError

if TYPE_CHECKING:
    from gvo.config import Config
    from gvo.io.recording import Source
    from gvo.live.odometry import LiveOdometry
    from gvo.types import Progress

_EVERY_S = 5.0


def add_commands(app: typer.Typer) -> None:
    """Add the command to the `gvo` command."""
    app.command(cls=Command)(live)


def live(
    camera: Annotated[
        list[str],
        typer.Argument(
            metavar="CAMERA...",
            help="- for standard input; or camera and its devices: 0, /dev/video0, a film.",
        ),
    ],
    calibration: Annotated[
        list[Path],
        typer.Option(metavar="FILE", help="ROS, Kalibr or EuRoC YAML; repeat it for two files."),
    ],
    sensor: Annotated[
        Literal["stereo", "rgbd"], typer.Option(help="What standard input gives.")
    ] = "stereo",
    is_rectified: Annotated[
        bool, typer.Option("--rectified", help="The images are rectified already.")
    ] = False,
    out: Out = None,
    force: Force = False,
    config: ConfigFile = None,
    set_: Settings = None,
    queue: Annotated[
        int, typer.Option(metavar="N", help="Pairs that wait; the oldest is dropped for one more.")
    ] = 10,
    max_lag: Annotated[
        float | None,
        typer.Option(metavar="S", help="Drop pairs that are older than the newest by more."),
    ] = None,
    bag: Bag = None,
    with_report: Report = True,
) -> None:
    """Track a running camera: images through a pipe, or from a device."""
    from gvo.live.odometry import LiveOdometry
    from gvo.runs.outputs.options import RunOutputs

    parameters = load(config, set_)
    outputs = RunOutputs(bag=bag, report=with_report)
    out = new_folder(out, "live", force=force)
    outputs.check(force=force)
    source = _open(camera, parameters, calibration, sensor, is_rectified=is_rectified)
    try:
        odometry = LiveOdometry(source, parameters, max_waiting=queue, max_lag_s=max_lag)
    except ValueError as error:
        raise ConfigurationError(f"--queue, --max-lag: {error}") from error
    with told_where_it_stands(out), ended_by_a_signal(odometry.stop):
        result = odometry.run(out, outputs=outputs, force=force, on_progress=_status(odometry))
    report(result, out)


def _open(
    words: list[str],
    config: Config,
    calibration: list[Path],
    sensor: Literal["stereo", "rgbd"],
    *,
    is_rectified: bool,
) -> Source:
    from gvo.io.frames import Rig
    from gvo.live.sources import Device, StandardInput

    kind, *devices = words
    if len(calibration) > 2 or kind not in ("-", "camera") or (kind == "-") == bool(devices):
        raise ConfigurationError(
            "expected - or camera DEVICE [DEVICE], and one or two --calibration; got "
            f"{' '.join(words)} and {len(calibration)}"
        )
    rig = Rig(*calibration, sensor=sensor, is_rectified=is_rectified)
    if kind == "camera":
        return Device(devices, rig.info)
    return StandardInput(sys.stdin.buffer, rig.info, config, depth_scale=rig.depth_scale)


def _status(odometry: LiveOdometry) -> Callable[[Progress], None]:
    """Return a callback that says every few seconds how it goes."""
    said_s = started_s = time.monotonic()

    def show(progress: Progress) -> None:
        nonlocal said_s
        now_s = time.monotonic()
        if now_s - said_s >= _EVERY_S:
            said_s = now_s
            counts = f"{progress.n_done} frames, {progress.n_tracked} tracked"
            rate = progress.n_done / (now_s - started_s)
            say(f"{counts}, {odometry.n_dropped} dropped, {rate:.1f} Hz", err=True)

    return show
