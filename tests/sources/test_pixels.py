"""Image files and depth counts."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import RecordingError
from gvo.sources.pixels import (
    decode_image,
    depth_from_counts,
    depth_from_metres,
    read_depth,
    read_image,
    to_8_bit,
)


def test_grey_and_colour_files_come_back_unchanged(tmp_path: Path, tiny: Any) -> None:
    for is_color in (False, True):
        pixels = tiny.texture(1, is_color=is_color)
        tiny.write_image(tmp_path / "image.png", pixels)
        np.testing.assert_array_equal(read_image(tmp_path / "image.png"), pixels)


def test_sixteen_bits_lose_their_lower_eight(tmp_path: Path, tiny: Any) -> None:
    grey = tiny.texture(1).astype(np.uint16)
    tiny.write_image(tmp_path / "image.png", grey * 256 + 255)
    np.testing.assert_array_equal(read_image(tmp_path / "image.png"), grey)


def test_the_alpha_channel_is_dropped(tiny: Any) -> None:
    color = tiny.texture(1, is_color=True)
    with_alpha = np.dstack([color, tiny.texture(2)])
    np.testing.assert_array_equal(to_8_bit(with_alpha, "image"), color)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_a_truncated_file_is_refused(tmp_path: Path, tiny: Any, suffix: str, share: float) -> None:
    path = tmp_path / f"image{suffix}"
    tiny.write_image(path, tiny.texture(1, is_color=True))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=path.name):
        read_image(path)


def test_a_missing_file_and_a_text_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="missing"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(RecordingError, match="cannot be decoded"):
        read_image(tmp_path / "text.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_absurd_size_in_the_header_is_refused_before_decoding(
    tiny: Any, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, encoded = cv2.imencode(suffix, tiny.texture(1))
    data = bytearray(encoded.tobytes())
    if suffix == ".png":
        data[16:24] = (60000).to_bytes(4, "big") * 2
    else:
        frame = data.index(b"\xff\xc0")
        data[frame + 5 : frame + 9] = (60000).to_bytes(2, "big") * 2
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(RecordingError, match="60000x60000"):
        decode_image(np.frombuffer(bytes(data), np.uint8), "image")


@given(count=st.integers(1, 65534), scale=st.sampled_from([1000.0, 5000.0, 256.0]))
def test_depth_is_counts_by_scale(count: int, scale: float) -> None:
    depth = depth_from_counts(np.array([[count]], np.uint16), scale, "depth")
    assert depth.dtype == np.float32
    assert depth[0, 0] == pytest.approx(count / scale, rel=1e-6)


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 6553.5])
def test_every_count_is_rounded_once_and_only_its_ends_are_unknown(scale: float) -> None:
    counts = np.arange(65536, dtype=np.uint16).reshape(128, 512)
    expected = [np.float32(count) / np.float32(scale) for count in range(65536)]
    expected[0] = expected[-1] = np.float32(np.nan)
    depth = depth_from_counts(counts, scale, "depth")
    np.testing.assert_array_equal(depth.ravel(), np.array(expected, dtype=np.float32))


def test_zero_and_the_largest_count_are_unknown() -> None:
    depth = depth_from_counts(np.array([[0, 65535, 1]], np.uint16), 1000.0, "depth")
    np.testing.assert_array_equal(np.isnan(depth), [[True, True, False]])


def test_metres_that_are_not_positive_are_unknown() -> None:
    depth = depth_from_metres(np.array([[0.0, -1.0, np.inf, -np.inf, np.nan, 2.0]]))
    np.testing.assert_array_equal(np.isnan(depth), [[True] * 5 + [False]])


def test_depth_of_eight_bits_or_in_colour_is_refused(tmp_path: Path, tiny: Any) -> None:
    for is_color in (False, True):
        tiny.write_image(tmp_path / "depth.png", tiny.texture(1, is_color=is_color))
        with pytest.raises(RecordingError, match="16-bit grey"):
            read_depth(tmp_path / "depth.png", 5000.0)
