"""Input that means harm, by hand: what a fuzzer needs long for."""

import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator, Sized
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gvo._text import MAX_LINE, MAX_VALUES, cut
from gvo.config import load_configuration
from gvo.errors import (
    CalibrationError,
    ConfigurationError,
    GvoError,
    RecordingError,
    TrajectoryError,
)
from gvo.io.bag.image_encodings import decode_rvl
from gvo.io.calibration.files import read_cameras
from gvo.io.datasets.files import read_stamped_rows
from gvo.io.edges.lines import parse_line, read_lines
from gvo.io.images import decode_image
from gvo.io.run_folder.reader import read_run
from gvo.trajectory.formats import read_trajectory

CAMERA = "image_width: 8\nimage_height: 6\ncamera_matrix: [8, 0, 4, 0, 8, 3, 0, 0, 1]\n"
LETTERS = "abcdefghi"


def aliases(first: str, *, merged: bool = False) -> str:
    """Return nine lines that stand for nine to the power of nine values."""
    lines = [f"a: &a {first}"]
    for before, name in pairwise(LETTERS):
        again = f"[{', '.join([f'*{before}'] * 9)}]"
        lines.append(f"{name}: &{name} {{<<: {again}}}" if merged else f"{name}: &{name} {again}")
    return "\n".join(lines) + "\n"


def as_file(folder: Path, text: str | bytes, name: str = "file.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@contextmanager
def refused(kind: type[Exception]) -> Iterator[None]:
    """Expect a refusal in a short line, whatever is wrong."""
    with pytest.raises(kind) as caught:
        yield
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


def pixels_of(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, dtype=np.uint8)


@pytest.mark.parametrize(
    "text",
    [
        aliases("[x, x, x]"),
        aliases("{q: 1, r: 2}", merged=True),
        "images: &a {black: *a}\n",
        "[" * 3000,
        "images: {black: !!timestamp never}\n",
        "images: {black: 0x" + "f" * 10000 + "}\n",
        "images: {black: 1" + ":1" * 20000 + "}\n",
        "images: {black: [" + "1," * 200000 + "]}\n",
        "images: {" + "blackimages" * 1000 + ": 1}\n",
        'images: {"\\ud800": 1}\n',
        b"images: {black: \x00}\n",
        b"\xff\xfe",
    ],
    ids=lambda text: str(text[:24]),
)
def test_a_configuration_that_means_harm_is_a_line(text: str | bytes, tmp_path: Path) -> None:
    with refused(ConfigurationError):
        load_configuration(as_file(tmp_path, text))


def test_aliases_that_stand_for_little_are_followed(tmp_path: Path) -> None:
    text = "window: &w {n_links: 2}\nklt: {n_corners: 300}\n"
    assert load_configuration(as_file(tmp_path, text)).window.n_links == 2
    many = ", ".join(["[*b]"] * 200)
    path = as_file(tmp_path, f"a: &b [1, 2]\nmore: [{many}]\n{CAMERA}")
    assert read_cameras(path, sensor="rgbd", is_rectified=False).calibrations[0].width == 8
    assert MAX_VALUES > 1000


@pytest.mark.parametrize(
    "text",
    [
        CAMERA + aliases("[1, 1, 1]") + "distortion_coefficients: *i\n",
        CAMERA + aliases("{q: 1}", merged=True),
        CAMERA + f"depth_scale: {'9' * 400}\n",
        CAMERA + f"roi: {{x_offset: {'9' * 200}}}\n",
        CAMERA.replace("8\n", "9" * 200 + "\n", 1),
    ],
    ids=range(5),
)
def test_a_calibration_that_means_harm_is_refused_in_a_line(text: str, tmp_path: Path) -> None:
    with refused(CalibrationError):
        read_cameras(as_file(tmp_path, text), sensor="rgbd", is_rectified=False)


def test_a_message_does_not_steer_a_terminal() -> None:
    assert str(RecordingError("/a\x1b[2J\nb")) == "/a\\x1b[2J\\nb"
    assert len(str(RecordingError("x" * 10**6))) < 5000
    assert cut("ü \udcff", 10) == "ü \\udcff"


def png(width: int, height: int, *, n_rows: int = 0) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        crc = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes((width + 1) * n_rows), 9)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", rows), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("kind", [b"IHDR", b"IDAT"])
def test_a_claimed_chunk_is_never_allocated(kind: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    file = bytearray(png(8, 6, n_rows=6))
    start = file.index(kind) - 4
    file[start : start + 4] = b"\xff\xff\xff\xf0"
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(RecordingError, match="truncated"):
        decode_image(pixels_of(bytes(file)), "a topic")


def test_a_jpeg_marker_without_a_length_hides_no_size() -> None:
    def frame(side: int) -> bytes:
        size = side.to_bytes(2, "big") * 2
        return b"\xff\xc0\x00\x11\x08" + size + b"\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01"

    hidden = (b"\xff\xd8\xff\x01" + frame(32767)).ljust(4 + 0xFFC0, b"\0")
    with pytest.raises(RecordingError, match="claims"):
        decode_image(pixels_of(hidden + frame(16) + b"\xff\xd9"), "a topic")


@pytest.mark.parametrize(
    ("row", "read", "n_bytes"),
    [
        # The numbers of a row, its pose, and the copy that the trajectory keeps.
        ("{0} 0 0 0 0 0 0 1\n", read_trajectory, 8 * (9 + 2 * 16)),
        # A stamp and a text, in a pair.
        ("{0} a" + 80 * " b" + "\n", partial(read_stamped_rows, unit_ns=1), 200),
    ],
)
def test_a_table_of_tiny_rows_takes_as_much_as_its_numbers(
    tmp_path: Path, row: str, read: Callable[[Path], Sized], n_bytes: int
) -> None:
    path = tmp_path / "table.txt"
    path.write_text("".join(row.format(k) for k in range(6_000)))
    tracemalloc.start()
    try:
        assert len(read(path)) == 6_000
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * 6_000 * n_bytes


@pytest.mark.parametrize(
    "changes",
    [
        {"trajectory.formats.MAX_LINES": 9, "io.datasets.files._MAX_ROWS": 9},
        {"_text.MAX_TEXT_BYTES": 150},
    ],
)
def test_a_table_that_is_too_long_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, int]
) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(9)))
    for name, limit in changes.items():
        monkeypatch.setattr(f"gvo.{name}", limit)
    assert len(read_trajectory(path)) == len(read_stamped_rows(path, unit_ns=1)) == 9
    path.write_text(path.read_text() + "9 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="holds more than"):
        read_trajectory(path)
    with pytest.raises(RecordingError, match="holds more than"):
        read_stamped_rows(path, unit_ns=1)


def png_of(stream: bytes, *fields: int) -> NDArray[np.uint8]:
    """Return a PNG of width, height, bits, colour, interlacing, and a stream of rows."""
    width, height, n_bits, colour, interlacing = fields
    header = struct.pack(">IIBBBBB", width, height, n_bits, colour, 0, 0, interlacing)
    chunks = [(b"IHDR", header), (b"IDAT", stream[:50]), (b"IDAT", stream[50:]), (b"IEND", b"")]
    return pixels_of(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks
        )
    )


