"""Signals, progress bars, and what commands print at the end."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TextIO

import typer
from typer import Option
from typer.core import TyperCommand

from gvo._text import cut, visible, wrapped

if TYPE_CHECKING:
    from gvo.config import Config
    from gvo.io.recording import Source
    from gvo.runs.result import RunResult
    from gvo.types import Progress

# Share by which the total of a progress bar may be off.
_MAX_OFF = 0.02
_N_CHECKED = 200  # images of each stream, at the end of a run
_MAX_CHATTER = 1 << 15  # bytes; half of what a pipe holds
_EXIT_CODES_OF_SIGNALS: dict[int, int] = {
    number: 128 + number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
}
EXIT_FAULTS = 1
EXIT_UNUSABLE = 2


# Verdicts at the start of a line or after the name of a recording.
_VERDICT = re.compile(
    r"^(?:gvo: )?(?:ok|warning|fault|error)\b|(?<=: )(?:healthy|\d+ (?:fault|warning)s?)\b|"
    r"\bLikely cause:|\bWorth a look:"
)
_COLOURS = {
    **{"fault": typer.colors.RED, "error": typer.colors.RED, "Likely": typer.colors.RED},
    **{"warning": typer.colors.YELLOW, "Worth": typer.colors.YELLOW},
    **{"ok": typer.colors.GREEN, "healthy": typer.colors.GREEN},
}
_LOGGER = logging.getLogger("gvo")
_LEVELS = {True: logging.DEBUG, None: logging.WARNING, False: logging.ERROR}


def _set_verbosity(value: bool | None) -> None:
    _LOGGER.setLevel(_LEVELS[value])
    _LOGGER.handlers.clear()
    if value:
        _LOGGER.addHandler(logging.StreamHandler())
        _LOGGER.handlers[0].setFormatter(logging.Formatter("%(name)s: %(message)s"))


Verbose = Annotated[
    bool | None,
    Option(
        "--verbose/--quiet",
        "-v/-q",
        callback=_set_verbosity,
        expose_value=False,
        help="Print what gvo does, or errors only.",
    ),
]
"""The option of every command."""


class Command(TyperCommand):
    """A command that hides what image libraries print, and says how many lines it was."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - Typer's
        """Run the command."""
        with chatter_counted():
            return super().invoke(ctx)


@contextmanager
def chatter_counted() -> Iterator[None]:
    """Hide what libraries write to standard error past Python; say how many lines it was."""
    own = sys.stderr
    try:
        number = own.fileno()
    except (OSError, ValueError):
        yield  # replaced, as in tests: libraries cannot write to it
        return
    own.flush()
    kept, (reader, writer) = os.dup(number), os.pipe()
    for end in (reader, writer):
        os.set_blocking(end, False)
    os.dup2(writer, number)
    with os.fdopen(kept, "w", encoding=own.encoding, errors=own.errors, buffering=1) as stream:
        _print_errors_to(stream)
        try:
            yield
        finally:
            os.dup2(kept, number)
            os.close(writer)
            _print_errors_to(own)
            _tell_chatter(reader)


def _print_errors_to(stream: TextIO) -> None:
    sys.stderr = stream
    for handler in _LOGGER.handlers:
        if isinstance(handler, logging.StreamHandler):
            handler.setStream(stream)


def _tell_chatter(reader: int) -> None:
    with os.fdopen(reader, "rb", buffering=0) as pipe:
        text = pipe.read(_MAX_CHATTER) or b""
    lines = [line for line in text.decode(errors="replace").splitlines() if line.strip()]
    if lines:
        count = f"{'more than ' if len(text) == _MAX_CHATTER else ''}{len(lines)}"
        warn([f"{count} lines of image libraries, the first: {cut(lines[0], 200)}"])


def say(text: object, *, nl: bool = True, err: bool = False) -> None:
    """Print a result or a note, unless --quiet was given."""
    if _LOGGER.isEnabledFor(logging.WARNING):
        lines = [str(text)] if nl else str(text).split("\n")
        stream = sys.stderr if err else sys.stdout
        echo("\n".join(_fitted(visible(line), stream) for line in lines), nl=nl, err=err)


