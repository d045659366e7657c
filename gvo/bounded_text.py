"""Text files read up to a size, and what they say shown up to a length."""

from __future__ import annotations

import errno
from pathlib import Path

MAX_TEXT_BYTES = 1 << 28
"""Of a table: poses of a day at 30 a second."""

MAX_SHOWN = 80
"""Characters of a value in a message."""


def shortened(value: object) -> str:
    """Return a value of a file on one line of a message, cut where it is long."""
    return cut(repr(value), MAX_SHOWN)


def cut(text: str, n_characters: int) -> str:
    r"""Return a text on one line, cut where it is longer, as it can be written everywhere.

    What is no character to be seen is escaped: a topic's name shall not steer a terminal.

    Examples
    --------
    >>> cut("a\nb", 20)
    'a\\nb'
    """
    start = text[: n_characters + 1]
    if not start.isprintable():
        start = "".join(
            character if character.isprintable() else repr(character)[1:-1] for character in start
        )
    return start if len(start) <= n_characters else f"{start[:n_characters]}..."


def exists(path: Path) -> bool:
    """Tell whether there is such a file or folder that can be looked at; a name can be none."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def read_text(path: Path, *, max_bytes: int = MAX_TEXT_BYTES, encoding: str = "utf-8") -> str:
    """Read a text file that is not larger than it may be.

    Parameters
    ----------
    path : Path
        File; also a pipe, or a device that never ends.
    max_bytes : int
        More are not read.
    encoding : str
        "utf-8", or "utf-8-sig" where a mark at the start is to be left out.

    Returns
    -------
    str
        With the line ends as Python reads them.

    Raises
    ------
    OSError
        When it cannot be read, or holds more; `strerror` says so.
    UnicodeDecodeError
        When it is no text.
    """
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"it holds more than {max_bytes} bytes")
    return data.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
