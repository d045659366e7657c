"""The `gvo` command: parses, calls, prints; computes nothing."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option
from typer.main import get_command

from gvo._text import format_table, plain_floats, plain_number
from gvo._version import __version__
from gvo.cli import options as opt
from gvo.cli.batch import batch
from gvo.cli.inspect import explain, view
from gvo.cli.live import live
from gvo.cli.terminal import (
    EXIT_FAULTS,
    EXIT_UNUSABLE,
    Work,
    ended_by_signals,
    exit_code,
    progress,
    report,
    say,
    status,
    tell_end,
    tell_error,
    warn,
    work_on_run,
)
from gvo.errors import ConfigurationError, GvoError, OutputError, flags_named, named_faults

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gvo.io.edges.events import EdgeSource
    from gvo.runs.result import RunResult
    from gvo.trajectory.evaluation import Evaluation
    from gvo.trajectory.trajectory import Trajectory

app = typer.Typer(
    name="gvo",
    help="Visual odometry: stereo or RGB-D in, trajectories with covariances out.",
    context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)
_command = partial(opt.add_command, app)
# What is refused of a command line; Typer gives the class no name of its own.
_UsageError: type[Exception] = typer.BadParameter.__mro__[1]

_AsJson = Annotated[bool, Option("--json", help="Print JSON.")]
_Robust = Literal["none", "huber", "gnc"]
_KeyframePolicy = Literal["distance", "manual"]
_Layout = Literal["bag", "kitti", "euroc", "tum"]
_Align = Literal["none", "origin", "se3", "sim3"]


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"gvo {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Without a command, list the commands."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(EXIT_UNUSABLE)


@_command()
def demo(
    out: Annotated[Path, Option(metavar="DIR", help="Folder to write.")] = Path("gvo-demo"),
    force: opt.Force = False,
) -> None:
    """Render a drive as a bag, run on it, compare with the truth."""
    from gvo.runs.demo import BAG_NAME, check_place, run_demo

    check_place(out, force=force)
    say(f"rendering a drive into {out / BAG_NAME}")
    stands = f"what is done is in {out}; --force begins anew"
    with Work(stands) as work, progress("demo") as show:
        result = run_demo(
            out,
            force=force,
            on_rendered=work.check,
            on_progress=work.checking(show),
            on_written=work.note_written,
        )
    report(result, out)


@_command()
def run(
    recordings: opt.Recordings,
    *,
    out: opt.Out = None,
    force: opt.Force = False,
    parameters: opt.LoopParameters,
    excerpt: opt.Excerpt,
    frame: Annotated[
        str | None, Option(metavar="NAME", help="Write the poses of this frame of tf.")
    ] = None,
    initial_pose: Annotated[
        str | None,
        Option(metavar="POSE", help="First pose: X,Y,Z[,QX,QY,QZ,QW] in metres, or truth."),
    ] = None,
    gravity_aligned: Annotated[
        bool, Option("--gravity-aligned", help="Turn the world by the IMU so that z points up.")
    ] = False,
    ground_truth: Annotated[
        str | None,
        Option(metavar="WHAT", help="Pose file, or tf:PARENT:CHILD or /TOPIC in the bag."),
    ] = None,
    bag: opt.Bag = None,
    world: Annotated[
        str, Option(metavar="NAME", help="Name of the fixed frame in that bag.")
    ] = "world",
    overlay: Annotated[
        Path | None, Option(metavar="FILE", help="Film the matches: .webm, .mp4, or a folder.")
    ] = None,
    rerun: Annotated[Path | None, Option(metavar="FILE", help="Write a Rerun file, .rrd.")] = None,
    with_report: opt.Report = True,
    plots: opt.Plots = None,
    options: opt.Options,
) -> None:
    """Estimate the trajectory of a recording, with covariances."""
    from gvo.io.poses.base_frame import find_base_frame, parse_initial_pose
    from gvo.io.poses.inputs import read_truth
    from gvo.io.run_folder.writer import usual_folder
    from gvo.runs.outputs.options import RunOutputs
    from gvo.runs.run import run_recording

    start_s = time.perf_counter()
    pose = None if initial_pose is None else parse_initial_pose(initial_pose)
    outputs = RunOutputs(
        bag=bag, world=world, overlay=overlay, rerun=rerun, report=with_report, plots=plots
    )
    usual = usual_folder(recordings[0])
    is_second = out is None and os.path.lexists(usual)
    earlier = f"; {usual} holds an earlier run" if is_second else ""
    out = opt.new_folder(out, recordings[0], force=force)
    outputs.check(force=force)
    source = opt.open_source(recordings, parameters, options)
    base_frame = find_base_frame(source, frame, T_initial=None if isinstance(pose, str) else pose)
    truth = (
        None if ground_truth is None else read_truth(source, ground_truth, base_frame=base_frame)
    )
    for line in source.info.decisions:
        say(line)
    with work_on_run(out) as work, progress(source.info.name) as show:
        result = run_recording(
            source,
            out,
            config=parameters,
            ground_truth=truth,
            base_frame=base_frame,
            starts_at_truth=isinstance(pose, str),
            gravity_aligned=gravity_aligned,
            excerpt=excerpt,
            outputs=outputs,
            force=force,
            on_progress=work.checking(show),
            on_written=work.note_written,
        )
    n, elapsed_s = result.summary["frames"], time.perf_counter() - start_s
    notes = f"{n} frames in {elapsed_s:.1f} s, {n / elapsed_s:.1f} frames per second{earlier}"
    tell_end(result, source, parameters, [out, *outputs.files], notes)
    raise typer.Exit(exit_code(result.is_complete))


@_command("check")
def check_(
    recordings: opt.Recordings,
    *,
    parameters: opt.Parameters,
    frame: Annotated[
        str, Option(metavar="NAME", help="The robot's base frame in tf.")
    ] = "base_link",
    options: opt.Options,
    as_json: _AsJson = False,
) -> None:
    """Look for what would make odometry fail on a recording."""
    from gvo.diagnostics.check import check_recording, format_check
    from gvo.io.bag.source import read_transforms

    source = opt.open_source(recordings, parameters, options)
    result = check_recording(
        source,
        parameters,
        transforms=read_transforms(source, (source.info.frame_id, frame)),
        base_frame=frame,
    )
    if as_json:
        typer.echo(json.dumps(result.as_json(), allow_nan=False))
    else:
        say(format_check(result), nl=False)
    raise typer.Exit(0 if result.is_healthy else EXIT_FAULTS)


@_command()
def smooth(
    inputs: Annotated[
        list[str],
        Argument(metavar="INPUT...", help="Pose graph (g2o), pose files or a bag; - reads lines."),
    ],
    out: opt.Out = None,
    force: opt.Force = False,
    topic: Annotated[
        list[str] | None,
        Option("--topic", metavar="TOPIC", help="Pose topic in a bag. Repeat to fuse several."),
    ] = None,
    sigma: Annotated[
        list[str] | None,
        Option(
            "--sigma",
            metavar="DEG,M",
            help="Noise of a step, repeat to give one per input; of a graph's edges without any.",
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None, Option(metavar="FILE", help="True poses (docs/frames.md: pose files).")
    ] = None,
    robust: Annotated[
        _Robust | None,
        Option(help="How to weigh down false edges; default: none for a graph, huber for poses."),
    ] = None,
    covariances: Annotated[
        bool, Option("--covariances", help="Also compute the covariance of every pose (slower).")
    ] = False,
    window: Annotated[
        bool, Option("--window", help="Smooth pose by pose in a sliding window, as with -.")
    ] = False,
    keyframes: Annotated[
        _KeyframePolicy | None, Option(help="How the window chooses the poses it keeps.")
    ] = None,
    config: opt.ConfigFile = None,
    set_: opt.Settings = None,
) -> None:
    """Smooth the relative or absolute poses of any front-end."""
    from gvo.io.edges.opening import open_edges, parse_sigma
    from gvo.io.poses.inputs import read_ground_truth

    is_stream = "-" in inputs
    if is_stream and len(inputs) > 1:
        raise ConfigurationError("-: standard input does not go with another input")
    if is_stream:
        opt.refuse("does not go with standard input", topic=topic, sigma=sigma)
    if window or is_stream:
        why = "is of a file optimized at once, not of the window"
        opt.refuse(why, robust=robust, covariances=covariances)
    else:
        opt.refuse("is of the window; add --window", config=config, set=set_, keyframes=keyframes)
    parameters = opt.load(config, set_)
    out = opt.new_folder(out, "lines" if is_stream else inputs[0], force=force)
    truth = None if ground_truth is None else read_ground_truth(ground_truth)
    source = None
    if not is_stream:
        sigmas = [parse_sigma(text) for text in sigma or []]
        source = open_edges(inputs, topics=topic or [], sigmas=sigmas)
    for decision in [] if source is None else source.decisions:
        say(decision)
    of_batch = {"robust": robust, "covariances": covariances}
    of_window = {"config": parameters, "keyframes": keyframes or "distance"}
    options = of_window if window or is_stream else of_batch
    result = _smoothed(source, out, window, **options, ground_truth=truth, force=force)
    report(result, out, is_stdout_taken=is_stream)


def _smoothed(source: EdgeSource | None, out: Path, window: bool, **options: Any) -> RunResult:  # noqa: ANN401
    """Smooth an input; without one answer standard input, line by line."""
    from gvo.io.edges.lines import read_lines
    from gvo.runs import smooth

    with work_on_run(out) as work:
        options["on_written"] = work.note_written
        if source is None:
            lines = read_lines(sys.stdin.fileno(), work.check)
            return smooth.smooth_lines(lines, _answer, out, **options)
        if window:
            with progress(source.name, "poses") as show:
                on_progress = work.checking(show)
                return smooth.smooth_edges(source, out, on_progress=on_progress, **options)
        with status(source.name) as show_text:
            on_step = work.checking(show_text)
            return smooth.optimize_edges(source, out, on_step=on_step, **options)


def _answer(line: str) -> None:
    """Answer at once; nothing else goes to standard output."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