def test_what_follows_the_last_row_of_a_png_is_left_out() -> None:
    rows = b"".join(b"\0" + bytes(range(k, k + 40)) for k in range(30))
    expected = np.add.outer(np.arange(30), np.arange(40))
    bomb = zlib.compress(rows + bytes(1 << 23))
    np.testing.assert_array_equal(decode_image(png_of(bomb, 40, 30, 8, 0, 0), "bomb"), expected)


def test_an_rvl_image_larger_than_any_depth_camera_is_refused() -> None:
    with pytest.raises(RecordingError, match="claims"):
        decode_rvl(pixels_of(struct.pack("<II", 5000, 5000) + b"\x11" * 100), "/depth")


@pytest.mark.parametrize(
    "line",
    [
        '{"id": "\\ud800", "stamp_ns": 0}',
        '{"id": ' + "9" * 400 + ', "stamp_ns": 0}',
        '{"id": "' + "x" * 2000 + '"}',
        '{"id": "a"' + " " * MAX_LINE + "}",
        '{"id":' + "[" * 50000,
        '{"id": 1, "stamp_ns": 9223372036854775807}',
        '{"id": 1, "reference": 0, "pose": [1e300, 0, 0, 0, 0, 0, 1]}',
        '{"id": 1, "reference": 0, "pose": [0, 0, 0, 1e308, 1e308, 0, 1]}',
    ],
    ids=lambda line: line[:12],
)
def test_a_line_that_means_harm_is_refused_shortly(line: str) -> None:
    with refused(ValueError):
        parse_line(line)


def test_a_line_without_an_end_takes_no_memory(tmp_path: Path) -> None:
    path = as_file(tmp_path, b"x" * (18 * MAX_LINE), "lines")
    with path.open("rb") as file, refused(TrajectoryError):
        list(read_lines(file.fileno(), lambda: None))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", "[" * 50000),
        ("summary.json", json.dumps({"T_base_truth": "x"})),
        ("summary.json", json.dumps({"T_base_truth": [[1e200] * 4] * 4})),
        ("summary.json", json.dumps({"nees": {"raw": {"1s": {"bare": {"n": 3}}}}})),
        ("summary.json", json.dumps({"nees": [1]})),
        ("summary.json", json.dumps({"reference": {"rotation_deg": 1}})),
        ("frames.csv", "x" * 200000 + "\n"),
    ],
    ids=range(7),
)
def test_a_run_folder_that_means_harm_is_refused(name: str, content: str, tmp_path: Path) -> None:
    for own in ("raw.txt", "causal.txt", "smoothed.txt"):
        as_file(tmp_path, "", own)
    as_file(tmp_path, "stamp_ns,status,reason\n", "frames.csv")
    as_file(tmp_path, content, name)
    with pytest.raises(GvoError):
        read_run(tmp_path).comparable()
