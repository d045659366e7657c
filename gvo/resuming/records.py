"""What a journal holds of one frame, as values and as bytes.

A record is read as something that anybody may have written: whatever is not as expected is a
`ValueError`.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias

import numpy as np

from gvo.frontend.stereo.offsets import check_state
from gvo.types import Failure, FaultyFrame, FloatArray, RelativePose

Learnt: TypeAlias = tuple[tuple[float | int | None, ...], ...]
"""What a front-end has learnt, see `RigOffsets.state`; empty for one that learns nothing."""

_LENGTH = struct.Struct("<I")
_N_POSE = 16 + 36
# Matches and keypoints of one frame; more are none.
_MAX_COUNT = 1_000_000
_MAX_STAMP = 2**63 - 1
_MAX_SAMPLES = 1000
_MAX_STAGES = 20
# Of a relative pose only what the window and the tables need is kept of these.
_PER_MATCH = ("matches", "inliers", "pixels_reference", "pixels_current", "points_current")
_SCALARS = frozenset(
    field.name
    for field in fields(RelativePose)
    if field.name not in (*_PER_MATCH, "T_reference_current", "covariance")
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Call:
    """What a front-end was asked for about one frame, and its answer.

    Parameters
    ----------
    kind : {"register", "relocalize"}
    reference_ns : int
        Stamp of the reference, nanoseconds.
    has_prior : bool
        A motion was predicted.
    result : RelativePose or Failure
        Of a relative pose read back, matches and inliers are as many as there were, without what
        they were.
    """

    kind: Literal["register", "relocalize"]
    reference_ns: int
    has_prior: bool
    result: RelativePose | Failure

    @property
    def key(self) -> tuple[str, int, bool]:
        """What was asked for."""
        return self.kind, self.reference_ns, self.has_prior


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """What came out of the front-end for one frame.

    Parameters
    ----------
    stamp_ns : int
    n_keypoints, n_points : int
    calls : tuple of Call
        In their order.
    points_cam : ndarray of float64, shape (n, 3), or None
        Of a frame that became a keyframe, some of its points, see `sample_points`.
    learnt : Learnt
        By the front-end, after the frame.
    stage_ms : dict of str to float
        Milliseconds by stage.
    """

    stamp_ns: int
    n_keypoints: int
    n_points: int
    calls: tuple[Call, ...]
    points_cam: FloatArray | None
    learnt: Learnt
    stage_ms: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaultyRecord:
    """A frame that could not be used.

    Parameters
    ----------
    frame : FaultyFrame
    read_ms : float
        Milliseconds.
    """

    frame: FaultyFrame
    read_ms: float

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""
        return self.frame.stamp_ns


Record: TypeAlias = FrameRecord | FaultyRecord


def encode(record: Record) -> bytes:
    """Return a record as bytes."""
    if isinstance(record, FaultyRecord):
        frame = record.frame
        head: dict[str, Any] = {
            "stamp_ns": frame.stamp_ns,
            "reason": frame.reason,
            "is_unpaired": frame.is_unpaired,
            "read_ms": record.read_ms,
        }
        return _join(head, [])
    arrays = [
        array
        for call in record.calls
        if isinstance(call.result, RelativePose)
        for array in (call.result.T_reference_current, call.result.covariance)
    ]
    points = record.points_cam
    head = {
        "stamp_ns": record.stamp_ns,
        "n_keypoints": record.n_keypoints,
        "n_points": record.n_points,
        "calls": [_call_head(call) for call in record.calls],
        "n_samples": None if points is None else len(points),
        "learnt": record.learnt,
        "stage_ms": record.stage_ms,
    }
    return _join(head, arrays if points is None else [*arrays, points])


def decode(payload: bytes) -> Record:
    """Read a record.

    Raises
    ------
    ValueError
        When it is none.
    """
    try:
        head, numbers = _split(payload)
        return _decode_faulty(head) if "reason" in head else _decode_frame(head, numbers)
    except (KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"no record: {type(error).__name__}: {error}") from error


def _join(head: Mapping[str, Any], arrays: Sequence[FloatArray]) -> bytes:
    text = json.dumps(head, separators=(",", ":"), default=_plain).encode()
    numbers = [np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays]
    return b"".join([_LENGTH.pack(len(text)), text, *numbers])


def _plain(value: object) -> Any:  # noqa: ANN401 - a number of numpy as one of Python
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a record holds no {type(value).__name__}")


def _call_head(call: Call) -> dict[str, Any]:
    result = call.result
    head: dict[str, Any] = {"kind": call.kind, "ns": call.reference_ns, "prior": call.has_prior}
    head |= {"n_matches": result.n_matches, "n_inliers": result.n_inliers}
    if not isinstance(result, RelativePose):
        return {**head, "failure": result.reason}
    values = {name: getattr(result, name) for name in _SCALARS}
    numbers = {name: value for name, value in values.items() if _is_number_or_none(value)}
    return {**head, "values": numbers}


def _is_number_or_none(value: object) -> bool:
    return value is None or isinstance(value, bool | int | float | np.number | np.bool_)


def _split(payload: bytes) -> tuple[dict[str, Any], FloatArray]:
    if len(payload) < _LENGTH.size:
        raise ValueError("no record: too short")
    (length,) = _LENGTH.unpack_from(payload)
    text = payload[_LENGTH.size : _LENGTH.size + length]
    head = json.loads(text.decode())
    rest = payload[_LENGTH.size + length :]
    if not isinstance(head, dict) or len(rest) % 8:
        raise ValueError("no record: no object, or numbers that are cut off")
    return head, np.frombuffer(rest, dtype="<f8").astype(np.float64)


def _decode_faulty(head: Mapping[str, Any]) -> FaultyRecord:
    reason, is_unpaired = head["reason"], head["is_unpaired"]
    if not isinstance(reason, str) or not isinstance(is_unpaired, bool):
        raise ValueError("no record: a faulty frame without a reason")
    frame = FaultyFrame(stamp_ns=_stamp(head["stamp_ns"]), reason=reason, is_unpaired=is_unpaired)
    return FaultyRecord(frame=frame, read_ms=_duration(head["read_ms"]))


def _decode_frame(head: Mapping[str, Any], numbers: FloatArray) -> FrameRecord:
    heads = _list(head["calls"])
    n_poses = sum("failure" not in call for call in heads)
    n_samples = 0 if head["n_samples"] is None else _count(head["n_samples"], _MAX_SAMPLES)
    if len(numbers) != _N_POSE * n_poses + 3 * n_samples:
        raise ValueError(f"no record: {len(numbers)} numbers for {n_poses} poses")
    poses = iter(numbers[: _N_POSE * n_poses].reshape(n_poses, _N_POSE))
    points = numbers[_N_POSE * n_poses :].reshape(n_samples, 3)
    if not np.isfinite(points).all():
        raise ValueError("no record: a point is not finite")
    stages = head["stage_ms"]
    if not isinstance(stages, dict) or len(stages) > _MAX_STAGES:
        raise ValueError("no record: stages")
    return FrameRecord(
        stamp_ns=_stamp(head["stamp_ns"]),
        n_keypoints=_count(head["n_keypoints"]),
        n_points=_count(head["n_points"]),
        calls=tuple(_decode_call(call, poses) for call in heads),
        points_cam=None if head["n_samples"] is None else points,
        learnt=_decode_learnt(head["learnt"]),
        stage_ms={name: _duration(elapsed_ms) for name, elapsed_ms in stages.items()},
    )


def _decode_learnt(states: object) -> Learnt:
    learnt = tuple(tuple(_list(state)) for state in _list(states))
    for state in learnt:
        check_state(state)
    return learnt


def _decode_call(head: Mapping[str, Any], poses: Any) -> Call:  # noqa: ANN401 - rows of an array
    kind, has_prior = head["kind"], head["prior"]
    if kind not in ("register", "relocalize") or not isinstance(has_prior, bool):
        raise ValueError(f"no record: a call of {kind!r:.40}")
    n_matches = _count(head["n_matches"])
    n_inliers = _count(head["n_inliers"], n_matches if "failure" not in head else _MAX_COUNT)
    result: RelativePose | Failure
    if "failure" in head:
        if not isinstance(head["failure"], str):
            raise ValueError("no record: a failure without a reason")
        result = Failure(reason=head["failure"], n_matches=n_matches, n_inliers=n_inliers)
    else:
        pose = next(poses)
        result = RelativePose(
            T_reference_current=pose[:16].reshape(4, 4).copy(),
            covariance=pose[16:].reshape(6, 6).copy(),
            matches=np.full((n_matches, 2), -1, dtype=np.int64),
            inliers=np.arange(n_matches) < n_inliers,
            **_decode_values(head["values"]),
        )
    return Call(kind=kind, reference_ns=_stamp(head["ns"]), has_prior=has_prior, result=result)


def _decode_values(values: object) -> dict[str, Any]:
    if not isinstance(values, dict) or not values.keys() <= _SCALARS:
        raise ValueError("no record: values of a pose")
    if not all(map(_is_number_or_none, values.values())):
        raise ValueError("no record: a value of a pose is no number")
    return values


def _list(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"no record: expected a list, got {type(value).__name__}")
    return value


def _stamp(value: object) -> int:
    if type(value) is not int or abs(value) > _MAX_STAMP:
        raise ValueError(f"no record: {value!r:.40} is no stamp")
    return value


def _count(value: object, limit: int = _MAX_COUNT) -> int:
    if type(value) is not int or not 0 <= value <= limit:
        raise ValueError(f"no record: {value!r:.40} is no count up to {limit}")
    return value


def _duration(value: object) -> float:
    if not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
        raise ValueError(f"no record: {value!r:.40} is no duration")
    return float(value)
