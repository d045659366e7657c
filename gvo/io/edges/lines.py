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
    """Return what a line asks for.

    Parameters
    ----------
    line : str
        Not empty.
    line_format : {"csv", "json"}

    Raises
    ------
    ValueError
        Saying what is wrong with the line.
    """
    if len(line) > MAX_LINE:
        raise ValueError(f"the line has more than {MAX_LINE} characters")
    return parse_json(line) if line_format == "json" else parse_csv(line)


def parse_csv(line: str) -> Request:
    """Return what a line of CSV asks for; the fields are those of the module's table.

    Examples
    --------
    >>> parse_csv("b,100000000,a,0,0,1,0,0,0,1").edges[0].reference_id
    'a'
    """
    try:
        fields = [field.strip() for field in next(csv.reader([line]), [])]
    except csv.Error as error:
        raise ValueError(f"no line of CSV: {error}") from None
    if len(fields) == 2 and fields[0] in _ACTIONS:
        return Request(frame_id=_csv_id(fields[1]), keep=fields[0] == "keep")
    if len(fields) < 2:
        raise ValueError(f"expected at least an id and a stamp, got {len(fields)} fields")
    frame_id = _csv_id(fields[0])
    stamp_ns = None if not fields[1] else _csv_stamp(fields[1])
    if len(fields) == 2 or (len(fields) == 3 and not fields[2]):
        return Request(frame_id=frame_id, stamp_ns=stamp_ns)
    numbers = _numbers(fields[3:])
    if fields[2]:
        edge = _edge(fields[2], numbers[:7], _noise(numbers[7:], 6))
        return Request(frame_id=frame_id, stamp_ns=stamp_ns, edges=(edge,))
    n_values = 3 if len(numbers) in (3, 6, 9) else 7
    noise = _noise(numbers[n_values:], 3 if n_values == 3 else 6)
    return Request(frame_id=frame_id, stamp_ns=stamp_ns, prior=_prior(numbers[:n_values], noise))


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
        raise ValueError(f"no JSON: {error}") from None
    content = _object(content, _KEYS, "a line")
    if "id" not in content:
        raise ValueError("the id is missing")
    keep = content.get("keep")
    if keep is not None and not isinstance(keep, bool):
        raise ValueError("keep must be true or false")
    stamp_ns = content.get("stamp_ns")
    return Request(
        frame_id=_json_id(content["id"], "id"),
        stamp_ns=None if stamp_ns is None else _json_stamp(stamp_ns),
        edges=tuple(_json_edge(edge) for edge in _json_edges(content)),
        prior=_json_prior(content.get("prior")),
        keep=keep,
    )


def _csv_id(text: str) -> str:
    if not text:
        raise ValueError("the id is empty")
    _check_id(text, "id")
    return text


def _json_id(value: object, name: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int) or value == "":
        raise ValueError(f"{name} must be a text or a whole number, got {shortened(value)}")
    _check_id(value, name)
    return value


def _check_id(value: str | int, name: str) -> None:
    """Refuse what cannot be kept and written for each pose."""
    if isinstance(value, int) and abs(value) >= _STAMP_LIMIT_NS:
        raise ValueError(f"{name} {shortened(value)} has more than 63 bits")
    if isinstance(value, str) and (len(value) > _MAX_ID or not _is_writable(value)):
        raise ValueError(f"{name} {shortened(value)} is no text of at most {_MAX_ID} characters")


def _is_writable(text: str) -> bool:
    """Tell whether a text has no half of a character, as JSON can write it."""
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _csv_stamp(text: str) -> int:
    try:
        return _json_stamp(int(plain_number(text)))
    except ValueError:
        raise ValueError(f"the stamp {shortened(text)} is no whole number of nanoseconds") from None


