"""Poses and edges as JSON lines, and the answers."""

from __future__ import annotations

import json
import os
import select
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvo._text import MAX_LINE, shortened
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.pose_streams import StepSigma
from gvo.trajectory.formats import from_upper_triangle, upper_triangle
from gvo.trajectory.g2o import transforms_of
from gvo.types import Edge, Estimate, FloatArray, PosePrior, PositionPrior, Prior, Rejected

_MAX_ID = 1000  # characters
_LIMIT = 2**63 - 1
# Of a measurement in the world without a stated noise: radians and metres.
_PRIOR_SIGMAS = np.repeat([0.01, 0.1], 3)
_NOISE_KEYS = frozenset({"sigmas", "covariance", "kernel"})
_EDGE_KEYS = _NOISE_KEYS | {"reference", "pose"}
_PRIOR_KEYS = _NOISE_KEYS | {"position", "pose"}
_KEYS = _EDGE_KEYS | {"id", "stamp_ns", "edges", "prior", "keep"}
_LAYOUTS = {"pose": " (x y z qx qy qz qw)", "covariance": " (its upper triangle)"}
_CHUNK_BYTES = 65536
_POLL_SECONDS = 0.2
_MAX_UNENDED_BYTES = 1 << 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """What one line asks for.

    Parameters
    ----------
    frame_id : str or int
    stamp_ns : int or None
        None: the pose is in the window already.
    edges : tuple of Edge
    prior : PosePrior or PositionPrior, optional
    keep : bool, optional
        Make it a keyframe, or one no longer.
    """

    frame_id: str | int
    stamp_ns: int | None = None
    edges: tuple[Edge, ...] = ()
    prior: Prior | None = None
    keep: bool | None = None


def parse_line(line: str) -> Request:
    """Return what a line of JSON, not empty, asks for; a ValueError says what is wrong with it.

    An object of `id` (text or whole number), `stamp_ns` (whole number; left out for a pose in
    the window), and any of: `edges`, a list of objects of `reference`, `pose` (seven numbers)
    and optionally `sigmas` (six), `covariance` (21) and `kernel`; one edge may stand in the
    object itself; `prior`, an object of `pose` or `position` (three numbers), with `sigmas` or
    `covariance` likewise; `keep`, true or false.

    Examples
    --------
    >>> parse_line('{"id": 0, "stamp_ns": 0}').frame_id
    0
    """
    if len(line) > MAX_LINE:
        raise ValueError(f"the line has more than {MAX_LINE} characters")
    try:
        content = _object(json.loads(line), _KEYS, "a line")
    except RecursionError:
        raise ValueError("not JSON: too many levels") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error}") from None
    if "id" not in content:
        raise ValueError("the id is missing")
    keep = content.get("keep")
    if keep is not None and not isinstance(keep, bool):
        raise ValueError("keep must be true or false")
    edges = content.get("edges", [])
    if not isinstance(edges, list):
        raise ValueError("edges must be a list of objects")
    own = {key: content[key] for key in _EDGE_KEYS if key in content}
    return Request(
        frame_id=_id(content["id"], "id"),
        stamp_ns=_stamp(content.get("stamp_ns")),
        edges=tuple(_edge(edge) for edge in ([own, *edges] if own else edges)),
        prior=_prior(content.get("prior")),
        keep=keep,
    )


def _object(value: object, keys: frozenset[str], what: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} must be an object, got {type(value).__name__}")
    unknown = [key for key in value if key not in keys]
    if unknown:
        raise ValueError(
            f"{what} holds the unknown key {shortened(unknown[0])}; known: "
            f"{', '.join(sorted(keys))}"
        )
    return value


def _id(value: object, name: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int) or value == "":
        raise ValueError(f"{name} must be a text or a whole number, got {shortened(value)}")
    if isinstance(value, int) and abs(value) >= _LIMIT:
        raise ValueError(f"{name} {shortened(value)} has more than 63 bits")
    # JSON can write half of a character, which no file can hold.
    if isinstance(value, str) and (len(value) > _MAX_ID or _has_surrogates(value)):
        raise ValueError(f"{name} {shortened(value)} is not a text of at most {_MAX_ID} characters")
    return value


def _has_surrogates(text: str) -> bool:
    return any("\ud800" <= character <= "\udfff" for character in text)


def _stamp(value: object) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= _LIMIT:
        raise ValueError(f"the stamp {shortened(value)} is not a whole number of nanoseconds")
    return value


