"""Many recordings, many configurations, on one machine or a Dask cluster.

Needs the extra `batch`; Dask is loaded with the first name.

Examples
--------
>>> import gvo.batch
>>> table = gvo.batch.run("recordings", out="results")  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from gvo.errors import missing_extra

if TYPE_CHECKING:
    from gvo.batch.engine import BatchProgress as BatchProgress
    from gvo.batch.engine import ClusterError as ClusterError
    from gvo.batch.engine import connected as connected
    from gvo.batch.inputs import NamedRecording as NamedRecording
    from gvo.batch.inputs import Variant as Variant
    from gvo.batch.inputs import find_recordings as find_recordings
    from gvo.batch.inputs import make_variants as make_variants
    from gvo.batch.running import run as run
    from gvo.batch.running import run_batch as run_batch
    from gvo.batch.tasks import BatchOptions as BatchOptions

_MODULES = {
    "gvo.batch.engine": ("BatchProgress", "ClusterError", "connected"),
    "gvo.batch.inputs": ("NamedRecording", "Variant", "find_recordings", "make_variants"),
    "gvo.batch.running": ("run", "run_batch"),
    "gvo.batch.tasks": ("BatchOptions",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
_NEEDED = ("dask", "distributed", "pandas", "cryptography")

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gvo.batch' has no attribute {name!r}")
    try:
        return getattr(import_module(_MODULE_OF[name]), name)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _NEEDED:
            raise
        raise missing_extra(f"batches need {package}", "batch") from error


def __dir__() -> list[str]:
    """List the public names."""
    return sorted([*globals(), *_MODULE_OF])
