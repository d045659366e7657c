"""Names of the files that pictures and pages are written to."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from gvo.errors import ConfigurationError

FIGURES = (".png", ".pdf", ".svg")
PAGES = (".html", ".htm")


def check_suffix(path: Path | None, expected: Collection[str] = FIGURES) -> None:
    """Refuse the name of a file, if any, that has another suffix; by default that of a plot.

    Raises
    ------
    ConfigurationError
        With what is expected.
    """
    if path is not None and path.suffix.lower() not in expected:
        raise ConfigurationError(
            f"{path}: expected a name ending in {', '.join(expected)}, got "
            f"{path.suffix or 'no ending'}"
        )
