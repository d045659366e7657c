"""Text: files and YAML read within bounds, values shortened for messages, aligned tables.

A few lines of YAML can expand to gigabytes by aliases of aliases, merged keys, or numbers of a
million digits: `load_yaml` checks the size before any value is constructed.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import yaml

MAX_TEXT_BYTES = 1 << 28
"""Largest text file, bytes: poses of a day at 30 Hz."""

MAX_LINE = 1 << 20
"""Characters of a line; an edge with its covariance has a thousandth."""

MAX_SHOWN = 80
"""Largest length of a value in a message, characters."""

MAX_WIDTH = 80
"""Characters of a line of a table, as many as terminals have at least."""

MAX_CHARACTERS = 1 << 18
"""Largest YAML text, characters; a configuration with all comments has a thirtieth."""

MAX_VALUES = 100_000
"""Largest number of YAML values and keys, with aliases expanded."""

_LONG_WORD = re.compile(r"\S{251,}")
_MAX_NUMBER = 250  # characters; no float needs more
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")

# Raised by PyYAML for invalid dates, numbers that are too long, and tags of other types.
_FAULTS = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)


def shortened(value: object) -> str:
    """Return a value for a message: its repr on one line, cut to `MAX_SHOWN` characters."""
    return cut(repr(value), MAX_SHOWN)


def cut(text: str, n_characters: int) -> str:
    r"""Return a text on one line, cut to a length, with unprintable characters escaped.

    So a topic's name cannot control a terminal.

    Examples
    --------
    >>> cut("a\nb", 20)
    'a\\nb'
    """
    start = visible(text[: n_characters + 1])
    return start if len(start) <= n_characters else f"{start[:n_characters]}..."


def shortened_words(text: str) -> str:
    """Return a message in which no word is longer than a path may be in a message."""
    return _LONG_WORD.sub(lambda word: f"{word[0][:150]}...{word[0][-50:]}", text)


def visible(text: str) -> str:
    r"""Escape control, invisible and direction-changing characters.

    Examples
    --------
    >>> visible("/cam\x1b[2J\u202e")
    '/cam\\x1b[2J\\u202e'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def plain_number(text: str) -> str:
    """Return the text of a number for `float`, `int` or `Decimal`.

    Raises
    ------
    ValueError
        For digits of other scripts and underscores, which those take.
    """
    if not _is_plain(text):
        raise ValueError(f"{shortened(text)} is no decimal number")
    return text


def plain_floats(texts: Sequence[str]) -> list[float]:
    """Return many numbers; raises ValueError as `plain_number` and `float` do."""
    if not _is_plain("".join(texts)):
        texts = [plain_number(text) for text in texts]
    return [float(text) for text in texts]


def _is_plain(text: str) -> bool:
    return text.isascii() and "_" not in text


def format_stamp(stamp_ns: int) -> str:
    """Return a stamp in seconds with nine decimals, without loss.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.

    Examples
    --------
    >>> format_stamp(1403636579763555584)
    '1403636579.763555584'
    """
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"


def access_fault(path: Path) -> str:
    """Return why a path is not there, as the end of a message; empty where it is."""
    try:
        path.stat()
    except PermissionError as error:
        return f"cannot be read: {error.strerror}"
    except (OSError, ValueError):
        return "does not exist"
    return ""


def exists(path: Path) -> bool:
    """Tell whether a path exists and can be accessed; False for an invalid name."""
    return not access_fault(path)


