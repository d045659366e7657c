"""Loaded by the workers of this machine when they start: Ctrl-C is for the client alone.

A terminal sends it to all of its processes. The client ends its workers itself, and says so; they
would but print where they were.
"""

from __future__ import annotations

import signal


def dask_setup(worker: object) -> None:
    """Ignore SIGINT in the process of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
