"""Recordings and run folders behind URLs: found, fetched, stored."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from gvo.errors import GvoError, OutputError, RecordingError

_LAST_SLASHES = re.compile(r"(?<![:/])/+$")


def is_url(location: str | Path) -> bool:
    """Tell a URL from a path."""
    return "://" in str(location)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A path or URL, and the file system that it is in.

    Parameters
    ----------
    files : fsspec.AbstractFileSystem
    path : str
        Within it.
    before, after : str
        The rest of a URL: protocol, user and host; the archive that holds the path.
    """

    files: Any
    path: str
    before: str = ""
    after: str = ""

    @classmethod
    def of(cls, location: str | Path) -> Place:
        """Return the place of a path or URL.

        Raises
        ------
        RecordingError
            Where the protocol is unknown, or its package is not installed.
        """
        if not is_url(location):
            # Links are not resolved: on a worker they may lead elsewhere.
            path = os.path.abspath(Path(location).expanduser())  # noqa: PTH100
            return cls(LocalFileSystem(), path)
        with _naming(location):
            files, path = url_to_fs(str(location))
            return cls(files, str(path), *_around(files, str(path), str(location)))

    @property
    def name(self) -> str:
        """The last part of the path."""
        return PurePosixPath(self.path).name

    @property
    def location(self) -> str:
        """Absolute path, or URL."""
        return f"{self.before}{self.path}{self.after}"

    def exists(self) -> bool:
        """Tell whether the path exists."""
        with _naming(self.location):
            return bool(self.files.exists(self.path))

    def is_folder(self) -> bool:
        """Tell whether it is a folder."""
        with _naming(self.location):
            return bool(self.files.isdir(self.path))

    def entries(self) -> list[Place]:
        """List a folder, sorted."""
        with _naming(self.location):
            names = self.files.ls(self.path, detail=False)
        return [replace(self, path=str(name)) for name in sorted(names)]

    def matches(self) -> list[Place]:
        """Expand the path as a pattern, sorted."""
        with _naming(self.location):
            names = self.files.glob(self.path)
        return [replace(self, path=str(name)) for name in sorted(names)]


def fetch(url: str, folder: Path) -> Path:
    """Copy a recording, file or folder, into a folder.

    Returns
    -------
    Path
        Of the copy, under its own name.

    Raises
    ------
    RecordingError
        When it is not there, or cannot be copied.
    """
    place = Place.of(url)
    if not place.exists():
        raise RecordingError(f"{url}: does not exist")
    copy = folder / place.name
    is_folder = place.is_folder()
    with _naming(url):
        # Without the slash a folder would be copied into the copy.
        source = f"{place.path}/" if is_folder else place.path
        place.files.get(source, str(copy), recursive=is_folder)
    return copy


def fetch_file(url: str, target: Path) -> None:
    """Copy a file, if it exists.

    Raises
    ------
    RecordingError
        When it cannot be copied.
    """
    place = Place.of(url)
    if place.exists():
        with _naming(url):
            target.write_bytes(place.files.cat_file(place.path))


def store(folder: Path, url: str) -> None:
    """Copy the contents of a folder below a URL.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    with _naming(url, OutputError):
        place = Place.of(url)
        # File by file: a folder that exists already would be copied into itself.
        for file in sorted(each for each in folder.rglob("*") if each.is_file()):
            target = PurePosixPath(place.path) / file.relative_to(folder).as_posix()
            place.files.makedirs(str(target.parent), exist_ok=True)
            place.files.put_file(str(file), str(target))


def _around(files: Any, path: str, url: str) -> tuple[str, str]:  # noqa: ANN401
    """Return the parts of a URL before its path and after it."""
    first, mark, others = url.partition("::")
    first = _LAST_SLASHES.sub("", first)
    if not first.endswith(path.rstrip("/")):
        first = str(files.unstrip_protocol(path))
    return first.removesuffix(path), mark + others


@contextmanager
def _naming(location: str | Path, kind: type[GvoError] = RecordingError) -> Iterator[None]:
    """Name the location in the errors of a file system."""
    try:
        yield
    except GvoError:
        raise
    except Exception as error:
        # Each file system raises errors of its own, of packages not known here.
        words = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise kind(f"{location}: {words}") from error