@_command()
def compare(
    reference: Annotated[
        str,
        Argument(help="Pose file, recording with truth, BAG#tf:PARENT:CHILD or BAG#TOPIC."),
    ],
    estimates: Annotated[list[str], Argument(help="Pose files, runs, BAG#tf:... or BAG#TOPIC.")],
    align: Annotated[
        _Align, Option(metavar="HOW", help="Alignment: none, origin, se3, or sim3 with a scale.")
    ] = "se3",
    segments: Annotated[
        str | None, Option(metavar="L,...", help="Segment lengths in metres, such as 100,200.")
    ] = None,
    segment_step: Annotated[
        int | None, Option(min=1, metavar="N", help="Start a segment at every Nth pose.")
    ] = None,
    max_difference: Annotated[
        float, Option(min=0.0, metavar="S", help="Associate stamps within so many seconds.")
    ] = 0.01,
    offset: Annotated[
        str, Option(metavar="S", help="Seconds to add to the stamps of estimates, or auto.")
    ] = "0",
    as_json: _AsJson = False,
    plot: Annotated[Path | None, Option(metavar="FILE", help="Draw a .png, .pdf or .svg.")] = None,
    report_file: Annotated[
        Path | None, Option("--report", metavar="FILE", help="Write a page, .html.")
    ] = None,
    plots: opt.Plots = None,
    force: opt.Force = False,
) -> None:
    """Measure trajectories against a reference: ATE, RPE, segments."""
    from gvo.io.poses.inputs import read_compared
    from gvo.io.run_folder.line_file import check_new
    from gvo.io.run_folder.reader import pose_files, read_summary
    from gvo.trajectory.evaluation import evaluate, evaluations_json, format_evaluations
    from gvo.viz.names import PAGES, check_suffix

    for path in (plot, report_file, plots):
        if path is not None and not force:
            check_new(path, otherwise="--force to replace it")
    check_suffix(plot)
    check_suffix(report_file, PAGES)
    files = {text: pose_files(text) for text in estimates}
    runs = {text: read_summary(Path(text)) for text, each in files.items() if each != [text]}
    truth, trajectories, notes = read_compared(reference, [*chain(*files.values())])
    warn(notes)
    trajectories = {
        name: _by_clock(truth, each, name, offset) for name, each in trajectories.items()
    }
    lengths = None if segments is None else _parse_lengths(segments)
    how: dict[str, Any] = {"align": align, "max_difference_ns": round(1e9 * max_difference)}
    of_segments: dict[str, Any] = {"segments": lengths, "segment_step": segment_step}
    evaluations = [
        evaluate(truth, each, name=name, **how, **of_segments)
        for name, each in trajectories.items()
    ]
    if as_json:
        found = evaluations_json(evaluations) | ({"runs": runs} if runs else {})
        typer.echo(json.dumps(found, allow_nan=False))
    else:
        say(format_evaluations(evaluations), nl=False)
        _tell_causes(evaluations)
        _tell_covariances(runs)
    if plot is not None:
        from gvo.viz.plots import plot_trajectories

        plot_trajectories(plot, truth, trajectories, **how)
    if report_file is not None or plots is not None:
        from gvo.viz.report import write_comparison_report

        write_comparison_report(
            report_file, truth, evaluations, align=align, segments=lengths, plots=plots
        )


