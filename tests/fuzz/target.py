"""What a fuzzing target is, and what all of them use."""

import random
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gvo.errors import GvoError

MAX_BYTES = 4096
"""Of an input, where the target does not say otherwise."""

T = TypeVar("T")

Mutate = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True, kw_only=True)
class Target:
    """A function of the package that reads what nobody vouches for.

    `run` gets any bytes. It may raise a `GvoError`, or one of `documented` where the function it
    calls says so; anything else is a finding. `mutate` keeps a structure intact that bytes changed
    at random would break at once.
    """

    name: str
    run: Callable[[bytes], object]
    seeds: Callable[[], Sequence[bytes]]
    documented: tuple[type[Exception], ...] = ()
    mutate: Mutate | None = None
    max_bytes: int = MAX_BYTES

    def execute(self, data: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                self.run(data)
            except GvoError as error:
                check_message(error)
            except self.documented:
                return


def check_message(error: Exception) -> None:
    """Raise where a message is more than a line that can be shown."""
    text = str(error)
    if isinstance(error, GvoError) and ("\n" in text or len(text) > 5000):
        raise AssertionError(f"a message of {len(text)} characters: {text[:200]!r}") from error


class Folder:
    """A folder whose files are written anew for each execution, in memory where that goes."""

    def __init__(self) -> None:
        shared = Path("/dev/shm")
        self._held = tempfile.TemporaryDirectory(
            prefix="gvo-fuzz-", dir=shared if shared.is_dir() else None
        )
        self.path = Path(self._held.name)

    def write(self, name: str, data: bytes) -> Path:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path


class Choices:
    """Values chosen by the bytes of an input, until they end: then everything is zero."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    @property
    def rest(self) -> bytes:
        return self._data[self._position :]

    def take(self, n_bytes: int) -> bytes:
        """Return the next bytes, filled up with zeros."""
        found = self._data[self._position : self._position + n_bytes]
        self._position += n_bytes
        return found.ljust(n_bytes, b"\0")

    def integer(self, n_bytes: int, *, signed: bool = False) -> int:
        return int.from_bytes(self.take(n_bytes), "little", signed=signed)

    def below(self, limit: int) -> int:
        return self.integer(2 if limit > 256 else 1) % limit

    def pick(self, values: Sequence[T]) -> T:
        return values[self.below(len(values))]
