"""Files that are whole whenever a run is stopped: lines appended, files replaced or renamed."""

from __future__ import annotations

import fcntl
import io
import os
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path

from gvo.errors import OutputError, RecordingError, RunBusyError, write_faults


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be made or written, before any work; nothing is made."""
    with write_faults(OutputError, folder):
        place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        is_folder = place.is_dir()
    if not is_folder:
        raise OutputError(f"{folder}: cannot be written: {place} is no folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: cannot be written: no permission to write to {place}")


def check_new(path: Path, *, otherwise: str = "remove it") -> None:
    """Refuse a path that holds something, or whose folder cannot be written, with what to do."""
    check_folder(path.parent)
    is_empty = path.is_dir() and not any(path.iterdir())
    if os.path.lexists(path) and not is_empty:
        raise RecordingError(f"{path}: exists already; give another path or {otherwise}")


def append_whole(file: io.FileIO, data: bytes) -> None:
    """Append all of the data to an unbuffered file; where it cannot be written, none of it."""
    length = file.seek(0, os.SEEK_END)
    rest = memoryview(data)
    try:
        while rest:
            rest = rest[file.write(rest) :]
    except OSError:
        file.truncate(length)
        raise


def replace_text(path: Path, text: str) -> None:
    """Replace a text file atomically."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, data: bytes) -> None:
    """Replace a file atomically."""
    beside = path.with_name(f"{path.name}.new")
    try:
        with io.FileIO(beside, "wb") as file:
            append_whole(file, data)
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold a lock file, which is removed in the end, or raise `RunBusyError`."""
    with io.FileIO(path, "ab", opener=_open_no_link) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunBusyError(busy) from None
        except OSError:
            pass  # a file system without locks
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _open_no_link(path: str, flags: int) -> int:
    # A link there may lead out of the folder.
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


class PartFile:
    """A file written under another name in its folder; it takes its own once it is complete.

    Parameters
    ----------
    path : Path
        Its folder is made where it is missing.
    *errors : type
        Raised, besides OSError, where it cannot be written.

    Attributes
    ----------
    part : Path
        Where it is written; what is given its name in the end.

    Raises
    ------
    RecordingError
        When it exists, or cannot be written.
    """

    def __init__(self, path: Path, *errors: type[Exception]) -> None:
        self.path = path
        self._errors = errors
        check_new(path)
        with ExitStack() as stack, self.refused_on_error():
            path.parent.mkdir(parents=True, exist_ok=True)
            busy = f"{path}: another process is writing it; give another path"
            stack.enter_context(locked(path.with_name(f".{path.name}.lock"), busy))
            self._lock = stack.pop_all()
            self._folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=".gvo-part-")
        self.part = Path(self._folder.name) / path.name

    def refused_on_error(self) -> AbstractContextManager[None]:
        """Raise a RecordingError where it cannot be written."""
        return write_faults(RecordingError, self.path, *self._errors)

    @contextmanager
    def completed(self, *, is_kept: bool) -> Iterator[None]:
        """Give the file its name after the last lines are written, or remove it."""
        with self._lock, self._folder, self.refused_on_error():
            yield
            if is_kept:
                self.part.rename(self.path)

    @contextmanager
    def discarded(self) -> Iterator[None]:
        """Free its space, so that a full disk lets it be closed inside; then remove it."""
        with self._lock, self._folder, suppress(RecordingError), self.refused_on_error():
            for path in Path(self._folder.name).rglob("*"):
                if path.is_file():
                    os.truncate(path, 0)
            yield
