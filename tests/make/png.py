"""PNG files whose filters and chunks are chosen (PNG specification, third edition)."""

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
_COLOURS = {1: 0, 3: 2, 4: 6}


def filter_rows(rows: Bytes, n_pixel: int, kinds: Sequence[int]) -> Bytes:
    """Return rows of bytes (h, n) filtered, each behind the number of its filter (h, n + 1)."""
    height, n_bytes = rows.shape
    padded = np.zeros((height + 1, n_bytes + n_pixel), dtype=np.int64)
    padded[1:, n_pixel:] = rows
    left, above, corner = padded[1:, :n_bytes], padded[:-1, n_pixel:], padded[:-1, :n_bytes]
    estimate = left + above - corner
    distances = np.abs(np.stack([left, above, corner]) - estimate)
    nearest = np.choose(np.argmin(distances, axis=0), [left, above, corner])
    predictions = [0 * left, left, above, (left + above) // 2, nearest]
    filtered = [(rows - predictions[kind])[j] for j, kind in enumerate(kinds)]
    return np.column_stack([kinds, np.reshape(filtered, rows.shape)]).astype(np.uint8)


def chunk(name: bytes, content: bytes = b"") -> bytes:
    """Return a chunk with its length and checksum."""
    check = zlib.crc32(name + content)
    return len(content).to_bytes(4, "big") + name + content + check.to_bytes(4, "big")


def header(width: int, height: int, *rest: int) -> bytes:
    """Return the first chunk: bits, type of colour, compression, filters, interlacing."""
    return chunk(b"IHDR", width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes(rest))


def png(*chunks: bytes) -> bytes:
    """Return a file of chunks."""
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks) + chunk(b"IEND")


def encode_png(
    pixels: NDArray[np.uint8] | NDArray[np.uint16],
    kinds: Sequence[int],
    *,
    before: bytes = b"",
    behind: bytes = b"",
    n_window: int = 15,
) -> bytes:
    """Encode grey (h, w), or BGR (h, w, 3 or 4), its rows split over three chunks.

    kinds: the filter of each row. before, behind: chunks around those of the rows.
    """
    height, width = pixels.shape[:2]
    n_channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[n_channels]
    samples = pixels.reshape(height, width, n_channels)[..., order]
    size = pixels.dtype.itemsize
    rows = np.ascontiguousarray(samples.astype(f">u{size}")).view(np.uint8).reshape(height, -1)
    packer = zlib.compressobj(6, zlib.DEFLATED, n_window)
    stream = packer.compress(filter_rows(rows, size * n_channels, kinds).tobytes())
    stream += packer.flush()
    third = len(stream) // 3
    parts = stream[:third], stream[third : 2 * third], stream[2 * third :]
    return png(
        header(width, height, 8 * size, _COLOURS[n_channels], 0, 0, 0),
        *(before, *(chunk(b"IDAT", part) for part in parts), behind),
    )
