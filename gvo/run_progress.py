"""The summary of a run while it goes on, and where it is interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from gvo.errors import GvoError, OutputError
from gvo.io.run_folder.writer import RunFolder
from gvo.run_loop import RunLoop
from gvo.run_summary import State, summarize
from gvo.run_tally import Progress
from gvo.types import Failure

_EVERY_S = 3.0
_NOT_YET = Failure(reason="the run has not ended")


class RunningSummary:
    """Replaces `summary.json` every few seconds.

    Parameters
    ----------
    loop : RunLoop
    folder : RunFolder
    identity : dict
        See `run_identity`.
    on_progress : callable, optional
        Called before, after each frame.
    """

    def __init__(
        self,
        loop: RunLoop,
        folder: RunFolder,
        identity: dict[str, Any],
        on_progress: Callable[[Progress], None] | None = None,
    ) -> None:
        self._loop = loop
        self._folder = folder
        self._identity = identity
        self._on_progress = on_progress
        self._written_s: float | None = None

    def __call__(self, progress: Progress) -> None:
        """Take that a frame is done."""
        if self._on_progress is not None:
            self._on_progress(progress)
        if self._written_s is None or time.monotonic() - self._written_s > _EVERY_S:
            self._loop.count()
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
        self._folder.write_summary(summary | {"run": self._identity})
        self._written_s = time.monotonic()

    @contextmanager
    def told(self) -> Iterator[None]:
        """Say in the summary, and in an error of writing, what stands.

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
        with suppress(OutputError):
            self.write("interrupted", what)

    def _explained(self, error: OutputError) -> OutputError:
        tally = self._loop.tally
        text = f"{error}; {tally.n_frames} frames stand whole in {self._folder.path}"
        return OutputError(text, is_partly=tally.n_with_pose > 0)