def text_lines(
    path: Path, fault: type[Exception], *, max_lines: int | None = None
) -> Iterator[tuple[int, str]]:
    """Yield numbers, from one, and lines of a text file, one at a time.

    Parameters
    ----------
    path : Path
        File, pipe or device.
    fault : type
        Raised if it cannot be read, is no text, or a line has more than `MAX_LINE` characters.
    max_lines : int, optional
        All is held in memory: no more than as many lines, and `MAX_TEXT_BYTES`.
    """
    n_left = MAX_TEXT_BYTES
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = iter(partial(file.readline, MAX_LINE + 1), "")
            for number, line in enumerate(lines, start=1):
                n_left -= len(line)
                if len(line) > MAX_LINE:
                    raise fault(f"{path}: a line has more than {MAX_LINE} characters")
                if max_lines is not None and (n_left < 0 or number > max_lines):
                    limits = f"{MAX_TEXT_BYTES} bytes or {max_lines} lines"
                    raise fault(f"{path}: holds more than {limits}")
                yield number, line
    except OSError as error:
        raise fault(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise fault(f"{path}: is no text file") from error


def read_text(path: Path, *, max_bytes: int) -> str:
    r"""Read a text file of limited size, with line ends as \n.

    Parameters
    ----------
    path : Path
        File, pipe or device.
    max_bytes : int
        Largest size.

    Raises
    ------
    OSError
        If it cannot be read or is larger; `strerror` says so.
    UnicodeDecodeError
        If it is no text.
    """
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"it holds more than {max_bytes} bytes")
    return data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def wrapped(text: str, indent: str = "", *, width: int = MAX_WIDTH) -> list[str]:
    """Return lines of at most so many characters; a longer word is not broken."""
    options: Any = {"break_long_words": False, "break_on_hyphens": False}
    return wrap(text, width, subsequent_indent=indent, **options)


def number_text(value: float | None, form: str = ".4g") -> str:
    """Return a number as text; a dash if it is None or NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:{form}}"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of text: the first column aligned left, others right, a rule below the header.

    Parameters
    ----------
    header : sequence of str
        Of k columns.
    rows : sequence of sequences of str
        Of k cells each.

    Examples
    --------
    >>> print(format_table(("name", "m"), [("raw", "1.25"), ("smoothed", "0.5")]), end="")
    name         m
    --------------
    raw       1.25
    smoothed   0.5
    """
    table = [[visible(cell) for cell in row] for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in table
    ]
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines) + "\n"


class YamlError(Exception):
    """Invalid or too large YAML; its one line says where or why."""


def load_yaml(
    text: str,
    loader_class: type[yaml.SafeLoader] | None = None,
    *,
    max_characters: int = MAX_CHARACTERS,
) -> Any:  # noqa: ANN401 - YAML
    """Load YAML within bounds.

    Parameters
    ----------
    text : str
        Of several documents the first that is not empty is loaded.
    loader_class : type
        Defines the known tags.
    max_characters : int
        Largest length of the text.

    Returns
    -------
    object
        Dictionaries, lists, numbers, strings; None for an empty text.

    Raises
    ------
    YamlError
        If it is no YAML, longer than `max_characters`, holds more than `MAX_VALUES` values with
        its aliases expanded, or a number of more than 250 characters.
    """
    import yaml  # slow to import, and the command line rarely needs it

    if len(text) > max_characters:
        raise YamlError(f"{len(text)} characters, expected at most {max_characters}")
    try:
        loader = (loader_class or yaml.SafeLoader)(text)
        try:
            return _first_document(loader)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise YamlError(f"line {mark.line + 1}" if mark else _first_line(error)) from error
    except _FAULTS as error:
        raise YamlError(_first_line(error)) from error


def _first_document(loader: yaml.SafeLoader) -> Any:  # noqa: ANN401 - YAML
    while loader.check_node():
        node = cast("yaml.Node", loader.get_node())  # check_node found one
        _count_values(node, {})
        document = loader.construct_document(node)
        if document is not None:
            return document
    return None


def _count_values(node: yaml.Node, counted: dict[int, int | None]) -> int:
    """Return the number of values of a node with aliases expanded; `counted` is by node id."""
    key = id(node)
    if key in counted:
        known = counted[key]
        if known is None:
            raise YamlError(f"line {node.start_mark.line + 1}: a value holds itself")
        return known
    counted[key] = None
    n_values = 1 + sum(_count_values(child, counted) for child in _children(node))
    if n_values > MAX_VALUES:
        raise YamlError(f"more than {MAX_VALUES} values")
    counted[key] = n_values
    return n_values


def _children(node: yaml.Node) -> list[yaml.Node]:
    import yaml

    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    if isinstance(node, yaml.SequenceNode):
        return list(node.value)
    if node.tag in _NUMBERS and len(node.value) > _MAX_NUMBER:
        raise YamlError(f"line {node.start_mark.line + 1}: a number of {len(node.value)} digits")
    return []


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return f"{lines[0][:200] if lines else type(error).__name__}"
