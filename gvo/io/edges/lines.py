"""Poses and edges as CSV or JSON lines, and the answers."""

from __future__ import annotations

import csv
import io
import json
import os
import select
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from gvo._text import MAX_LINE, plain_number, shortened
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.pose_streams import StepSigma
from gvo.trajectory.formats import COVARIANCE_HEADER, from_upper_triangle, upper_triangle
from gvo.trajectory.g2o import transforms_of
from gvo.types import Edge, Estimate, FloatArray, PosePrior, PositionPrior, Prior, Rejected

LineFormat: TypeAlias = Literal["csv", "json"]

_MAX_ID = 1000  # characters
# Of a measurement in the world without a stated noise: radians and metres.
_PRIOR_SIGMAS = np.repeat([0.01, 0.1], 3)
_STAMP_LIMIT_NS = 2**63 - 1
_ACTIONS = ("keep", "release")
_NOISE_KEYS = frozenset({"sigmas", "covariance", "kernel"})
_EDGE_KEYS = _NOISE_KEYS | {"reference", "pose"}
_PRIOR_KEYS = _NOISE_KEYS | {"position", "pose"}
_KEYS = _EDGE_KEYS | {"id", "stamp_ns", "edges", "prior", "keep"}
CSV_HEADER = (
    "id,stamp_ns,status,x,y,z,qx,qy,qz,qw,"
    + COVARIANCE_HEADER.removeprefix("stamp_ns,")
    + ",rejected"
)
"""Columns of an answer in CSV; written first where the input begins with a header."""
_LAYOUTS = {"pose": " (x y z qx qy qz qw)", "covariance": " (its upper triangle)"}
_CHUNK_BYTES = 65536
_POLL_SECONDS = 0.2
# What is cut off here is still longer than what is understood.
_MAX_LINE_BYTES = 4 * MAX_LINE + 1
_MAX_UNENDED_BYTES = 1 << 26


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """What one line asks for.

    Parameters
    ----------
    frame_id : str or int
        Of CSV always str.
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


def detect_format(line: str) -> LineFormat:
    """Tell the format by the first line that holds anything."""
    return "json" if line.lstrip().startswith("{") else "csv"


def is_header(line: str) -> bool:
    """Tell whether the first line of CSV names the columns."""
    return line.strip().lower().startswith("id,")


def parse_line(line: str, line_format: LineFormat) -> Request:
    """Return what a line, not empty, asks for; a ValueError says what is wrong with it."""
    if len(line) > MAX_LINE:
        raise ValueError(f"the line has more than {MAX_LINE} characters")
    return parse_json(line) if line_format == "json" else parse_csv(line)


def parse_csv(line: str) -> Request:
    """Return what a line of CSV asks for; its fields become those of a JSON line.

    Examples
    --------
    >>> parse_csv("b,100000000,a,0,0,1,0,0,0,1").edges[0].reference_id
    'a'
    """
    try:
        fields = [field.strip() for field in next(csv.reader([line]), [])]
    except csv.Error as error:
        raise ValueError(f"not a line of CSV: {error}") from None
    if len(fields) < 2:
        raise ValueError(f"expected at least an id and a stamp, got {len(fields)} fields")
    if len(fields) == 2 and fields[0] in _ACTIONS:
        return _request({"id": fields[1], "keep": fields[0] == "keep"})
    content: dict[str, object] = {"id": fields[0], "stamp_ns": _csv_stamp(fields[1])}
    if len(fields) > 3 or (len(fields) == 3 and fields[2]):
        content |= _csv_measurement(fields[2], _csv_numbers(fields[3:]))
    return _request(content)


def _csv_measurement(reference: str, numbers: list[float]) -> dict[str, object]:
    """Return an edge to a reference, or without one a prior, with its noise, as JSON has them."""
    is_position = not reference and len(numbers) in (3, 6, 9)
    n_values, size = (3, 3) if is_position else (7, 6)
    noise = numbers[n_values:]
    n_upper = size * (size + 1) // 2
    if len(noise) not in (0, size, n_upper):
        raise ValueError(
            f"after the measurement come nothing, {size} sigmas or {n_upper} numbers of a "
            f"covariance, got {len(noise)}"
        )
    name = "sigmas" if len(noise) == size else "covariance"
    measured: dict[str, object] = {"position" if is_position else "pose": numbers[:n_values]}
    measured |= {name: noise} if noise else {}
    return {"reference": reference, **measured} if reference else {"prior": measured}


def parse_json(line: str) -> Request:
    """Return what a line of JSON asks for.

    An object of `id` (text or whole number), `stamp_ns` (whole number; left out for a pose in
    the window), and any of: `edges`, a list of objects of `reference`, `pose` (seven numbers)
    and optionally `sigmas` (six), `covariance` (21) and `kernel`; one edge may stand in the
    object itself; `prior`, an object of `pose` or `position` (three numbers), with `sigmas` or
    `covariance` likewise; `keep`, true or false.

    Examples
    --------
    >>> parse_json('{"id": 0, "stamp_ns": 0}').frame_id
    0
    """
    try:
        content = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from None
    return _request(_object(content, _KEYS, "a line"))


def _request(content: Mapping[str, object]) -> Request:
    if "id" not in content:
        raise ValueError("the id is missing")
    keep = content.get("keep")
    if keep is not None and not isinstance(keep, bool):
        raise ValueError("keep must be true or false")
    stamp_ns = content.get("stamp_ns")
    return Request(
        frame_id=_id(content["id"], "id"),
        stamp_ns=None if stamp_ns is None else _stamp(stamp_ns),
        edges=tuple(_edge(edge) for edge in _edges(content)),
        prior=_prior(content.get("prior")),
        keep=keep,
    )


def _id(value: object, name: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int) or value == "":
        raise ValueError(f"{name} must be a text or a whole number, got {shortened(value)}")
    _check_id(value, name)
    return value


def _check_id(value: str | int, name: str) -> None:
    """Refuse what cannot be kept and written for each pose."""
    if isinstance(value, int) and abs(value) >= _STAMP_LIMIT_NS:
        raise ValueError(f"{name} {shortened(value)} has more than 63 bits")
    if isinstance(value, str) and (len(value) > _MAX_ID or not _is_writable(value)):
        raise ValueError(f"{name} {shortened(value)} is not a text of at most {_MAX_ID} characters")


def _is_writable(text: str) -> bool:
    """Tell whether a text has no half of a character, as JSON can write it."""
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _csv_stamp(text: str) -> int | None:
    try:
        return int(plain_number(text)) if text else None
    except ValueError:
        raise ValueError(
            f"the stamp {shortened(text)} is not a whole number of nanoseconds"
        ) from None


def _csv_numbers(fields: list[str]) -> list[float]:
    try:
        return [float(plain_number(field)) for field in fields]
    except ValueError as error:
        raise ValueError(f"{error}; expected numbers after the reference") from None


def _stamp(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= _STAMP_LIMIT_NS:
        raise ValueError(f"the stamp {shortened(value)} is not a whole number of nanoseconds")
    return value


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


def _edges(content: Mapping[str, object]) -> list[dict[str, object]]:
    """Return the edges of a line: the one that stands in the line itself, and the list."""
    edges = content.get("edges", [])
    if not isinstance(edges, list):
        raise ValueError("edges must be a list of objects")
    own = {key: content[key] for key in _EDGE_KEYS if key in content}
    return [*([own] if own else []), *(_object(edge, _EDGE_KEYS, "an edge") for edge in edges)]


def _edge(content: Mapping[str, object]) -> Edge:
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


def _prior(content: object) -> Prior | None:
    if content is None:
        return None
    content = _object(content, _PRIOR_KEYS, "a prior")
    if ("position" in content) == ("pose" in content):
        raise ValueError("a prior needs a pose or a position")
    kernel = content.get("kernel")
    chosen: dict[str, Any] = {} if kernel is None else {"kernel": kernel}  # checked by the prior
    if "pose" in content:
        covariance = _covariance(content, 6)
        covariance = np.diag(_PRIOR_SIGMAS**2) if covariance is None else covariance
        return PosePrior(T_world_frame=_pose(content), covariance=covariance, **chosen)
    position = _numbers(content, "position", 3)
    covariance = _covariance(content, 3)
    covariance = np.diag(_PRIOR_SIGMAS[3:] ** 2) if covariance is None else covariance
    return PositionPrior(position_world=position, covariance=covariance, **chosen)


def _pose(content: Mapping[str, object]) -> FloatArray:
    numbers = _numbers(content, "pose", 7)
    return np.asarray(transforms_of(numbers[np.newaxis])[0])


def _covariance(content: Mapping[str, object], size: int) -> FloatArray | None:
    """Return the covariance of the sigmas, or of the upper triangle; None where there is none."""
    if "sigmas" in content and "covariance" in content:
        raise ValueError("give sigmas or covariance, not both")
    if "sigmas" in content:
        sigmas = _numbers(content, "sigmas", size)
        if (sigmas < 0.0).any():
            raise ValueError("a sigma is negative")
        with np.errstate(over="ignore"):  # infinite: the window refuses it
            return np.diag(sigmas**2)
    if "covariance" in content:
        return from_upper_triangle(_numbers(content, "covariance", size * (size + 1) // 2))
    return None


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
    T = estimate.T_world_frame
    quaternion = se3.quaternions(T[:3, :3])
    pose = [float(value) for value in (*T[:3, 3], *quaternion)]
    covariance = upper_triangle(estimate.covariance).tolist()
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

    Raises
    ------
    TrajectoryError
        Where a line has no end.
    """
    rest = b""
    n_cut = 0
    while True:
        check()
        if not select.select([descriptor], [], [], _POLL_SECONDS)[0]:
            continue
        chunk = os.read(descriptor, _CHUNK_BYTES)
        *lines, rest = (rest + chunk).split(b"\n")
        n_cut = max(0, len(rest) - _MAX_LINE_BYTES) + (0 if lines else n_cut)
        if n_cut > _MAX_UNENDED_BYTES:
            raise TrajectoryError(f"a line has more than {_MAX_UNENDED_BYTES} bytes")
        rest = rest[:_MAX_LINE_BYTES]
        for line in lines:
            check()
            yield line.decode("utf-8", errors="replace")
        if not chunk:
            break
    if rest:
        yield rest.decode("utf-8", errors="replace")
