"""The command for many recordings: a batch, a sweep of parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from gvo.cli import options as opt
from gvo.cli.terminal import exit_code, is_shown, say, status, warn, work_on_run
from gvo.errors import ConfigurationError

if TYPE_CHECKING:
    from gvo.batch import BatchProgress

_CONFIGURATIONS = (".yaml", ".yml")
_MAX_WARNINGS = 20


def batch(
    recordings: Annotated[
        list[str],
        Argument(metavar="RECORDING...", help="Recordings, folders to search, lists (.txt)."),
    ],
    out: Annotated[Path, Option(metavar="DIR", help="Folder to write.")],
    *,
    sweep: Annotated[
        list[str] | None,
        Option(metavar="SECTION.KEY=A,B,C", help="Run each value; with several, each combination."),
    ] = None,
    configs: Annotated[
        list[str] | None,
        Option(
            "--configs", "--config", metavar="FILE...", help="YAML files, each a configuration."
        ),
    ] = None,
    set_: opt.Settings = None,
    loops: opt.Loops = None,
    workers: Annotated[
        int | None, Option(min=1, metavar="N", help="Worker processes here; one a core if omitted.")
    ] = None,
    scheduler: Annotated[
        str | None, Option(metavar="URL", help="Scheduler of a Dask cluster, as tcp://host:8786.")
    ] = None,
    force: Annotated[bool, Option("--force", help="Run all again; replace other results.")] = False,
    excerpt: opt.Excerpt,
    with_report: Annotated[
        bool, Option("--report/--no-report", help="Draw the picture and page of each run.")
    ] = True,
    options: opt.Options,
) -> None:
    """Run many recordings or configurations: one table, one report."""
    from gvo.batch import BatchOptions, connected, find_recordings, make_variants, run_batch
    from gvo.batch.results import outcome
    from gvo.batch.running import check_place, make_tasks
    from gvo.io.calibration.files import paths_of
    from gvo.io.run_folder.writer import REPORT

    if scheduler is not None and workers is not None:
        raise ConfigurationError("--workers starts processes here, --scheduler names a cluster")
    asked, files = _sort_arguments(recordings, configs or [])
    variants = make_variants(files, opt.with_loops(set_, loops), sweep or [])
    found = find_recordings(asked)
    calibration = tuple(map(Path.absolute, paths_of(options.calibration)))
    masks = tuple(map(Path.absolute, options.mask))
    batch_options = BatchOptions(
        recording=replace(
            options,
            calibration=calibration,
            mask=masks,
            rig=None if options.rig is None else Path(options.rig).absolute(),
        ),
        excerpt=excerpt,
        report=with_report,
        force=force,
    )
    check_place(out, make_tasks(found, variants), batch_options)
    counts = _count(len(found), "recording"), _count(len(variants), "configuration")
    say(", ".join(counts))
    with (
        work_on_run(out, and_then=": the same command goes on") as work,
        _progress() as show,
        connected(scheduler, workers) as client,
    ):
        progress = work.checking(show)
        table = run_batch(
            found, variants, out=out, client=client, options=batch_options, on_progress=progress
        )
    words, reasons = outcome(table)
    warn(reasons[:_MAX_WARNINGS])
    if len(reasons) > _MAX_WARNINGS:
        warn([f"{len(reasons) - _MAX_WARNINGS} more runs are not complete, see the table"])
    say(f"{_count(len(table), 'run')}: {words}; {out / REPORT}")
    if (table["status"] == "failed").all():
        raise ConfigurationError("all runs failed")
    raise typer.Exit(exit_code(not reasons))


def _sort_arguments(recordings: list[str], configs: list[str]) -> tuple[list[str], list[Path]]:
    """Return recordings and configurations: the shell expands `--configs *.yaml` to arguments."""
    given = [*configs, *(one for one in recordings if one.endswith(_CONFIGURATIONS))]
    rest = [one for one in recordings if not one.endswith(_CONFIGURATIONS)]
    if not rest:
        raise ConfigurationError("expected a recording beside the configurations")
    return rest, [Path(one) for one in given]


@contextmanager
def _progress() -> Iterator[Callable[[BatchProgress], None]]:
    """Yield a callback: a status line on a terminal, elsewhere a line for each run."""
    if not is_shown():
        yield _print_row
        return
    with status("batch") as show:
        yield lambda progress: show(_words(progress))


def _print_row(progress: BatchProgress) -> None:
    row = progress.row
    if row is not None:
        what = f"{row.status}, found" if row.is_found else row.status
        reason = f": {row.reason}" if row.reason else ""
        say(f"[{progress.n_done}/{progress.n_total}] {row.folder}: {what}{reason}", err=True)


def _words(progress: BatchProgress) -> str:
    left_s = progress.left_s
    left = "" if left_s is None else f", {timedelta(seconds=round(left_s))} left"
    return (
        f"{progress.n_done} of {progress.n_total} runs, {progress.n_failed} failed, on "
        f"{progress.n_workers} workers{left}"
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