def _edge(value: object) -> Edge:
    content = _object(value, _EDGE_KEYS, "an edge")
    if content.get("reference") is None or "pose" not in content:
        raise ValueError("an edge needs a reference and a pose")
    reference_id, T = _id(content["reference"], "reference"), _pose(content)
    covariance = _covariance(content, 6)
    if covariance is None:
        with np.errstate(over="ignore", invalid="ignore"):  # infinite: the window refuses it
            covariance = StepSigma().covariance(T)
    return Edge(
        reference_id=reference_id,
        T_reference_frame=T,
        covariance=covariance,
        kernel=content.get("kernel"),  # type: ignore[arg-type] # checked by Edge
    )


def _prior(value: object) -> Prior | None:
    if value is None:
        return None
    content = _object(value, _PRIOR_KEYS, "a prior")
    if ("position" in content) == ("pose" in content):
        raise ValueError("a prior needs a pose or a position")
    size = 6 if "pose" in content else 3
    covariance = _covariance(content, size)
    noise: dict[str, Any] = {
        "covariance": np.diag(_PRIOR_SIGMAS[-size:] ** 2) if covariance is None else covariance
    }
    if content.get("kernel") is not None:  # checked by the prior
        noise["kernel"] = content["kernel"]
    if "pose" in content:
        return PosePrior(T_world_frame=_pose(content), **noise)
    return PositionPrior(position_world=_numbers(content, "position", 3), **noise)


def _pose(content: Mapping[str, object]) -> FloatArray:
    numbers = _numbers(content, "pose", 7)
    return np.asarray(transforms_of(numbers[np.newaxis])[0])


def _covariance(content: Mapping[str, object], size: int) -> FloatArray | None:
    """Return the covariance of the sigmas, or of the upper triangle; None where there is none."""
    if "sigmas" in content and "covariance" in content:
        raise ValueError("give sigmas or covariance, not both")
    if "covariance" in content:
        return from_upper_triangle(_numbers(content, "covariance", size * (size + 1) // 2))
    if "sigmas" not in content:
        return None
    sigmas = _numbers(content, "sigmas", size)
    if (sigmas < 0.0).any():
        raise ValueError("a sigma is negative")
    with np.errstate(over="ignore"):  # infinite: the window refuses it
        return np.diag(sigmas**2)


def _numbers(content: Mapping[str, object], name: str, n: int) -> FloatArray:
    values = content[name]
    if not isinstance(values, list) or any(
        isinstance(value, bool) or not isinstance(value, int | float) for value in values
    ):
        raise ValueError(f"{name} must be a list of numbers")
    if len(values) != n:
        raise ValueError(f"{name} needs {n} numbers{_LAYOUTS.get(name, '')}, got {len(values)}")
    try:
        return np.array(values, dtype=np.float64)
    except OverflowError:
        raise ValueError(f"a number of {name} is out of range") from None


def format_estimate(estimate: Estimate, rejected: Iterable[Rejected] = ()) -> str:
    """Return the answer to a line, without its line end.

    Parameters
    ----------
    estimate : Estimate
        Of the pose that the line is about.
    rejected : iterable of Rejected
        What was refused beside what the estimate lists.
    """
    T = estimate.T_world_frame
    answer = {
        "id": estimate.frame_id,
        "stamp_ns": estimate.stamp_ns,
        "status": estimate.status.value,
        "pose": [*T[:3, 3].tolist(), *se3.quaternions(T[:3, :3]).tolist()],
        "covariance": upper_triangle(estimate.covariance).tolist(),
        "rejected": [str(refusal) for refusal in (*estimate.rejected, *rejected)],
    }
    return json.dumps(answer, allow_nan=False)


def format_error(reason: str) -> str:
    """Return the answer to a line that asks for nothing possible."""
    return json.dumps({"error": reason})


def read_lines(descriptor: int, check: Callable[[], None]) -> Iterator[str]:
    """Yield the lines of a pipe as they come.

    Parameters
    ----------
    descriptor : int
        Of the file, such as 0 for standard input.
    check : callable
        Called while waiting; what it raises ends the waiting.

    Raises
    ------
    TrajectoryError
        Where a line has no end.
    """
    rest = b""
    while True:
        check()
        if not select.select([descriptor], [], [], _POLL_SECONDS)[0]:
            continue
        chunk = os.read(descriptor, _CHUNK_BYTES)
        *lines, rest = (rest + chunk).split(b"\n")
        if len(rest) > _MAX_UNENDED_BYTES:
            raise TrajectoryError(f"a line has more than {_MAX_UNENDED_BYTES} bytes")
        for line in lines:
            check()
            yield line.decode("utf-8", errors="replace")
        if not chunk:
            break
    if rest:
        yield rest.decode("utf-8", errors="replace")
