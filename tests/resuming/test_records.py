"""What a journal holds is read back bit for bit, and what is none is refused in one way."""

import json
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.config import StereoConfig
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.odometry.keyframes import sample_points
from gvo.resuming.records import Call, FaultyRecord, FrameRecord, decode, encode
from gvo.types import Failure, FaultyFrame, RelativePose

SEEDS = st.integers(0, 2**32 - 1)


def make_record(seed: int, *, is_keyframe: bool = True) -> FrameRecord:
    rng = np.random.default_rng(seed)
    pose = RelativePose(
        T_reference_current=rng.normal(size=(4, 4)),
        covariance=rng.normal(size=(6, 6)),
        matches=np.zeros((9, 2), dtype=np.int64),
        inliers=rng.random(9) < 0.5,
        flow_px=float(rng.normal()),
        offset_px=np.float64(rng.normal()),
    )
    calls = (
        Call(kind="register", reference_ns=5, has_prior=True, result=pose),
        Call(kind="register", reference_ns=5, has_prior=False, result=Failure(reason="ä, \n b")),
        Call(kind="relocalize", reference_ns=3, has_prior=False, result=pose),
    )
    return FrameRecord(
        stamp_ns=int(rng.integers(2**62)),
        n_keypoints=int(rng.integers(1000)),
        n_points=70,
        calls=calls,
        points_cam=rng.normal(size=(64, 3)) if is_keyframe else None,
        learnt=((0.1, 0.2, 0.3, 0.4, None, None, 1.5, 7, None),),
        stage_ms={"read": 1.25, "links": 3.5},
    )


@given(SEEDS, st.booleans())
def test_a_record_is_read_back_bit_for_bit(seed: int, is_keyframe: bool) -> None:
    record = make_record(seed, is_keyframe=is_keyframe)
    again = decode(encode(record))
    assert isinstance(again, FrameRecord)
    for name in ("stamp_ns", "n_keypoints", "n_points", "learnt", "stage_ms"):
        assert getattr(again, name) == getattr(record, name)
    np.testing.assert_equal(again.points_cam, record.points_cam)
    for one, other in zip(again.calls, record.calls, strict=True):
        assert one.key == other.key
        assert (one.result.n_matches, one.result.n_inliers) == (
            other.result.n_matches,
            other.result.n_inliers,
        )
        if isinstance(other.result, Failure):
            assert one.result == other.result
            continue
        assert isinstance(one.result, RelativePose)
        for name in ("T_reference_current", "covariance"):
            bits = getattr(one.result, name).tobytes()
            assert bits == getattr(other.result, name).tobytes()
        assert one.result.flow_px == other.result.flow_px
        assert one.result.offset_px == other.result.offset_px
        assert one.result.offset_sigma_px is None


def test_a_faulty_frame_is_read_back() -> None:
    frame = FaultyFrame(stamp_ns=-3, reason="black", is_unpaired=True)
    again = decode(encode(FaultyRecord(frame=frame, read_ms=0.5)))
    assert isinstance(again, FaultyRecord)
    assert (again.frame, again.read_ms) == (frame, 0.5)


@given(st.binary(max_size=300))
def test_bytes_that_are_no_record_are_refused(payload: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - whoever reads cuts there, whatever it says
        decode(payload)


@given(SEEDS, st.integers(0, 10**6), st.integers(1, 255))
def test_a_damaged_record_is_refused_or_read_as_another(seed: int, place: int, flip: int) -> None:
    payload = bytearray(encode(make_record(seed)))
    payload[place % len(payload)] ^= flip
    try:
        decode(bytes(payload))
    except ValueError:
        return


def with_head(**changes: Any) -> bytes:
    payload = encode(make_record(0))
    (length,) = struct.unpack_from("<I", payload)
    head = json.loads(payload[4 : 4 + length]) | changes
    text = json.dumps(head).encode()
    return struct.pack("<I", len(text)) + text + payload[4 + length :]


CALL = {"kind": "register", "ns": 5, "prior": True, "n_matches": 3, "n_inliers": 2, "values": {}}


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp_ns": 2**63},
        {"stamp_ns": 1.5},
        {"stamp_ns": True},
        {"n_points": 10**9},
        {"n_points": -1},
        {"n_samples": 65},
        {"n_samples": 10**12},
        {"calls": {}},
        {"calls": [CALL | {"kind": "delete"}]},
        {"calls": [CALL | {"n_matches": 2**40}]},
        {"calls": [CALL, CALL | {"n_inliers": 4}]},
        {"calls": [CALL, CALL | {"values": {"matches": 3}}]},
        {"calls": [CALL, CALL | {"values": {"flow_px": "far"}}]},
        {"learnt": [[1, 2, 3]]},
        {"learnt": [[0.0, -1.0, 0.0, 1.0, None, None, None, None, None]]},
        {"learnt": [[0.0, 1.0, None, 1.0, None, None, None, None, None]]},
        {"learnt": [[0.0, 1.0, 0.0, 1.0, 3.0, None, None, None, None]]},
        {"learnt": [[0.0, float("nan"), 0.0, 1.0, None, None, None, None, None]]},
        {"stage_ms": {"read": float("inf")}},
        {"stage_ms": {"read": "long"}},
        {"stage_ms": {str(n): 1.0 for n in range(100)}},
        {"reason": 5},
        {"reason": "x"},
    ],
)
def test_a_record_that_claims_what_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - whoever reads cuts there, whatever it says
        decode(with_head(**changes))


def test_points_that_were_thinned_are_thinned_no_more() -> None:
    rng = np.random.default_rng(0)
    for n in (0, 1, 63, 64, 65, 500):
        once = sample_points(rng.normal(size=(n, 3)))
        np.testing.assert_array_equal(sample_points(once), once)


def test_what_was_learnt_of_a_rig_goes_on_bit_for_bit() -> None:
    rng = np.random.default_rng(1)

    def learn(offsets: RigOffsets, n: int) -> None:
        left, sigma = rng.normal(), rng.random() + 0.01
        pose = RelativePose(
            T_reference_current=np.eye(4),
            covariance=np.eye(6),
            offset_px=left,
            offset_sigma_px=sigma,
        )
        offsets.note(pose, n)
        offsets.note_rows(left, n)
        if n % 3:
            offsets.advance()

    first, second = RigOffsets(StereoConfig()), RigOffsets(StereoConfig())
    for n in range(10):
        learn(first, n)
        second.restore(json.loads(json.dumps(first.state())))
        assert second.state() == first.state()
    rng = np.random.default_rng(2)
    learn(first, 20)
    rng = np.random.default_rng(2)
    learn(second, 20)
    first.advance()
    second.advance()
    assert second.state() == first.state()
    assert first.state()[0] != 0.0
