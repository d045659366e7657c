"""PNG decoded by kernels: as OpenCV decodes them, or left to it."""

import random
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import gvo
from gvo.errors import RecordingError
from gvo.io.images import decode_image
from gvo.io.png import compiled_png, decode_plain_png
from gvo.io.recording import StampedImage
from gvo.io.synthetic import SyntheticRecording
from tests.conftest import python
from tests.fuzz.mutations import mutate_picture
from tests.make.png import chunk, encode_png, header, png

SHAPES = [(1, 1), (2, 3), (30, 40)]
KINDS = [
    (np.uint8, ()),
    (np.uint16, ()),
    (np.uint8, (3,)),
    (np.uint16, (3,)),
    (np.uint8, (4,)),
    (np.uint16, (4,)),
]


def data_of(file: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(file, dtype=np.uint8)


def smooth(shape: tuple[int, ...], dtype: type = np.uint8) -> NDArray[Any]:
    """Return pixels that grow along rows and columns, with noise."""
    noise = np.random.default_rng(len(shape)).integers(0, 20, shape)
    ramps = sum(np.ix_(*(np.arange(n) * 3 for n in shape)))
    return ((ramps + noise) * (1 if dtype is np.uint8 else 150) % np.iinfo(dtype).max).astype(dtype)


def outcome(file: bytes) -> NDArray[Any] | str:
    """Return the pixels, or why there are none."""
    try:
        return decode_image(data_of(file), "image")
    except RecordingError as error:
        return str(error)


def assert_alike(file: bytes) -> bool:
    """Check that kernels and OpenCV come to the same; tell whether the kernels did it."""
    expected = outcome(file)
    with compiled_png():
        found = outcome(file)
        is_plain = not isinstance(found, str) and decode_plain_png(data_of(file)) is not None
    np.testing.assert_array_equal(found, expected)
    assert np.asarray(found).dtype == np.asarray(expected).dtype
    return is_plain


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("dtype", "channels"), KINDS)
def test_grey_and_colour_of_8_and_16_bits_are_decoded_as_by_opencv(
    shape: tuple[int, int], dtype: type, channels: tuple[int, ...]
) -> None:
    pixels = smooth((*shape, *channels), dtype)
    rng = random.Random(3)
    for kinds in ([rng.randrange(5) for _ in range(shape[0])], *([k] * shape[0] for k in range(5))):
        file = encode_png(pixels, kinds)
        with compiled_png():
            np.testing.assert_array_equal(decode_image(data_of(file), "image"), pixels)
        assert assert_alike(file)


@pytest.mark.parametrize(
    "extra",
    [
        chunk(b"gAMA", (45455).to_bytes(4, "big")),
        chunk(b"sRGB", b"\0"),
        chunk(b"pHYs", bytes(8) + b"\1"),
        chunk(b"tIME", b"\x07\xe0\1\1\0\0\0"),
        chunk(b"tEXt", b"Software\0camera"),
    ],
)
def test_chunks_that_change_no_pixel_are_passed_over(extra: bytes) -> None:
    for shape in ((6, 8), (6, 8, 3)):
        assert assert_alike(encode_png(smooth(shape), [1] * 6, before=extra))


def written_by_pillow(mode: str) -> bytes:
    file = BytesIO()
    Image.fromarray(smooth((6, 8, 3))).convert(mode).save(file, "png")
    return file.getvalue()


LEFT_TO_OPENCV = {
    "palette": written_by_pillow("P"),
    "one bit": written_by_pillow("1"),
    "grey with alpha": written_by_pillow("LA"),
    "interlaced": png(header(1, 1, 8, 0, 0, 0, 1), chunk(b"IDAT", b"\x78\x9c\x63\x60\0\0\0\2\0\1")),
    "one transparent colour": encode_png(
        smooth((6, 8, 3)), [0] * 6, before=chunk(b"tRNS", bytes(6))
    ),
    "an unknown chunk": encode_png(smooth((6, 8)), [0] * 6, before=chunk(b"oWNs", b"1")),
    "a small window": encode_png(smooth((6, 8)), [0] * 6, n_window=10),
    "a very wide image": encode_png(smooth((1, 40_000)), [1]),
    "ten thousand chunks": encode_png(
        smooth((6, 8)), [0] * 6, before=chunk(b"tEXt", b"a\0b") * 10_000
    ),
    "a wrong checksum of a text": encode_png(
        smooth((6, 8)), [0] * 6, before=chunk(b"tEXt", b"a\0b")[:-1] + b"\0"
    ),
    "surplus rows": encode_png(smooth((6, 8)), [0] * 6).replace(
        header(8, 6, 8, 0, 0, 0, 0), header(8, 5, 8, 0, 0, 0, 0)
    ),
}


