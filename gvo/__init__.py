"""Visual odometry for calibrated stereo and RGB-D cameras, with a sliding-window back-end.

The public names stand in `__init__.pyi`. They are loaded when they are first used, so that the
command line answers at once.
"""

import ast
import os
from importlib import import_module
from pathlib import Path

# OpenCV reads it as it is imported: a damaged header must not make it allocate gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "100000000")

_MODULE_OF = {
    name.name: str(statement.module)
    for statement in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(statement, ast.ImportFrom)
    for name in statement.names
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gvo' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
