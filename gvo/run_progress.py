"""The summary of a run while it goes on, and where it is interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from gvo.errors import GvoError, OutputError
from gvo.resuming.beginning import Beginning, State, identity
from gvo.run_loop import RunLoop
from gvo.run_summary import summarize
from gvo.run_tally import Progress
from gvo.types import Failure

_EVERY_S = 3.0
_NOT_YET = Failure(reason="the run has not ended")
_HOW_TO_GO_ON = "the same command with --resume goes on"


class RunningSummary:
    """Replaces `summary.json` every few seconds.

    Parameters
    ----------
    loop : RunLoop
    begun : Beginning
    on_progress : callable, optional
        Called before, after each frame.
    """

    def __init__(
        self,
        loop: RunLoop,
        begun: Beginning,
        on_progress: Callable[[Progress], None] | None = None,
    ) -> None:
        self._loop = loop
        self._begun = begun
        self._identity = identity(begun.journal.header)
        self._on_progress = on_progress
        self._written_s: float | None = None

    def __call__(self, progress: Progress) -> None:
        """Take that a frame is done."""
        if self._on_progress is not None:
            self._on_progress(progress)
        is_due = self._written_s is None or time.monotonic() - self._written_s > _EVERY_S
        if is_due and self._begun.folder.is_settled:
            self._loop.count()
            self._begun.journal.sync()
            self.write("running")

    def write(self, state: State, *warnings: str) -> None:
        """Write what was done so far.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        lines = [*warnings, *self._loop.tally.warnings()]
        summary = summarize(self._loop, _NOT_YET, lines, state=state)
        self._begun.folder.write_summary(summary | {"run": self._identity})
        self._written_s = time.monotonic()

    @contextmanager
    def told(self) -> Iterator[None]:
        """Say in the summary, and in an error of writing, what stands and how to go on.

        Raises
        ------
        OutputError
            The same, with the number of frames that stand.
        """
        try:
            yield
        except OutputError as error:
            self._write_interrupted(str(error))
            raise self._explained(error) from error
        except (GvoError, KeyboardInterrupt):
            self._write_interrupted("interrupted")
            raise

    def _write_interrupted(self, what: str) -> None:
        # Before all was repeated, the summary of the interruption before holds as it is.
        if self._begun.folder.is_settled:
            with suppress(OutputError):
                self.write("interrupted", f"{what}: {_HOW_TO_GO_ON}")

    def _explained(self, error: OutputError) -> OutputError:
        tally = self._loop.tally
        text = (
            f"{error}; {tally.n_frames} frames stand whole in {self._begun.folder.path}: when "
            f"there is room again, {_HOW_TO_GO_ON}"
        )
        return OutputError(text, is_partly=tally.n_with_pose > 0)
