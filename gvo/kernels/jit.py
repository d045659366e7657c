"""How kernels are compiled: once on a machine, and kept in a cache.

Arithmetic is that of IEEE in the order in which it is written, on one thread: the same bits for
any number of threads, in each run. A kernel is compiled for the types that are stated, when its
module is imported. The cache has a folder for each version of this package, of its kernels and
of Numba, since Numba itself does not notice where a function of another file changed.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import types

from gvo._version import __version__

_LOGGER = logging.getLogger(__name__)
_SOURCES = sorted(Path(__file__).parent.glob("*.py"))
_DTYPES: dict[str, Any] = {
    "f4": types.float32,
    "f8": types.float64,
    "i8": types.int64,
    "u1": types.uint8,
    "u2": types.uint16,
    "b1": types.boolean,
}
# Numba's stubs know neither all options nor what is set by the environment.
_njit: Any = numba.njit
_config: Any = numba.config
_OPTIONS = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
# Kernels seen so far, and how many of them had to be compiled.
_COUNTS = {"seen": 0, "compiled": 0}


def In(dtype: str, ndim: int) -> types.Array:  # noqa: N802 - reads as a type
    """Return the type of an array, C-contiguous, that is only read, writeable or not."""
    return types.Array(_DTYPES[dtype], ndim, "C", readonly=True)


def Out(dtype: str, ndim: int) -> types.Array:  # noqa: N802 - reads as a type
    """Return the type of an array, C-contiguous, that is written."""
    return types.Array(_DTYPES[dtype], ndim, "C")


def kernel(*signature: types.Type | str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function for one signature: `In`, `Out`, or the code of a number ("f8")."""
    arguments = tuple(_DTYPES[each] if isinstance(each, str) else each for each in signature)

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if _config.DISABLE_JIT:
            return function
        with _cached_in(cache_folder()):
            compiled = _njit(**_OPTIONS, cache=cache_folder() is not None)(function)
            compiled.compile(arguments)
        compiled.disable_compile()
        if cache_folder() is not None:
            _report(not compiled.stats.cache_hits)
        return compiled  # type: ignore[no-any-return]

    return decorate


def helper(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function that kernels call: compiled with each of them."""
    return _njit(**_OPTIONS, no_cpython_wrapper=True)(function)  # type: ignore[no-any-return]


@cache
def cache_folder() -> Path | None:
    """Return where compiled kernels are kept; None where nothing can be written."""
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    digest = hashlib.sha256(numba.__version__.encode())
    for path in _SOURCES:
        digest.update(path.read_bytes())
    folder = Path(home) / "gvo" / f"kernels-{__version__}-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


@contextmanager
def _cached_in(folder: Path | None) -> Iterator[None]:
    """Let Numba keep what it compiles in a folder, one thread at a time: the others wait."""
    lock = nullcontext() if folder is None else _locked(folder / "lock")
    with lock:
        before, _config.CACHE_DIR = _config.CACHE_DIR, "" if folder is None else str(folder)
        try:
            yield
        finally:
            _config.CACHE_DIR = before


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@cache
def n_kernels() -> int:
    """Return the number of kernels in this package."""
    return sum(path.read_text("utf-8").count("\n@kernel(") for path in _SOURCES)


def _report(is_compiled: bool) -> None:
    """Say now and then what takes so long."""
    _COUNTS["seen"] += 1
    if is_compiled:
        if _COUNTS["compiled"] % 10 == 0:
            text = "compiling, once on this machine: %d of %d"
            _LOGGER.warning(text, _COUNTS["seen"], n_kernels())
        _COUNTS["compiled"] += 1
