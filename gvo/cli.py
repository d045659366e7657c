"""The `gvo` command: parses, calls, prints; computes nothing."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from gvo import __version__
from gvo.errors import ConfigurationError, GvoError
from gvo.terminal import both, interruptible, progress, report, report_smoothed, warn

if TYPE_CHECKING:
    from gvo.config import Config
    from gvo.trajectory import Trajectory

app = typer.Typer(
    name="gvo",
    help="Visual odometry: a stereo or RGB-D recording in, trajectories with covariances out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change a parameter; repeatable."),
]
_ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="YAML, see `gvo config`.")
]
_Compare = Annotated[
    bool,
    typer.Option("--compare", help="Also smooth by full iSAM2 and batch; print the difference."),
]
_CalibrationFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Camera, ROS camera_info YAML; replaces the recording's."),
]


class _KeyframePolicy(StrEnum):
    DISTANCE = "distance"
    MANUAL = "manual"


class _Align(StrEnum):
    NONE = "none"
    ORIGIN = "origin"
    SE3 = "se3"
    SIM3 = "sim3"


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"gvo {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print it."),
    ] = False,
) -> None:
    """Take the options that stand before a command."""


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")] = Path("gvo-demo"),
) -> None:
    """Render a drive, write it as a bag, run on it, compare with the exact truth."""
    from gvo.demo import BAG_NAME, run_demo

    typer.echo(f"rendering a drive into {out / BAG_NAME}")
    with interruptible() as check, progress("demo") as show:
        result = run_demo(out, on_rendered=check, on_progress=both(show, check))
    report(result, out)


@app.command()
def run(
    recording: Annotated[Path, typer.Argument(help="Bag, MCAP, or data-set folder.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    config: _ConfigFile = None,
    set_: _Settings = None,
    ground_truth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses of the camera: TUM, KITTI, EuRoC.")
    ] = None,
    calibration: _CalibrationFile = None,
    left: Annotated[str | None, typer.Option(metavar="TOPIC", help="Left images.")] = None,
    right: Annotated[str | None, typer.Option(metavar="TOPIC", help="Right images.")] = None,
    color: Annotated[str | None, typer.Option(metavar="TOPIC", help="Colour images.")] = None,
    depth: Annotated[str | None, typer.Option(metavar="TOPIC", help="Depth images.")] = None,
    compare_smoothing: _Compare = False,
) -> None:
    """Estimate the trajectory of a recording; write it with covariances, summary and picture."""
    from gvo.runs import read_ground_truth, run_recording
    from gvo.sources.opening import RecordingOptions, open_recording

    parameters = _load(config, set_)
    options = RecordingOptions(
        calibration=calibration, left=left, right=right, color=color, depth=depth
    )
    source = open_recording(recording, config=parameters, options=options)
    for decision in source.info.decisions:
        typer.echo(decision)
    truth = None if ground_truth is None else read_ground_truth(ground_truth)
    with interruptible() as check, progress(source.info.name) as show:
        result = run_recording(
            source,
            out,
            config=parameters,
            ground_truth=truth,
            compare_smoothing=compare_smoothing,
            on_progress=both(show, check),
        )
    report(result, out)


@app.command()
def smooth(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...", help="g2o pose graph, files of poses, bag; - for lines of stdin."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", metavar="TOPIC", help="Poses in a bag; repeatable: fused."),
    ] = None,
    sigma: Annotated[
        list[str] | None,
        typer.Option(
            "--sigma", metavar="DEG,M", help="Of a step, for all inputs or one after another."
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True poses: TUM, KITTI, EuRoC.")
    ] = None,
    keyframes: Annotated[
        _KeyframePolicy, typer.Option(help="What keeps poses in the window.")
    ] = _KeyframePolicy.DISTANCE,
    config: _ConfigFile = None,
    set_: _Settings = None,
    compare_smoothing: _Compare = False,
) -> None:
    """Smooth the edges or poses of any front-end: g2o, trajectories, odometry topics, stdin."""
    from gvo.runs import read_ground_truth
    from gvo.smoothing import configuration_for, smooth_edges
    from gvo.sources.edge_inputs import open_edges, parse_sigma

    parameters = _load(config, set_)
    truth = None if ground_truth is None else read_ground_truth(ground_truth)
    if "-" in inputs:
        _refuse_with_lines(inputs, topic=topic, sigma=sigma, compare=compare_smoothing)
        _smooth_lines(out, config=parameters, keyframes=keyframes, ground_truth=truth)
    sigmas = [parse_sigma(text) for text in sigma or []]
    source = open_edges(inputs, topics=topic or [], sigmas=sigmas)
    for decision in [*source.decisions, *configuration_for(source, parameters)[1]]:
        typer.echo(decision)
    with interruptible() as check, progress(source.name, "poses") as show:
        result = smooth_edges(
            source,
            out,
            config=parameters,
            keyframes=keyframes.value,
            ground_truth=truth,
            compare_smoothing=compare_smoothing,
            on_progress=both(show, check),
        )
    report_smoothed(result, out)


def _refuse_with_lines(inputs: list[str], **options: object) -> None:
    if len(inputs) > 1:
        raise ConfigurationError("-: standard input does not go with another input")
    for name, given in options.items():
        if given:
            raise ConfigurationError(f"-: standard input does not go with --{name}")


def _smooth_lines(
    out: Path, *, config: Config, keyframes: _KeyframePolicy, ground_truth: Trajectory | None
) -> NoReturn:
    """Answer standard input line by line; nothing else goes to standard output."""
    from gvo.smoothing_lines import smooth_lines
    from gvo.sources.edge_answers import read_lines

    def answer(line: str) -> None:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()

    with interruptible() as check:
        result = smooth_lines(
            read_lines(sys.stdin.fileno(), lambda: check(None)),
            answer,
            out,
            config=config,
            keyframes=keyframes.value,
            ground_truth=ground_truth,
        )
    report_smoothed(result, out, is_stdout_taken=True)


@app.command()
def compare(
    reference: Annotated[Path, typer.Argument(help="TUM, KITTI or EuRoC file, or a recording.")],
    estimates: Annotated[list[Path], typer.Argument(help="Files of poses.")],
    align: Annotated[_Align, typer.Option(help="What moves each estimate.")] = _Align.SE3,
    segments: Annotated[
        str | None, typer.Option(metavar="L,...", help="Lengths in m; 100,...,800 or 20,50.")
    ] = None,
    segment_step: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Every Nth pose a start; 10 or 1.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw a .png, .pdf or .svg.")
    ] = None,
) -> None:
    """Measure trajectories against a reference: ATE, RPE, KITTI segment errors."""
    from gvo.evaluation import evaluate
    from gvo.outputs.plots import plot_trajectories
    from gvo.outputs.tables import evaluations_json, format_evaluations
    from gvo.runs import read_ground_truth
    from gvo.trajectory_files import read_trajectory

    truth = read_ground_truth(reference)
    lengths = None if segments is None else _parse_lengths(segments)
    trajectories = {
        name: read_trajectory(path) for name, path in zip(_names(estimates), estimates, strict=True)
    }
    evaluations = [
        evaluate(
            truth,
            trajectory,
            name=name,
            align=align.value,
            segments=lengths,
            segment_step=segment_step,
        )
        for name, trajectory in trajectories.items()
    ]
    if as_json:
        typer.echo(json.dumps(evaluations_json(evaluations), allow_nan=False))
    else:
        typer.echo(format_evaluations(evaluations), nl=False)
    if plot is not None:
        plot_trajectories(plot, truth, trajectories, align=align.value)


@app.command()
def convert(
    folder: Annotated[Path, typer.Argument(help="Data-set folder: KITTI, EuRoC, TUM RGB-D.")],
    bag: Annotated[Path, typer.Argument(help=".bag, .mcap, or a ROS 2 folder to make.")],
    rectify: Annotated[bool, typer.Option("--rectify", help="Rectify the images.")] = False,
    calibration: _CalibrationFile = None,
    config: _ConfigFile = None,
    set_: _Settings = None,
) -> None:
    """Write a data-set folder as a bag, pixels untouched, with the ground truth as tf."""
    from gvo.outputs.bag_writer import convert as write_bag
    from gvo.runs import EXIT_COMPLETE, EXIT_PARTLY
    from gvo.sources.opening import RecordingOptions, open_recording

    options = RecordingOptions(calibration=calibration)
    source = open_recording(folder, config=_load(config, set_), options=options)
    with interruptible() as check:
        written = write_bag(source, bag, rectify=rectify, progress=check)
    typer.echo(f"wrote {bag}: {written.n_images} images, {written.n_poses} true poses")
    warn(written.skipped)
    raise typer.Exit(EXIT_PARTLY if written.skipped else EXIT_COMPLETE)


@app.command("config")
def config_(config: _ConfigFile = None, set_: _Settings = None) -> None:
    """Print all parameters as YAML, with units, ranges and meaning."""
    from gvo.config import describe_configuration

    typer.echo(describe_configuration(_load(config, set_)), nl=False)


def _load(path: Path | None, settings: list[str] | None) -> Config:
    from gvo.config import load_configuration

    return load_configuration(path, settings or [])


def _parse_lengths(text: str) -> list[float]:
    try:
        lengths = [float(part) for part in text.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(0 < length < float("inf") for length in lengths):
        raise ConfigurationError(
            f"--segments {text}: expected positive lengths in metres, such as 100,200"
        )
    return lengths


def _names(paths: list[Path]) -> list[str]:
    """Name estimates by their files, with folders where that is ambiguous."""
    stems = [path.stem for path in paths]
    names = [
        stem if stems.count(stem) == 1 else f"{path.parent.name}/{stem}"
        for stem, path in zip(stems, paths, strict=True)
    ]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def main() -> None:
    """Run the command; one line and exit code 2 for bad input."""
    try:
        app()
    except GvoError as error:
        typer.echo(f"gvo: error: {error}", err=True)
        raise SystemExit(2) from None
