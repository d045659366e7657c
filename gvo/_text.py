"""Text: files and YAML read within bounds, values shortened for messages, tables aligned.

A few lines of YAML can stand for gigabytes: aliases of aliases, merged keys, numbers of a million
digits. What is read here is bounded before any value is made of it.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import yaml

MAX_TEXT_BYTES = 1 << 28
"""Of a table: poses of a day at 30 a second."""

MAX_SHOWN = 80
"""Characters of a value in a message."""

MAX_CHARACTERS = 1 << 18
"""Of a text; a configuration with all its comments has a thirtieth."""

MAX_VALUES = 100_000
"""Values, keys and lists, each counted as often as aliases repeat it."""

_MAX_NUMBER = 250  # characters; in any notation a float can hold it
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")

# Dates that are none, numbers too long and tags that do not fit their values come as these.
_VALUE_FAULTS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


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


def format_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    is_text: bool = False,
    measured: Sequence[Sequence[str]] | None = None,
) -> str:
    """Return lines, each with its line end, whose columns are aligned by blanks.

    Parameters
    ----------
    header : sequence of str
        Of k columns.
    rows : sequence of sequences of str
        Of k cells each.
    is_text : bool
        All columns to the left; else names to the left, numbers to the right, below a rule.
    measured : sequence of sequences of str, optional
        Rows that the widths of the columns follow; all of them where omitted.

    Examples
    --------
    >>> print(format_table(("name", "m"), [("raw", "1.25"), ("smoothed", "0.5")]), end="")
    name         m
    --------------
    raw       1.25
    smoothed   0.5
    """
    table = [header, *rows]
    by = table if measured is None else [header, *measured]
    widths = [max(map(len, column)) for column in zip(*by, strict=True)]
    justify = str.ljust if is_text else str.rjust
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(justify, row[1:], widths[1:])]).rstrip()
        for row in table
    ]
    if not is_text:
        lines.insert(1, "-" * (sum(widths) + 2 * (len(widths) - 1)))
    return "\n".join(lines) + "\n"


class YamlError(Exception):
    """A text that is no YAML, or more than is read; its one line says where or why."""


def load_yaml(
    text: str,
    loader_class: type[yaml.SafeLoader] = yaml.SafeLoader,
    *,
    max_characters: int = MAX_CHARACTERS,
) -> Any:  # noqa: ANN401 - YAML
    """Return what a YAML text holds.

    Parameters
    ----------
    text : str
        Of several documents the first that holds anything counts.
    loader_class : type
        Which tags are known.
    max_characters : int
        Of the text; a number has at most 250.

    Returns
    -------
    object
        Dictionaries, lists, numbers, texts; None where there is nothing.

    Raises
    ------
    YamlError
        When it is no YAML, longer than `max_characters`, or more than `MAX_VALUES` once its
        aliases are followed.
    """
    if len(text) > max_characters:
        raise YamlError(f"{len(text)} characters, expected at most {max_characters}")
    try:
        loader = loader_class(text)
        try:
            return _first_document(loader)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise YamlError(f"line {mark.line + 1}" if mark else _first_line(error)) from error
    except _VALUE_FAULTS as error:
        raise YamlError(_first_line(error)) from error


def _first_document(loader: yaml.SafeLoader) -> Any:  # noqa: ANN401 - YAML
    while loader.check_node():
        node = cast(yaml.Node, loader.get_node())  # there is one, as was asked
        _count_values(node, {})
        document = loader.construct_document(node)
        if document is not None:
            return document
    return None


def _count_values(node: yaml.Node, counted: dict[int, int | None]) -> int:
    """Return how many values a node stands for; by their ids those that were counted."""
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
