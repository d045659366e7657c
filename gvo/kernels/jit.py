"""Kernels: loops written in Python, compiled once on a machine, kept, and called.

Arithmetic is that of IEEE in the order in which it is written, on one thread: the same bits for
any number of threads, in each run. All kernels are compiled together, by Numba in a process of its
own (`gvo.kernels.compiler`), for the types that are stated; what is kept is machine code, which
LLVM loads without Numba. The place where it is kept is named after all that it depends on: the
version of this package, the sources of its kernels, Numba, and the processor.

With `GVO_KERNELS=python` in the environment kernels are what they look like, and slow.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import importlib.metadata
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from gvo._version import __version__
from gvo.errors import GvoError

_LOGGER = logging.getLogger(__name__)
_FOLDER = Path(__file__).parent
_FILE = "kernels.o"
_N_DIGEST = hashlib.sha256().digest_size
SWITCH = "GVO_KERNELS"
"""Of the environment: `python` leaves kernels as they are."""
_NUMBERS: dict[str, Any] = {"f8": ctypes.c_double, "i8": ctypes.c_int64, "b1": ctypes.c_bool}


class Array(NamedTuple):
    """An argument: a C-contiguous array."""

    dtype: np.dtype[Any]
    ndim: int
    is_written: bool

    def check(self, given: Any) -> None:
        """Refuse what compiled code would misread."""
        flags = given.flags
        is_fit = flags.carray if self.is_written else flags.c_contiguous and flags.aligned
        if not is_fit or given.dtype != self.dtype or given.ndim != self.ndim:
            raise TypeError(
                f"expected a{' writeable' * self.is_written} C-contiguous array of "
                f"{self.dtype} with {self.ndim} axes, got {given.dtype} of shape {given.shape}"
            )


class Signature(NamedTuple):
    """The types of a kernel: of arguments, arrays or codes of numbers, and of what it returns."""

    arguments: tuple[Array | str, ...]
    returns: str | None


def In(dtype: str, ndim: int) -> Array:  # noqa: N802 - reads as a type
    """Return the type of an array that is only read, writeable or not."""
    return Array(np.dtype(dtype), ndim, is_written=False)


def Out(dtype: str, ndim: int) -> Array:  # noqa: N802 - reads as a type
    """Return the type of an array that is written."""
    return Array(np.dtype(dtype), ndim, is_written=True)


def kernel(
    *arguments: Array | str, returns: str | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function for arguments: `In`, `Out`, or the code of a number ("f8", "i8", "b1").

    It neither raises nor makes arrays, but by `vector` and `matrix`.
    """
    signature = Signature(arguments, returns)

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        made = function if is_interpreted() else _call_of(function, signature)
        vars(made)["signature"] = signature
        return made

    return decorate


def helper(function: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a function that kernels call: it is compiled with them."""
    vars(function)["is_helper"] = True
    return function


def vector(n: int) -> Any:
    """Return a small array within a kernel, not filled."""
    return np.empty(n)


def matrix(n_rows: int, n_columns: int) -> Any:
    """Return a small array within a kernel, not filled."""
    return np.empty((n_rows, n_columns))


def is_interpreted() -> bool:
    """Tell whether kernels are left as they are."""
    return os.environ.get(SWITCH) == "python"


def symbol_of(function: Callable[..., Any]) -> str:
    """Return the name of a kernel in the machine code."""
    return f"{function.__module__}.{function.__name__}"


def _call_of(function: Callable[..., Any], signature: Signature) -> Callable[..., Any]:
    """Return a function of Python that checks arguments, and calls the compiled kernel.

    An array is given as the object it is; the kernel reads where its numbers lie.
    """
    types: list[Any] = [
        _NUMBERS[each] if isinstance(each, str) else ctypes.py_object
        for each in signature.arguments
    ]
    returned = None if signature.returns is None else _NUMBERS[signature.returns]
    address = machine_code().get_function_address(symbol_of(function))
    compiled = ctypes.CFUNCTYPE(returned, *types)(address)
    arrays = [
        (place, each.check)
        for place, each in enumerate(signature.arguments)
        if not isinstance(each, str)
    ]

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if len(arguments) != len(types):
            raise TypeError(f"{function.__name__} takes {len(types)} arguments")
        for place, check in arrays:
            check(arguments[place])
        return compiled(*arguments)

    return call


@cache
def machine_code() -> llvm.ExecutionEngine:
    """Return LLVM with the kernels loaded, compiled first where they are not kept."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(_kept_or_compiled(cache_folder())))
    engine.finalize_object()
    return engine


@cache
def cache_folder() -> Path:
    """Return where compiled kernels are kept."""
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    versions = (importlib.metadata.version(name) for name in ("numba", "llvmlite", "numpy"))
    digest = hashlib.sha256("\n".join([*versions, *processor]).encode())
    for path in sorted(_FOLDER.glob("*.py")):
        digest.update(path.read_bytes())
    return Path(home) / "gvo" / f"kernels-{__version__}-{digest.hexdigest()[:16]}"


def _kept_or_compiled(folder: Path) -> bytes:
    """Return machine code; of many processes one compiles, the others wait."""
    code = _read(folder / _FILE)
    if code is not None:
        return code
    if not _is_writeable(folder):
        with tempfile.TemporaryDirectory() as other:
            return _compiled(Path(other) / _FILE, say=_LOGGER.debug)
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        return _read(folder / _FILE) or _compiled(folder / _FILE, say=_LOGGER.warning)


def _is_writeable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _read(path: Path) -> bytes | None:
    """Return machine code if it is as it was written: what is broken would end the process."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    digest, code = data[:_N_DIGEST], data[_N_DIGEST:]
    return code if hashlib.sha256(code).digest() == digest else None


def write(path: Path, code: bytes) -> None:
    """Keep machine code, whole or not at all."""
    part = path.with_suffix(".part")
    part.write_bytes(hashlib.sha256(code).digest() + code)
    part.replace(path)


def _compiled(path: Path, say: Callable[..., None]) -> bytes:
    """Have all kernels compiled into a file, and return what it holds."""
    command = [sys.executable, "-m", "gvo.kernels.compiler", str(path)]
    paths = [str(_FOLDER.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    started = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)  # noqa: S603
    with started as compiler:
        for line in compiler.stdout or ():
            say("compiling, once on this machine: %s", line.strip())
    code = _read(path)
    if code is None:
        raise GvoError(f"the kernels could not be compiled: {' '.join(command)} tells why")
    return code
