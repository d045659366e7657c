"""Many recordings, many configurations, on one machine or a Dask cluster.

Needs the extra `batch`.

Examples
--------
>>> import gvo.batch
>>> table = gvo.batch.run("recordings", out="results")  # doctest: +SKIP
"""

from gvo.errors import missing_extra

try:
    from gvo.batch.engine import BatchProgress, ClusterError, connected
    from gvo.batch.inputs import find_recordings, make_variants
    from gvo.batch.running import run, run_batch
    from gvo.batch.tasks import BatchOptions
except ModuleNotFoundError as error:
    package = (error.name or "").partition(".")[0]
    if package not in ("dask", "distributed", "pandas"):
        raise
    raise missing_extra(f"batches need {package}", "batch") from error

__all__ = [
    "BatchOptions",
    "BatchProgress",
    "ClusterError",
    "connected",
    "find_recordings",
    "make_variants",
    "run",
    "run_batch",
]
