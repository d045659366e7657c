"""Answers to lines of poses and edges, and the lines of a pipe as they come."""

from __future__ import annotations

import csv
import io
import json
import os
import select
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from gvo.geometry import se3
from gvo.sources.edge_lines import MAX_LINE, LineFormat
from gvo.trajectory.formats import COVARIANCE_HEADER
from gvo.types import Estimate, Rejected

CSV_HEADER = (
    "id,stamp_ns,status,x,y,z,qx,qy,qz,qw,"
    + COVARIANCE_HEADER.removeprefix("stamp_ns,")
    + ",rejected"
)
"""Columns of an answer in CSV; written first where the input begins with a header."""

_UPPER = np.triu_indices(6)
_CHUNK_BYTES = 65536
_POLL_SECONDS = 0.2
# What is cut off here is still longer than what is understood.
_MAX_LINE_BYTES = 4 * MAX_LINE + 1


def format_estimate(
    estimate: Estimate, line_format: LineFormat, rejected: Iterable[Rejected] = ()
) -> str:
    """Return the answer to a line, without its line end.

    Parameters
    ----------
    estimate : Estimate
        Of the pose that the line is about.
    line_format : {"csv", "json"}
    rejected : iterable of Rejected
        What was refused beside what the estimate lists.
    """
    T = estimate.T_world_cam
    quaternion = se3.quaternions(T[:3, :3])
    pose = [float(value) for value in (*T[:3, 3], *quaternion)]
    covariance = [float(value) for value in estimate.covariance[_UPPER]]
    reasons = [str(refusal) for refusal in (*estimate.rejected, *rejected)]
    if line_format == "json":
        answer = {
            "id": estimate.frame_id,
            "stamp_ns": estimate.stamp_ns,
            "status": estimate.status.value,
            "pose": pose,
            "covariance": covariance,
            "rejected": reasons,
        }
        return json.dumps(answer, allow_nan=False)
    row = [estimate.frame_id, estimate.stamp_ns, estimate.status.value]
    numbers = [repr(value) for value in (*pose, *covariance)]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow([*row, *numbers, "; ".join(reasons)])
    return buffer.getvalue()


def format_error(reason: str) -> str:
    """Return the answer to a line that asks for nothing possible: JSON in both formats."""
    return json.dumps({"error": reason})


def read_lines(descriptor: int, check: Callable[[], None]) -> Iterator[str]:
    """Yield the lines of a pipe as they come.

    Parameters
    ----------
    descriptor : int
        Of the file, such as 0 for standard input.
    check : callable
        Called while waiting; what it raises ends the waiting.
    """
    rest = b""
    while True:
        check()
        if not select.select([descriptor], [], [], _POLL_SECONDS)[0]:
            continue
        chunk = os.read(descriptor, _CHUNK_BYTES)
        *lines, rest = (rest + chunk).split(b"\n")
        rest = rest[:_MAX_LINE_BYTES]
        for line in lines:
            check()
            yield line.decode("utf-8", errors="replace")
        if not chunk:
            break
    if rest:
        yield rest.decode("utf-8", errors="replace")
