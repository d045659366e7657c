"""Values as bytes and back."""

import json
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gvo.types import Estimate, Status
from gvo.view.packing import Packer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """A value of two."""

    first: Any
    second: Any = None


PACKER = Packer([Pair, Status, Estimate])

NUMBERS = st.integers() | st.floats() | st.booleans() | st.none() | st.text(max_size=5)
DTYPES = st.sampled_from(["<f8", "<f4", "<i8", "|u1", "|b1", ">i4"]).map(np.dtype)
SHAPES = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
LEAVES = NUMBERS | st.sampled_from(Status) | arrays.arrays(DTYPES, SHAPES)
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.integers() | st.text(max_size=3), inner, max_size=3)
        | st.builds(Pair, first=inner, second=inner)
    ),
    max_leaves=8,
)


def assert_same(a: Any, b: Any) -> None:
    """Also of the same classes, and to the last bit."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        assert_same(list(a.values()), list(b.values()))
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            assert_same(left, right)
    else:
        assert a == b or (a != a and b != b)


@given(VALUES)
def test_a_value_comes_back_as_it_was(value: Any) -> None:
    assert_same(PACKER.unpack(PACKER.pack(value)), value)


def test_an_array_that_is_not_contiguous_comes_back() -> None:
    array = np.arange(24).reshape(4, 6)[::2, 1::3].T
    np.testing.assert_array_equal(PACKER.unpack(PACKER.pack(array)), array)


def test_an_estimate_comes_back() -> None:
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 0.1 + 0.2
    estimate = Estimate(
        stamp_ns=7, T_world_cam=T, covariance=np.eye(6), status=Status.LOST, frame_id=7
    )
    back = PACKER.unpack(PACKER.pack({"poses": (estimate,)}))["poses"][0]
    assert_same(back, estimate)


def test_numbers_of_numpy_become_plain_ones() -> None:
    assert_same(
        PACKER.unpack(PACKER.pack((np.float64(0.1), np.int64(3), np.bool_(True)))), (0.1, 3, True)
    )


class Colour(Enum):
    """A class that the packer was not told."""

    RED = 1


@pytest.mark.parametrize(
    "value", [Colour.RED, object(), {1}, 1j, print, np.array([object()]), [Colour.RED]]
)
def test_what_it_was_not_told_is_refused(value: object) -> None:
    with pytest.raises(ValueError, match="cannot be packed"):
        PACKER.pack(value)


def test_bytes_that_name_another_class_make_none() -> None:
    text = json.dumps([["Popen", ["args", "id"]], []]).encode()
    with pytest.raises(KeyError, match="Popen"):
        PACKER.unpack(len(text).to_bytes(8, "little") + text)
