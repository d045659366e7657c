"""Run a batch: recordings times configurations, a table and a report of all runs."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import pandas as pd
from distributed import Client

from gvo._version import __version__
from gvo.batch.engine import BatchProgress, Engine, connected
from gvo.batch.inputs import differences, find_recordings, name_variants
from gvo.batch.results import CSV, to_frame, write_results
from gvo.batch.tasks import MARK, BatchOptions, BatchRow, Task, TaskOptions
from gvo.config import Config
from gvo.errors import OutputError, write_faults
from gvo.io.run_folder.line_file import replace_text
from gvo.io.run_folder.writer import check_unused

# How often the table is written while the batch runs.
_EVERY_S = 10.0


def run(
    recordings: Sequence[str | Path] | str | Path,
    configs: Config | Sequence[Config] | Mapping[str, Config] | None = None,
    *,
    out: str | Path,
    client: Client | None = None,
    options: BatchOptions | None = None,
    on_progress: Callable[[BatchProgress], None] | None = None,
) -> pd.DataFrame:
    """Run odometry over many recordings, with one configuration or several.

    Each run writes its folder as `run_recording` does, below `out`: by the name of the recording
    and, where there are several, of the configuration. A run that is complete there, of the same
    recording, configuration and version, is taken over; any other begins anew.

    Parameters
    ----------
    recordings : path, or sequence of paths
        Recordings, or folders of them; see `find_recordings`.
    configs : Config, sequence, or mapping of names, optional
        The defaults if omitted, except `runtime.threads`, which is 1: each core has a run.
    out : str or Path
        Folder that all workers see under this path.
    client : distributed.Client, optional
        Client of a cluster; if omitted, one worker of one thread is started per core.
    options : BatchOptions, optional
    on_progress : callable, optional
        Called in this thread, several times a second. What it raises ends the batch; finished
        runs stay.

    Returns
    -------
    DataFrame
        A row for each run, as `results.csv` holds it, in the order of recordings and
        configurations.

    Raises
    ------
    RecordingError
        If no recording is found.
    OutputError
        If the folder cannot be written.
    ClusterError
        If the scheduler is lost.
    """
    asked = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    variants = name_variants(configs)
    return run_batch(
        find_recordings(asked),
        variants,
        out=out,
        client=client,
        options=options or BatchOptions(),
        on_progress=on_progress,
    )


def run_batch(
    recordings: Mapping[str, str],
    variants: Mapping[str, Config],
    *,
    out: str | Path,
    client: Client | None = None,
    options: BatchOptions,
    on_progress: Callable[[BatchProgress], None] | None = None,
) -> pd.DataFrame:
    """Run recordings with named configurations; see `run`."""
    tasks, folder = make_tasks(recordings, variants), Path(out).absolute()
    check_place(folder, tasks, options)
    table = _Table(folder, tasks)
    shared = TaskOptions(out=folder, mark=table.mark, batch=options)
    with ExitStack() as stack:
        stack.enter_context(table.written())
        client = client or stack.enter_context(connected(None, None))
        # Closed at once if a row cannot be written: running tasks are cancelled.
        rows = stack.enter_context(closing(Engine(client, shared, on_progress).run(tasks)))
        for row in rows:
            table.add(row)
    return table.frame()


def check_place(out: str | Path, tasks: Sequence[Task], options: BatchOptions) -> None:
    """Refuse to replace results that are not of this batch, before any work.

    Raises
    ------
    RecordingError
        With what to do.
    """
    if options.force:
        return
    if not Path(out, MARK).exists():
        for folder in ("", *(task.folder for task in tasks)):
            check_unused(Path(out, folder))
    with suppress(OSError, ValueError, KeyError):  # no table, or a damaged one
        rows = pd.read_csv(Path(out, CSV), dtype=str, keep_default_na=False)
        there = rows["folder"][rows["status"] != "failed"]
        gone = there[~there.isin([task.folder for task in tasks])]
        if len(gone):
            raise OutputError(
                f"{out}: holds another batch, of which {gone.iloc[0]} would leave the table; give "
                "another folder by --out, its recordings too, or --force to replace the table"
            )


def make_tasks(recordings: Mapping[str, str], variants: Mapping[str, Config]) -> list[Task]:
    """Return a task for each recording with each configuration."""
    parameters = differences([*variants.values()])
    return [
        Task(
            recording=recording,
            variant=variant,
            source=location,
            folder=f"{recording}/{variant}" if len(variants) > 1 else recording,
            config=config,
            parameters=values,
        )
        for recording, location in recordings.items()
        for (variant, config), values in zip(variants.items(), parameters, strict=True)
    ]


class _Table:
    """The rows of a batch, and the files that show them."""

    def __init__(self, folder: Path, tasks: Sequence[Task]) -> None:
        self.mark = uuid.uuid4().hex
        self._folder = folder
        self._places = {task.folder: place for place, task in enumerate(tasks)}
        self._rows: list[BatchRow] = []
        self._written_s = time.monotonic()

    def add(self, row: BatchRow) -> None:
        self._rows.append(row)
        if time.monotonic() - self._written_s > _EVERY_S:
            write_results(self.frame(), self._folder)
            self._written_s = time.monotonic()

    def frame(self) -> pd.DataFrame:
        """Return the rows so far, in the order of the tasks."""
        return to_frame(sorted(self._rows, key=lambda row: self._places[row.folder]))

    @contextmanager
    def written(self) -> Iterator[None]:
        """Mark the folder; write table and report at the end, also after an exception."""
        content = {"mark": self.mark, "gvo_version": __version__, "n_runs": len(self._places)}
        with write_faults(OutputError, self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            replace_text(self._folder / MARK, json.dumps(content) + "\n")
        try:
            yield
        finally:
            if self._rows:
                write_results(self.frame(), self._folder)
                self._draw()

    def _draw(self) -> None:
        from gvo.batch.report import write_batch_report

        n_missing = len(self._places) - len(self._rows)
        note = f"{n_missing} runs were not made: the batch was stopped" if n_missing else ""
        write_batch_report(self._folder, self.frame(), note=note)