@pytest.mark.parametrize("name", LEFT_TO_OPENCV)
def test_what_is_out_of_the_ordinary_is_left_to_opencv(name: str) -> None:
    file = LEFT_TO_OPENCV[name]
    assert not assert_alike(file)
    with compiled_png():
        assert decode_plain_png(data_of(file)) is None


def packed(filtered: NDArray[np.uint8]) -> bytes:
    """Return the file of an image of 8 x 6 whose rows are filtered so, (6, 9)."""
    return png(header(8, 6, 8, 0, 0, 0, 0), chunk(b"IDAT", zlib.compress(filtered.tobytes())))


BROKEN = {
    "missing rows": encode_png(smooth((6, 8)), [0] * 6).replace(
        header(8, 6, 8, 0, 0, 0, 0), header(8, 7, 8, 0, 0, 0, 0)
    ),
    "no rows": png(header(8, 6, 8, 0, 0, 0, 0)),
    "empty rows": png(header(8, 6, 8, 0, 0, 0, 0), chunk(b"IDAT")),
    "no such filter": packed(np.insert(smooth((6, 8)), 0, [0, 1, 2, 3, 4, 5], axis=1)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_refused(name: str) -> None:
    assert not assert_alike(BROKEN[name])
    with compiled_png(), pytest.raises(RecordingError, match=r"^image: "):
        decode_image(data_of(BROKEN[name]), "image")


def assert_alike_when_changed(files: list[bytes], n_changes: int) -> int:
    """Check changes of files, half with right checksums; return how many the kernels decoded."""
    rng = random.Random(7)
    changed = [mutate_picture(b"\0\0" + rng.choice(files), rng)[2:] for _ in range(n_changes)]
    return sum(assert_alike(file) for file in changed)


def test_broken_files_are_refused_where_opencv_refuses_them() -> None:
    rng = random.Random(5)
    files = []
    for dtype, channels in KINDS:
        pixels = smooth((6, 8, *channels), dtype)
        files.append(encode_png(pixels, [rng.randrange(5) for _ in range(6)]))
        files.append(bytes(cv2.imencode(".png", pixels)[1].tobytes()))
    assert 0 < assert_alike_when_changed(files, 3000) < 300


def test_rows_of_any_bytes_and_filters_are_decoded_or_refused_as_by_opencv() -> None:
    rng = np.random.default_rng(9)
    for _ in range(300):
        filtered = rng.integers(0, 256, (6, 9), dtype=np.uint8)
        filtered[:, 0] = rng.integers(0, rng.choice([5, 6]), 6)
        assert assert_alike(packed(filtered)) == bool(np.all(filtered[:, 0] < 5))


@pytest.mark.recorded
@pytest.mark.parametrize(
    "pattern",
    [
        "rgbd_dataset_freiburg1_xyz_start/rgb/*.png",
        "rgbd_dataset_freiburg1_xyz_start/depth/*.png",
        "sevenscenes_start/depth/*.png",
        "kitti_06_start/image_0/*.png",
        "euroc_mh01_start/mav0/cam0/data/*.png",
    ],
)
def test_recorded_files_and_changes_of_them_are_decoded_as_by_opencv(
    gvo_data: Path, pattern: str
) -> None:
    files = [path.read_bytes() for path in sorted(gvo_data.glob(pattern))[:60:20]]
    assert [assert_alike(file) for file in files] == [True] * 3
    assert assert_alike_when_changed(files, 100) < 50


def test_frames_are_decoded_by_kernels() -> None:
    rendered = SyntheticRecording("handheld", "rgbd", n_frames=1, scale=0.1)
    n_plain = 0

    class Encoded:
        info = rendered.info
        ground_truth = rendered.ground_truth

        def images(self) -> Iterator[StampedImage]:
            for image in rendered.images():
                yield replace(image, load=partial(self.load, image))

        def load(self, image: StampedImage) -> NDArray[Any]:
            nonlocal n_plain
            pixels = image.load()
            if image.stream == 0:
                data = data_of(encode_png(pixels, [0] * len(pixels)))
                n_plain += decode_plain_png(data) is not None
            return pixels

    assert len(list(gvo.frames(Encoded()))) == 1
    assert n_plain == 1
    assert decode_plain_png(data_of(encode_png(smooth((2, 2)), [0, 0]))) is None


def test_images_are_read_without_kernels_where_nothing_is_tracked(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(encode_png(smooth((6, 8)), [0] * 6))
    program = f"""
import pathlib, sys
from gvo.io.images import read_image
print(read_image(pathlib.Path({str(path)!r})).shape, "llvmlite" in sys.modules)
"""
    assert python("-c", program).stdout == "(6, 8) False\n"
