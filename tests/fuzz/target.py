"""What a fuzzing target is."""

import atexit
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from gvo.errors import GvoError
from tests.fuzz.mutations import mutate_bytes


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
    mutate: Callable[[bytes, Random], bytes] = mutate_bytes
    is_slow: bool = False

    def execute(self, data: bytes) -> bool:
        """Run; tell whether the bytes were understood."""
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                self.run(data)
            except GvoError as error:
                check_line(str(error))
                return False
            except self.documented:
                return False
        return True


def check_line(text: str) -> None:
    """Check that a message is a line that can be shown."""
    assert "\n" not in text
    assert len(text) <= 5000


@cache
def folder() -> Path:
    """Return the folder of all targets, in memory where that goes."""
    shared = Path("/dev/shm")
    held = tempfile.TemporaryDirectory(prefix="gvo-fuzz-", dir=shared if shared.is_dir() else None)
    atexit.register(held.cleanup)
    return Path(held.name)


def write(name: str, data: bytes) -> Path:
    """Write a file anew."""
    path = folder() / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