def _json_stamp(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= _STAMP_LIMIT_NS:
        raise ValueError(f"the stamp {shortened(value)} is no whole number of nanoseconds")
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


def _json_edges(content: Mapping[str, object]) -> list[dict[str, object]]:
    """Return the edges of a line: the one that stands in the line itself, and the list."""
    edges = content.get("edges", [])
    if not isinstance(edges, list):
        raise ValueError("edges must be a list of objects")
    own = {key: content[key] for key in _EDGE_KEYS if key in content}
    return [*([own] if own else []), *(_object(edge, _EDGE_KEYS, "an edge") for edge in edges)]


def _json_edge(content: Mapping[str, object]) -> Edge:
    if content.get("reference") is None or "pose" not in content:
        raise ValueError("an edge needs a reference and a pose")
    reference_id = _json_id(content["reference"], "reference")
    noise = _json_noise(content, 6)
    return _edge(reference_id, _json_numbers(content, "pose"), noise, content.get("kernel"))


def _json_prior(content: object) -> Prior | None:
    if content is None:
        return None
    content = _object(content, _PRIOR_KEYS, "a prior")
    name, size = ("position", 3) if "position" in content else ("pose", 7)
    if name not in content or ("position" in content and "pose" in content):
        raise ValueError("a prior needs a pose or a position")
    values = _json_numbers(content, name)
    if len(values) != size:
        raise ValueError(f"a {name} needs {size} numbers, got {len(values)}")
    noise = _json_noise(content, 3 if size == 3 else 6)
    return _prior(values, noise, content.get("kernel"))


def _json_noise(content: Mapping[str, object], size: int) -> FloatArray | None:
    if "sigmas" in content and "covariance" in content:
        raise ValueError("give sigmas or covariance, not both")
    if "sigmas" in content:
        sigmas = _json_numbers(content, "sigmas")
        if len(sigmas) != size:
            raise ValueError(f"sigmas need {size} numbers, got {len(sigmas)}")
        return _noise(sigmas, size)
    if "covariance" not in content:
        return None
    upper = _json_numbers(content, "covariance")
    if len(upper) != size * (size + 1) // 2:
        raise ValueError(
            f"a covariance needs the {size * (size + 1) // 2} numbers of its upper triangle, "
            f"got {len(upper)}"
        )
    return _noise(upper, size)


def _json_numbers(content: Mapping[str, object], name: str) -> FloatArray:
    values = content[name]
    is_number = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    )
    if not is_number:
        raise ValueError(f"{name} must be a list of numbers")
    try:
        return np.array(values, dtype=np.float64)
    except OverflowError:
        raise ValueError(f"a number of {name} is out of range") from None


def _numbers(fields: list[str]) -> FloatArray:
    try:
        return np.array([float(plain_number(field)) for field in fields])
    except ValueError as error:
        raise ValueError(f"{error}; expected numbers after the reference") from None


def _noise(numbers: FloatArray, size: int) -> FloatArray | None:
    """Return the covariance of sigmas, or of an upper triangle; None where there are none."""
    n_upper = size * (size + 1) // 2
    if len(numbers) == 0:
        return None
    if len(numbers) == size:
        if (numbers < 0.0).any():
            raise ValueError("a sigma is negative")
        with np.errstate(over="ignore"):  # infinite: the window refuses it
            return np.diag(numbers**2)
    if len(numbers) != n_upper:
        raise ValueError(
            f"after the measurement come nothing, {size} sigmas or {n_upper} numbers of a "
            f"covariance, got {len(numbers)}"
        )
    return from_upper_triangle(numbers)


def _pose(numbers: FloatArray) -> FloatArray:
    if len(numbers) != 7:
        raise ValueError(f"a pose needs x y z qx qy qz qw, got {len(numbers)} numbers")
    return np.asarray(transforms_of(numbers[np.newaxis])[0])


def _edge(
    reference_id: str | int, numbers: FloatArray, noise: FloatArray | None, kernel: object = None
) -> Edge:
    T = _pose(numbers)
    if noise is None:
        with np.errstate(over="ignore", invalid="ignore"):  # likewise
            noise = StepSigma().covariance(T)
    return Edge(
        reference_id=reference_id,
        T_reference_frame=T,
        covariance=noise,
        kernel=kernel,  # type: ignore[arg-type] # checked by Edge
    )


def _prior(numbers: FloatArray, noise: FloatArray | None, kernel: object = None) -> Prior:
    covariance = np.diag(_PRIOR_SIGMAS**2) if noise is None else noise
    chosen: dict[str, Any] = {} if kernel is None else {"kernel": kernel}  # checked by the prior
    if len(numbers) == 3:
        return PositionPrior(position_world=numbers, covariance=covariance[-3:, -3:], **chosen)
    return PosePrior(T_world_frame=_pose(numbers), covariance=covariance, **chosen)


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
