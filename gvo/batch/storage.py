"""Recordings and run folders that lie behind a URL: found, copied here, copied back."""

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
        What a URL has beside the path: protocol, user and host, the archive that it lies in.
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
            # Links stay as they are: on a worker they may lead elsewhere.
            path = os.path.abspath(Path(location).expanduser())  # noqa: PTH100
            return cls(LocalFileSystem(), path)
        with _told(location):
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
        """Tell whether there is anything."""
        with _told(self.location):
            return bool(self.files.exists(self.path))

    def is_folder(self) -> bool:
        """Tell whether it is a folder."""
        with _told(self.location):
            return bool(self.files.isdir(self.path))

    def entries(self) -> list[Place]:
        """Return what a folder holds, sorted."""
        with _told(self.location):
            names = self.files.ls(self.path, detail=False)
        return [replace(self, path=str(name)) for name in sorted(names)]

    def matches(self) -> list[Place]:
        """Return what the path stands for as a pattern, sorted."""
        with _told(self.location):
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
    with _told(url):
        # A folder's contents, where there is a slash at the end; else it would be put inside.
        source = f"{place.path}/" if is_folder else place.path
        place.files.get(source, str(copy), recursive=is_folder)
    return copy


def fetch_file(url: str, target: Path) -> None:
    """Copy one file, where there is one.

    Raises
    ------
    RecordingError
        When it cannot be copied.
    """
    place = Place.of(url)
    if place.exists():
        with _told(url):
            target.write_bytes(place.files.cat_file(place.path))


def store(folder: Path, url: str) -> None:
    """Copy all that a folder holds below a URL.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    with _told(url, OutputError):
        place = Place.of(url)
        # File by file: a folder that is there already would be put into itself.
        for file in sorted(each for each in folder.rglob("*") if each.is_file()):
            target = PurePosixPath(place.path) / file.relative_to(folder).as_posix()
            place.files.makedirs(str(target.parent), exist_ok=True)
            place.files.put_file(str(file), str(target))


def _around(files: Any, path: str, url: str) -> tuple[str, str]:  # noqa: ANN401
    """Return what a URL has before the path and after it."""
    first, mark, others = url.partition("::")
    first = _LAST_SLASHES.sub("", first)
    if not first.endswith(path.rstrip("/")):
        first = str(files.unstrip_protocol(path))
    return first.removesuffix(path), mark + others


@contextmanager
def _told(location: str | Path, kind: type[GvoError] = RecordingError) -> Iterator[None]:
    """Give the errors of a file system the name of what they are about."""
    try:
        yield
    except GvoError:
        raise
    except Exception as error:
        # Each file system has errors of its own, of packages that are not even known here.
        words = str(error) or type(error).__name__
        raise kind(f"{location}: {words}") from error
