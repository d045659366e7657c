"""Values as bytes and back: plain data and named value classes, nothing that could run."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

_N_LENGTH = 8


class Packer:
    """Turns values into bytes: a line of JSON, then the arrays as they lie in memory.

    Beside numbers, texts, arrays, tuples, lists and dictionaries of these it takes the value
    classes that it is told, and no others.

    Parameters
    ----------
    kinds : sequence of type
        Dataclasses and enumerations of texts, each with a name of its own.
    """

    def __init__(self, kinds: Sequence[type] = ()) -> None:
        self._kinds = {kind.__name__: kind for kind in kinds}

    def pack(self, value: object) -> bytes:
        """Return a value as bytes.

        Raises
        ------
        ValueError
            When it holds something of another class.
        """
        arrays: list[NDArray[Any]] = []
        tree = self._plain(value, arrays)
        kinds = [(array.dtype.str, array.shape) for array in arrays]
        text = json.dumps([tree, kinds], separators=(",", ":")).encode()
        parts = [len(text).to_bytes(_N_LENGTH, "little"), text]
        return b"".join(parts + [array.tobytes() for array in arrays])

    def unpack(self, content: bytes) -> Any:  # noqa: ANN401 - whatever was packed
        """Return the value that `pack` was given; its arrays are copies."""
        end = _N_LENGTH + int.from_bytes(content[:_N_LENGTH], "little")
        tree, kinds = json.loads(content[_N_LENGTH:end])
        arrays = []
        for code, shape in kinds:
            dtype, size = np.dtype(code), math.prod(shape)
            array = np.frombuffer(content, dtype=dtype, count=size, offset=end)
            arrays.append(array.reshape(shape).copy())
            end += size * dtype.itemsize
        return self._value(tree, arrays)

    def _plain(self, value: Any, arrays: list[NDArray[Any]]) -> Any:  # noqa: ANN401
        """Return what JSON can hold: a list stands for all but the simplest, its kind first."""
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            arrays.append(value)
            return ["array", len(arrays) - 1]
        if isinstance(value, np.generic):
            return self._plain(value.item(), arrays)
        if isinstance(value, tuple | list):
            name = "tuple" if isinstance(value, tuple) else "list"
            return [name, *(self._plain(item, arrays) for item in value)]
        if isinstance(value, dict):
            return [
                "dict",
                *([self._plain(part, arrays) for part in item] for item in value.items()),
            ]
        if type(value) in self._kinds.values():
            return [type(value).__name__, *self._parts(value, arrays)]
        if value is None or type(value) in (bool, int, float, str):
            return value
        raise ValueError(f"a {type(value).__name__} cannot be packed")

    def _parts(self, value: Any, arrays: list[NDArray[Any]]) -> list[Any]:  # noqa: ANN401
        if isinstance(value, Enum):
            return [value.value]
        names = [field.name for field in fields(value)]
        return [[name, self._plain(getattr(value, name), arrays)] for name in names]

    def _value(self, tree: Any, arrays: list[NDArray[Any]]) -> Any:  # noqa: ANN401
        """Return what `_plain` was given."""
        if not isinstance(tree, list):
            return tree
        name, *parts = tree
        if name == "array":
            return arrays[parts[0]]
        if name in ("tuple", "list"):
            items = (self._value(part, arrays) for part in parts)
            return tuple(items) if name == "tuple" else list(items)
        if name == "dict":
            return {self._value(key, arrays): self._value(item, arrays) for key, item in parts}
        kind = self._kinds[name]
        if is_dataclass(kind):
            return kind(**{key: self._value(item, arrays) for key, item in parts})
        return kind(parts[0])