@_command("convert")
def convert_(
    recordings: opt.Recordings,
    target: Annotated[Path, Argument(help=".bag, .mcap, .db3, or a folder to make.")],
    *,
    layout: Annotated[_Layout | None, Option(help="Layout of the folder to write.")] = None,
    rectify: Annotated[bool, Option("--rectify", help="Rectify the images.")] = False,
    png: Annotated[bool, Option("--png", help="Compress the images of a bag.")] = False,
    options: opt.Options,
    parameters: opt.Parameters,
) -> None:
    """Write a recording as a bag, or as a folder of KITTI, EuRoC or TUM."""
    from gvo.io.convert.convert import convert
    from gvo.io.run_folder.line_file import check_new

    why = "images are written as they were recorded"
    opt.refuse(why, rig=options.rig, mask=options.mask)
    check_new(target)
    source = opt.open_source(recordings, parameters, options)
    with Work(f"{target} is not written; the same command begins anew") as work:
        written = convert(
            source,
            target,
            layout=layout,
            rectify=rectify,
            compress=png,
            config=parameters,
            progress=work.check,
        )
    say(f"wrote {target}: {written.n_images} images, {written.n_poses} true poses")
    warn(written.skipped)
    raise typer.Exit(exit_code(not written.skipped))


@_command("config")
def config_(
    *,
    everything: Annotated[bool, Option("--all", help="Print the expert parameters too.")] = False,
    parameters: opt.Parameters,
) -> None:
    """Print the parameters that matter most, or all."""
    from gvo.config import describe_configuration

    typer.echo(describe_configuration(parameters, for_experts=everything), nl=False)
    if not everything:
        say("# The others, for experts: gvo config --all")


