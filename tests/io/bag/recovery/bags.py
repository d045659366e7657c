"""Bags of numbered messages, made to be damaged."""

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from zlib import crc32

from lz4.frame import compress as lz4_compress  # type: ignore[import-untyped]

from tests.make import bags

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

TOPICS = ("/a", "/b")
Message = tuple[str, int, bytes]
_TYPE = "std_msgs/msg/String"


def contents(n: int, n_bytes: int = 300) -> list[Message]:
    """Return messages of two topics: no two are alike."""
    return [
        (TOPICS[k % 2], 10 * k, bytes((k * k + 31 * i * i) % 251 for i in range(n_bytes)))
        for k in range(n)
    ]


def write(path: Path, messages: list[Message], compression: str = "") -> Path:
    """Write a bag with small chunks; of ROS 2 in a folder of its own."""
    typed: list[bags.Message] = [(name, _TYPE, ns, data) for name, ns, data in messages]
    return bags.write(path, typed, compression=compression, n_in_chunk=3)


def open_mcap(
    messages: list[Message],
    compression: str | None,
    *,
    n_in_chunk: int = 3,
    has_crc: bool = True,
    encoding: str = "cdr",
) -> bytes:
    """Return an MCAP file as a recorder leaves it that was killed: without an end.

    Without a compression (None) there are no chunks.
    """
    file = b"\x89MCAP0\r\n" + _record(1, _text("ros2") + _text("recorder"))
    head = _record(3, struct.pack("<H", 1) + _text(_TYPE) + _text("ros2msg") + _text("string data"))
    for n, name in enumerate(TOPICS):
        head += _record(4, struct.pack("<HH", n, 1) + _text(name) + _text(encoding) + _text(""))
    records = [
        _record(5, struct.pack("<HIQQ", TOPICS.index(name), 0, log_time_ns, 0) + data)
        for name, log_time_ns, data in messages
    ]
    if compression is None:
        return file + head + b"".join(records)
    for start in range(0, len(records), n_in_chunk):
        content = (head if start == 0 else b"") + b"".join(records[start : start + n_in_chunk])
        packed = {"": bytes, "lz4": lz4_compress, "zstd": zstd.compress}[compression](content)
        crc = crc32(content) if has_crc else 0
        sizes = struct.pack("<QQQI", 0, 0, len(content), crc)
        file += _record(6, sizes + _text(compression) + struct.pack("<Q", len(packed)) + packed)
        file += _record(7, struct.pack("<HI", 0, 0))
    return file


def _record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def damaged(path: Path, change: Callable[[bytes], bytes]) -> Path:
    copy = path.with_name(f"damaged-{path.name}")
    copy.write_bytes(change(path.read_bytes()))
    return copy
