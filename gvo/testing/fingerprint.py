"""Telling whether a value has changed, whatever it is made of."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass

import numpy as np

_MAX_DEPTH = 6


def fingerprint(value: object) -> str:
    """Return a digest of all arrays and plain values that a value holds.

    Looks into dataclasses, objects, mappings and sequences, six levels deep; what is none of
    these and no plain value counts by its type alone.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in _parts(value, _MAX_DEPTH):
        digest.update(part)
        digest.update(b"|")
    return digest.hexdigest()


def _parts(value: object, depth: int) -> Iterator[bytes]:
    if isinstance(value, np.ndarray) and value.dtype != object:
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, bool | int | float | complex | str | bytes | np.generic | None):
        yield repr(value).encode()
    elif depth > 0:
        yield type(value).__name__.encode()
        for name, member in _members(value):
            yield name.encode()
            yield from _parts(member, depth - 1)


def _members(value: object) -> Iterator[tuple[str, object]]:
    if is_dataclass(value):
        yield from ((field.name, getattr(value, field.name)) for field in fields(value))
    elif isinstance(value, Mapping):
        yield from ((repr(key), member) for key, member in value.items())
    elif isinstance(value, list | tuple):
        yield from ((str(index), member) for index, member in enumerate(value))
    else:
        yield from vars(value).items() if hasattr(value, "__dict__") else ()