def _parse_lengths(text: str) -> list[float]:
    try:
        lengths = plain_floats(text.split(","))
    except ValueError:
        lengths = []
    if not lengths or not all(0 < length < float("inf") for length in lengths):
        raise ConfigurationError(
            f"--segments {text}: expected positive lengths in metres, such as 100,200"
        )
    return lengths


def _by_clock(truth: Trajectory, estimate: Trajectory, name: str, offset: str) -> Trajectory:
    """Return an estimate by the clock of the truth, as the option says."""
    if offset == "auto":
        from gvo.trajectory.alignment import clock_offset

        offset_ns = clock_offset(truth, estimate)
        say(f"{name}: {1e-9 * offset_ns:+.4f} s added to its stamps", err=True)
    else:
        try:
            offset_ns = round(1e9 * float(plain_number(offset)))
        except (ValueError, OverflowError):
            expected = "expected seconds, such as 0.05, or auto"
            raise ConfigurationError(f"--offset {offset}: {expected}") from None
    return replace(estimate, stamps_ns=estimate.stamps_ns + offset_ns)


def _tell_causes(evaluations: Sequence[Evaluation]) -> None:
    from gvo.io.run_folder.verdict import likely_causes
    from gvo.trajectory.evaluation import evaluations_json

    for row in evaluations_json(evaluations)["estimates"]:
        for cause in likely_causes(row)[:1]:
            say(f"{row['name']}: Likely cause: {cause}")


def _tell_covariances(runs: Mapping[str, Mapping[str, Any]]) -> None:
    from gvo.io.run_folder.verdict import nees_table, reference_words

    for folder, summary in runs.items():
        header, *rows = nees_table(summary.get("nees") or {})
        if rows:
            say(f"\n{folder}, against its ground truth\n{format_table(header, rows)}", nl=False)
            say(reference_words(summary.get("reference")))


for _each in (batch, live, explain, view):
    _command()(_each)


def _run() -> Any:  # noqa: ANN401 - an exit code, or None
    group: Any = get_command(app)
    for option in group.params:
        # the list of commands fits a screen
        option.hidden = option.name in ("show_completion", "install_completion")
    try:
        return group(prog_name="gvo", standalone_mode=False)
    except _UsageError as error:
        refusal: Any = error
        words = refusal.format_message().replace("Value error, ", "").rstrip(".")
        command = refusal.ctx.command_path if refusal.ctx else "gvo"
        message = f"{words[:1].lower()}{words[1:]}; see `{command} --help`"
        raise ConfigurationError(message) from error


def _open_standard_streams() -> None:
    """Open those that the caller closed: else a file of the run gets the number of one."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115


@flags_named()
def main() -> None:
    """Run the command; one line and exit code 2 for bad input."""
    _open_standard_streams()
    try:
        with ended_by_signals(), named_faults(GvoError, "gvo"):
            raise SystemExit(_run() or 0)
    except typer.Abort:
        raise SystemExit(130) from None
    except BrokenPipeError:  # as of `gvo config | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except GvoError as error:
        tell_error(error)
        is_partly = isinstance(error, OutputError) and error.is_partly
        raise SystemExit(exit_code(False) if is_partly else EXIT_UNUSABLE) from None
