"""Compile all kernels now, not in the first run: `python -m gvo.kernels`."""

from __future__ import annotations

import importlib
import pkgutil

from gvo import kernels


def compile_all() -> None:
    """Import each module of kernels, which compiles what is not kept already."""
    for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
        importlib.import_module(module.name)


if __name__ == "__main__":
    compile_all()