def echo(text: str, *, nl: bool = True, err: bool = False) -> None:
    """Print; where nobody reads it any more, print into nothing from then on."""
    try:
        typer.echo(text, nl=nl, err=err)
    except OSError:
        stream = sys.stderr if err else sys.stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def tell_error(error: Exception) -> None:
    """Print an error."""
    echo(_fitted(f"gvo: error: {error}", sys.stderr), err=True)


def _fitted(line: str, stream: TextIO) -> str:
    """Return a line that a terminal need not break within words, its verdicts in colours."""
    if not stream.isatty():
        return line
    n_columns = shutil.get_terminal_size().columns
    if len(line) > n_columns:
        line = "\n".join(wrapped(line, width=n_columns))
    return line if os.environ.get("NO_COLOR") else _VERDICT.sub(_coloured, line)


def _coloured(verdict: re.Match[str]) -> str:
    colour = next(colour for word, colour in _COLOURS.items() if word in verdict[0])
    return typer.style(verdict[0], fg=colour, bold=True)


def exit_code(is_complete: bool) -> int:
    """Return 0 for a complete result, 3 for a part of it."""
    return 0 if is_complete else 3


def report(result: RunResult, out: Path, *, is_stdout_taken: bool = False) -> NoReturn:
    """Print a result, and end with its exit code."""
    tell(result, out, is_stdout_taken=is_stdout_taken)
    raise typer.Exit(exit_code(result.is_complete))


def tell(result: RunResult, out: Path, *, is_stdout_taken: bool = False) -> None:
    """Print a result."""
    say(f"{result}\n", nl=False, err=is_stdout_taken)
    say(out if result.report is None else result.report, err=is_stdout_taken)
    warn(result.warnings)


def tell_end(
    result: RunResult, source: Source, parameters: Config, written: Sequence[Path], notes: str
) -> None:
    """Print a result, what `gvo check` finds wrong on the first images, and what was written."""
    from gvo.diagnostics.check import check_recording, format_check
    from gvo.io.recording import ChosenImages

    say(f"{result}\n", nl=False)
    warn(result.warnings)
    info = replace(source.info, n_images=min(source.info.n_images, _N_CHECKED))
    first = ChosenImages(info=info, images=lambda: islice(source.images(), 2 * _N_CHECKED))
    if _LOGGER.isEnabledFor(logging.WARNING):  # not in vain
        # The run itself has learnt the readout.
        found = check_recording(first, parameters, n_samples=2, learn_readout=False)
        wrong = found.with_verdict("fault", "warning")
        # Told by the run.
        rest = tuple(finding for finding in wrong if finding.value != info.doubt)
        if rest:
            say(format_check(replace(found, findings=rest)), nl=False)
        elif not wrong:
            say("gvo check: healthy")
    paths = [*written] if result.report is None else [result.report, *written[1:]]
    say(f"wrote {', '.join(map(str, paths))}: {notes}")


def warn(warnings: Sequence[str]) -> None:
    """Print warnings, a line each, to standard error."""
    for warning in warnings:
        say(f"gvo: warning: {warning}", err=True)


def is_shown() -> bool:
    """Tell whether progress is drawn: on a terminal, unless --quiet or --verbose was given."""
    return sys.stderr.isatty() and _LOGGER.level == logging.WARNING


@contextmanager
def progress(title: str, unit: str = "frames") -> Iterator[Callable[[Progress], None]]:
    """Yield a callback that draws a bar on a terminal, and nothing in a pipe."""
    if not is_shown():
        yield lambda progress: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.1f} " + unit + "/s, {task.fields[tracked]:.0%} tracked,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(visible(title), total=None, start=False, rate=0.0, tracked=1.0)

        def update(progress: Progress) -> None:
            bar.start_task(task)
            shown = bar.tasks[0]
            # Another total makes rich forget the rate, and with it the time left.
            if abs(progress.n_total - (shown.total or 0)) > _MAX_OFF * progress.n_total:
                bar.update(task, total=progress.n_total)
            bar.update(
                task,
                completed=progress.n_done,
                rate=shown.speed or 0.0,
                tracked=progress.n_tracked / max(progress.n_done, 1),
            )

        yield update


