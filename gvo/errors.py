"""Errors of the input: files, topics, configurations, calibrations."""

import json
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import ClassVar

from gvo._text import cut, shortened_words

_MAX_MESSAGE = 4000  # characters


# A flag, perhaps with a value in capitals; a command in backticks stays as it is.
_FLAG = re.compile(r"`[^`]*`|(?<![\w/.-])--(?:set ([^\s,;)]+)|([a-z][a-z-]*)( (?=[A-Z]))?)")


def said(text: str) -> str:
    """Return a message that names flags in Python's words, unless the command line asks."""
    return text if GvoError.names_flags else _FLAG.sub(_in_python, text)


def _in_python(flag: re.Match[str]) -> str:
    setting, name, has_value = flag.groups()
    if name is None:
        return flag[0] if setting is None else f'settings=["{setting}"]'
    value = "=True" if name == "force" else "=" if has_value else ""
    return f"{name.replace('-', '_')}{value}"


@contextmanager
def flags_named() -> Iterator[None]:
    """Let messages name the flags of the command line, not the parameters of Python."""
    before, GvoError.names_flags = GvoError.names_flags, True
    try:
        yield
    finally:
        GvoError.names_flags = before


class GvoError(Exception):
    """An error of the input that the user can correct.

    The message is one line: what, where, expected and got, what to do. Names from a file are
    printed on one line, with invisible characters escaped and long names cut.
    """

    names_flags: ClassVar[bool] = False

    def __str__(self) -> str:
        """Return the message."""
        return said(cut(shortened_words(super().__str__()), _MAX_MESSAGE))


class RecordingError(GvoError):
    """A recording is missing, unreadable or incomplete."""


class OutputError(RecordingError):
    """A file of a run could not be written: no space, no permission, deleted.

    Attributes
    ----------
    is_partly : bool
        Poses were written before, and remain.
    """

    def __init__(self, message: str, *, is_partly: bool = False) -> None:
        super().__init__(message)
        self.is_partly = is_partly


class RunBusyError(GvoError):
    """Another process is writing the run."""


class CalibrationError(GvoError):
    """A calibration is missing or does not describe a usable camera."""


class ConfigurationError(GvoError):
    """A configuration file or setting is unknown, malformed or out of range."""


class SmoothingError(GvoError):
    """The window could not add a pose; it is unchanged."""


class TrajectoryError(GvoError):
    """A trajectory file is missing, malformed or cannot be associated."""


@contextmanager
def named_faults(
    kind: type[GvoError], where: object, what: str = "", others: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Raise errors of the operating system, and others, as a `GvoError`.

    Parameters
    ----------
    kind : type
    where : object
        Named in the message; of what the error itself names the file, if `what` is omitted.
    what : str
        Could not be done, as in "cannot be written".
    others : tuple of type
        Types of errors that a library raises for it.
    """
    try:
        yield
    except (OSError, *others) as error:  # type: ignore[misc]  # a tuple of types
        if isinstance(error, BrokenPipeError) and not what:
            raise
        filename = getattr(error, "filename", None)
        name = where if what or filename is None else filename
        reason = getattr(error, "strerror", None) or error
        reason = f"{what}: {reason}" if what else reason
        raise kind(f"{name}: {reason}") from error


def write_faults(
    kind: type[GvoError], where: object, *others: type[Exception]
) -> AbstractContextManager[None]:
    """Raise errors of the system, and others, as a `GvoError`: `where` cannot be written."""
    return named_faults(kind, where, "cannot be written", others)


def missing_extra(what: str, extra: str) -> ConfigurationError:
    """Return the error of a package that is not installed, with the line that installs it.

    Parameters
    ----------
    what : str
        What needs which package.
    extra : str
        Of gvo's own packages.
    """
    line = shlex.join([sys.executable, "-m", "pip", "install", f"{_origin()}[{extra}]"])
    return ConfigurationError(f"{what}; install it by: {line}")


def _origin() -> str:
    """Return what pip is to be given: the folder or file that gvo was installed from."""
    # Loaded here: they take longer to import than all else of this module.
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    clone = Path(__file__).parents[1]
    if (clone / "pyproject.toml").is_file():
        return str(clone)
    try:
        url = json.loads(distribution("gvo").read_text("direct_url.json") or "{}").get("url", "")
    except PackageNotFoundError:
        url = ""
    path = url2pathname(urlsplit(url).path)
    return path if url.startswith("file:") and Path(path).exists() else "gvo"
