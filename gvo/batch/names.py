"""Names of folders: of signs that every disk takes, each one once."""

from __future__ import annotations

import re
from collections.abc import Container

_UNSAFE = re.compile(r"[^A-Za-z0-9._=,+-]+")
_MAX_NAME = 150


def safe_name(text: str) -> str:
    """Return a text as the name of a folder.

    Examples
    --------
    >>> safe_name("day 1/../drive")
    'day_1_.._drive'
    """
    return _UNSAFE.sub("_", text).lstrip(".")[:_MAX_NAME] or "_"


def free_name(name: str, taken: Container[str]) -> str:
    """Return a name that is not taken: with a number where it is.

    Examples
    --------
    >>> free_name("drive", {"drive", "drive-2"})
    'drive-3'
    """
    free, number = name, 2
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free
