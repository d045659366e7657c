"""Many recordings, many configurations, on one machine or a Dask cluster.

Needs the extra `batch`.

Examples
--------
>>> import gvo.batch
>>> table = gvo.batch.run("recordings", out="results")  # doctest: +SKIP
"""

from gvo.errors import missing_extra

try:
    from gvo.batch.engine import BatchProgress as BatchProgress
    from gvo.batch.engine import ClusterError as ClusterError
    from gvo.batch.engine import connected as connected
    from gvo.batch.inputs import find_recordings as find_recordings
    from gvo.batch.inputs import make_variants as make_variants
    from gvo.batch.running import run as run
    from gvo.batch.running import run_batch as run_batch
    from gvo.batch.tasks import BatchOptions as BatchOptions
except ModuleNotFoundError as error:
    package = (error.name or "").partition(".")[0]
    if package not in ("dask", "distributed", "pandas"):
        raise
    raise missing_extra(f"batches need {package}", "batch") from error