@contextmanager
def status(title: str) -> Iterator[Callable[[str], None]]:
    """Yield a callback that shows a text on a terminal, and nothing in a pipe."""
    if not is_shown():
        yield lambda text: None
        return
    from rich.console import Console

    with Console(stderr=True).status(title) as shown:
        yield lambda text: shown.update(f"{title}: {text}")


def _handle(handlers: Mapping[int, Any]) -> dict[int, Any]:
    """Set the handlers of signals; return those before."""
    ignored = {signal.SIGHUP} if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else set()
    return {
        number: signal.signal(number, handler)
        for number, handler in handlers.items()
        if number not in ignored  # by nohup
    }


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let a signal end the command at once, with one line and its exit code."""
    received: list[int] = []

    def receive(number: int, frame: object) -> None:
        received.append(number)
        raise SystemExit(_EXIT_CODES_OF_SIGNALS[number])

    before = _handle(dict.fromkeys(_EXIT_CODES_OF_SIGNALS, receive))
    try:
        yield
    finally:
        if received:
            echo("gvo: interrupted; the same command begins anew", err=True)
        _handle(before)


class Work(AbstractContextManager["Work"]):
    """Work of many steps, which a signal ends between two of them by a line and an exit code.

    Parameters
    ----------
    stands : str
        Said of an interrupted work: what of it stands, and how to go on.
    undrawn : str
        Said instead once all is written and only pictures are missing.

    Attributes
    ----------
    on_signal : callable or None
        Called in a thread when the first signal comes.
    """

    def __init__(self, stands: str = "", undrawn: str = "") -> None:
        self.stands, self._undrawn = stands, undrawn
        self.on_signal: Callable[[], None] | None = None
        self._received: list[int] = []
        self._before: dict[int, Any] = {}
        self._is_written = False

    def __enter__(self) -> Work:
        self._before = _handle(dict.fromkeys(_EXIT_CODES_OF_SIGNALS, self._receive))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        _handle(self._before)
        if kind is not KeyboardInterrupt:
            return
        words = self._undrawn if self._is_written and self._undrawn else self.stands
        if words:
            echo(f"gvo: interrupted; {visible(words)}", err=True)
        number = self._received[0] if self._received else signal.SIGINT
        raise SystemExit(_EXIT_CODES_OF_SIGNALS[number]) from None

    def _receive(self, number: int, frame: object) -> None:
        """Note a signal; a second one, or one while pictures are drawn, interrupts at once."""
        self._received.append(number)
        if self._is_written or len(self._received) > 1:
            raise KeyboardInterrupt
        if self.on_signal is not None:
            # The signal may have come into code that holds a lock which is needed there.
            threading.Thread(target=self.on_signal, daemon=True).start()

    def check(self, state: object = None) -> None:
        """End the work if a signal has come; called between two steps."""
        if self._received:
            raise KeyboardInterrupt

    def checking(self, show: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that shows the progress, then calls `check`."""

        def on_progress(progress: object) -> None:
            show(progress)
            self.check()

        return on_progress

    def note_written(self) -> None:
        """Note that all is written but the pictures."""
        self._is_written = True
        self.check()


def work_on_run(out: Path, *, and_then: str = "; --force begins anew") -> Work:
    """Return work that writes poses into a folder while it goes on."""
    undrawn = f"all is computed and in {out}, not drawn{and_then}, gvo compare --report draws it"
    return Work(f"{poses_so_far(out)}{and_then}", undrawn)


def poses_so_far(out: Path) -> str:
    """Return where the poses of an interrupted run are."""
    return f"the poses so far are in {out}"
