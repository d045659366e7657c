"""Messages written into bags, compressed ones too."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gvo.io.convert.convert import convert
from gvo.io.opening import open_recording
from tests.io.conftest import Tiny
from tests.make.recordings import Item
from tests.make.rendered_walk import read_bag

_NAMES = pytest.mark.parametrize("name", ["a.bag", "a.mcap"])


def _messages(path: Path, topic: str) -> list[Any]:
    return [message for _, message in read_bag(path)[topic]]


@_NAMES
@pytest.mark.parametrize("is_color", [False, True])
def test_png_images_are_as_decoded(tiny: Tiny, tmp_path: Path, name: str, is_color: bool) -> None:
    images = [tiny.texture(n, is_color=is_color) for n in range(4)]
    items: list[Item] = [(n % 2, 10 + n // 2, pixels) for n, pixels in enumerate(images)]
    convert(tiny.stereo(items), tmp_path / name, compress=True)
    for side, mine in (("left", images[::2]), ("right", images[1::2])):
        messages = _messages(tmp_path / name, f"/stereo/{side}/image_rect/compressed")
        for message, pixels in zip(messages, mine, strict=True):
            decoded = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(decoded, pixels)
            assert message.format.startswith("bgr8; png" if is_color else "mono8; png")
    read = [image.load() for image in open_recording(tmp_path / name).images()]
    for pixels, expected in zip(read, images, strict=True):
        np.testing.assert_array_equal(pixels, expected)


@_NAMES
def test_depth_comes_back_whatever_later_images_hold(tiny: Tiny, tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    millimetres = (rng.integers(1, 9000, (32, 48)) / 1000).astype(np.float32)
    millimetres[:4] = np.nan
    far = millimetres.copy()
    far[9, 9] = 70.0
    between = rng.uniform(0.3, 4, (32, 48)).astype(np.float32)
    depths = [millimetres, far, between, np.full((32, 48), np.nan, dtype=np.float32)]
    items: list[Item] = [
        item
        for n, depth in enumerate(depths)
        for item in ((0, 10 + n, tiny.texture(n)), (1, 10 + n, depth))
    ]
    assert convert(tiny.rgbd(items), tmp_path / name, compress=True).skipped == ()
    read = [image.load() for image in open_recording(tmp_path / name).images() if image.stream]
    for depth, expected in zip(read, depths, strict=True):
        np.testing.assert_array_equal(depth, expected)
    messages = _messages(tmp_path / name, "/camera/depth/image/compressedDepth")
    formats = [message.format.split(";")[0] for message in messages]
    assert formats == ["16UC1", "32FC1", "32FC1", "16UC1"]
    # As the transport has it: 12 bytes before the PNG.
    png = cv2.imdecode(messages[0].data[12:], cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png, np.round(1000 * np.nan_to_num(millimetres)))
