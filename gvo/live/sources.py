"""Running cameras: images on standard input, or from a device.

On standard input each image is a line of JSON, then the bytes of its pixels, row by row:

    {"stream": "left", "stamp_ns": 1700000000000000000, "encoding": "mono8", "width": 640,
     "height": 480}

(on one line). `stream` is left or right, or color or depth; `encoding` is one of ROS. A compressed
image has `"format": "png"` (or jpeg, ...) and `"size"` (bytes) in place of `encoding`, `width` and
`height`.
"""

from __future__ import annotations

import io
import json
import os
import select
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._text import cut
from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.bag.image_encodings import DEPTHS, IMAGES, find_encoding
from gvo.io.bag.messages import (
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
)
from gvo.io.bag.reader import typestore
from gvo.io.bag.topics import COMPRESSED_TYPE, IMAGE_TYPE
from gvo.io.images import MILLIMETRES, check_size
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.trajectory.trajectory import Trajectory

_MILLISECOND_NS = 1_000_000
_STREAMS = {"left": 0, "color": 0, "right": 1, "depth": 1}
_WHERE = "standard input"
_SIZES = ("width", "height")
_MAX_LINE = 1 << 16
_MAX_COMPRESSED = 1 << 28
_N_SHOWN = 80


class StandardInput:
    """A camera whose images another program writes to standard input.

    A thread that waits in a read of `sys.stdin` until the process ends would hold its lock, and
    the interpreter aborts where it cannot close it: the descriptor is read.

    Parameters
    ----------
    info : RecordingInfo
        Of the camera: `gvo.Rig(...).info`.
    config : Config, optional
        Of which `images` and `depth.scale` are used.
    depth_scale : float, optional
        Counts per metre, if `config` has none; 1000 if omitted.
    number : int
        Of the file that is read to its end, as `fileno` has it.
    """

    def __init__(
        self,
        info: RecordingInfo,
        config: Config | None = None,
        *,
        depth_scale: float | None = None,
        number: int = 0,
    ) -> None:
        config = config or Config()
        self.info, self._file = replace(info, name=_WHERE), _EndableFile(number)
        self._stream = io.BufferedReader(self._file)
        self._scale = config.depth.scale or depth_scale or MILLIMETRES
        self._images_config = config.images

    def images(self) -> Iterator[StampedImage]:
        """Yield the images as they arrive, until `close`.

        Raises
        ------
        RecordingError
            If a line is not a header, or the input ends within an image.
        """
        try:
            while line := self._stream.readline(_MAX_LINE):
                if line.strip():
                    yield self._read_image(_parse(line))
        except RecordingError:
            if not self._file.is_ended:  # else the last image is cut there
                raise

    def close(self) -> None:
        """End the images. Any thread may call it."""
        self._file.end()

    def ground_truth(self) -> Trajectory | None:
        """Return None."""
        return None

    def _read_image(self, header: dict[str, Any]) -> StampedImage:
        stream = self._stream_of(header)
        stamp_ns = _whole(header, "stamp_ns", lowest=-(2**63), highest=2**63 - 1)
        load = self._loader(header, is_depth=stream == 1 and self.info.sensor == "rgbd")
        n_bytes = load.args[0].data.nbytes
        return StampedImage(stream=stream, stamp_ns=stamp_ns, load=load, n_bytes=n_bytes)

    def _stream_of(self, header: dict[str, Any]) -> int:
        names = ("left", "right") if self.info.sensor == "stereo" else ("color", "depth")
        name = header.get("stream")
        if name not in names:
            shown = cut(repr(name), _N_SHOWN)
            raise RecordingError(f'{_WHERE}: "stream" must be one of {names}, got {shown}')
        return _STREAMS[str(name)]

    def _loader(self, header: dict[str, Any], *, is_depth: bool) -> partial[NDArray[Any]]:
        """Read the bytes of an image; return the function that decodes them."""
        if "format" in header:
            size = _whole(header, "size", lowest=0, highest=_MAX_COMPRESSED)
            packed = _message(COMPRESSED_TYPE, format=str(header["format"]), data=self._read(size))
            if is_depth:
                return partial(decode_compressed_depth, packed, self._scale, _WHERE)
            return partial(decode_compressed, packed, _WHERE, self._images_config)
        raw = self._read_raw(header, is_depth=is_depth)
        if is_depth:
            return partial(decode_depth, raw, self._scale, _WHERE)
        return partial(decode_grey_or_color, raw, _WHERE, self._images_config)

    def _read_raw(self, header: dict[str, Any], *, is_depth: bool) -> Any:  # noqa: ANN401
        width, height = (_whole(header, name, lowest=1, highest=1 << 20) for name in _SIZES)
        check_size(width, height, _WHERE)
        name = str(header.get("encoding", ""))
        encoding = find_encoding(name, DEPTHS if is_depth else IMAGES, _WHERE)
        step = width * encoding.n_channels * np.dtype(encoding.dtype).itemsize
        data = self._read(step * height * encoding.rows_per_two // 2)
        fields = {"encoding": name, "is_bigendian": 0, "step": step, "data": data}
        return _message(IMAGE_TYPE, height=height, width=width, **fields)

    def _read(self, size: int) -> NDArray[np.uint8]:
        data = self._stream.read(size)
        if len(data) < size:
            raise RecordingError(f"{_WHERE}: ends after {len(data)} of {size} bytes of an image")
        return np.frombuffer(data, dtype=np.uint8)


class _EndableFile(io.RawIOBase):
    """A file whose end another thread may declare while it is waited for."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._end, self._ends = os.pipe()
        self.is_ended = False

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401 - whatever is writable
        ready, _, _ = select.select([self._number, self._end], [], [])
        return 0 if self._end in ready else os.readv(self._number, [buffer])

    def end(self) -> None:
        self.is_ended = True
        os.write(self._ends, b".")


def _message(type_: str, **fields: object) -> Any:  # noqa: ANN401 - made at run time
    """Return a message of ROS 2 without a header."""
    make_message: Callable[..., Any] = typestore(is_ros1=False).types[type_]
    return make_message(header=None, **fields)


def _parse(line: bytes) -> dict[str, Any]:
    try:
        header = json.loads(line)
    except (ValueError, RecursionError) as error:
        shown = cut(repr(line[:_N_SHOWN]), _N_SHOWN)
        raise RecordingError(f"{_WHERE}: expected a line of JSON, got {shown}: {error}") from error
    if not isinstance(header, dict):
        raise RecordingError(f"{_WHERE}: expected an object of JSON, got {cut(repr(header), 40)}")
    return header


def _whole(header: dict[str, Any], name: str, *, lowest: int, highest: int) -> int:
    value = header.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
        shown = cut(repr(value), _N_SHOWN)
        raise RecordingError(
            f'{_WHERE}: "{name}" must be a whole number from {lowest} to {highest}, got {shown}'
        )
    return value


class Device:
    """A stereo camera read by `cv2.VideoCapture`.

    An image's stamp is the time when it was grabbed; in a video file, the file's own time.

    Parameters
    ----------
    names : sequence of str
        One or two device numbers or video files; a single one shows left and right side by side.
    info : RecordingInfo
        Of a stereo camera: `gvo.Rig(...).info`.

    Raises
    ------
    RecordingError
        If one cannot be opened.
    """

    def __init__(self, names: Sequence[str], info: RecordingInfo) -> None:
        if info.sensor != "stereo" or len(names) not in (1, 2):
            raise RecordingError(
                "a camera read by OpenCV has no depth: name one device that shows left and right "
                f"side by side, or two, not {len(names)} of a {info.sensor} camera"
            )
        self.info = replace(info, name=" + ".join(names))
        self._captures = [_opened(name) for name in names]

    def images(self) -> Iterator[StampedImage]:
        """Yield left and right images as they are grabbed, until a device ends."""
        first_ns = time.time_ns()
        try:
            while all(capture.grab() for capture in self._captures):
                stamp_ns = self._stamp_ns(first_ns)
                for stream, pixels in enumerate(self._retrieve()):
                    load = partial(np.asarray, pixels)
                    yield StampedImage(
                        stream=stream, stamp_ns=stamp_ns, load=load, n_bytes=pixels.nbytes
                    )
            if not self._is_film:
                raise RecordingError(f"{self.info.name}: the camera gives no more images")
        finally:
            for capture in self._captures:
                capture.release()

    def ground_truth(self) -> Trajectory | None:
        """Return None."""
        return None

    def _stamp_ns(self, first_ns: int) -> int:
        """Return the time within a video file, or the time of the clock."""
        if self._is_film:
            position_ms = self._captures[0].get(cv2.CAP_PROP_POS_MSEC)
            return first_ns + round(position_ms * _MILLISECOND_NS)
        return time.time_ns()

    @property
    def _is_film(self) -> bool:
        return self._captures[0].get(cv2.CAP_PROP_FRAME_COUNT) > 0

    def _retrieve(self) -> list[NDArray[Any]]:
        found = [capture.retrieve() for capture in self._captures]
        if not all(is_there for is_there, _ in found):
            raise RecordingError("a device gave an image that cannot be decoded")
        pixels = [image for _, image in found]
        if len(pixels) == 1:
            width = pixels[0].shape[1] // 2
            pixels = [pixels[0][:, :width], pixels[0][:, width : 2 * width]]
        return pixels


def _opened(name: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(int(name) if name.isascii() and name.isdecimal() else name)
    if not capture.isOpened():
        raise RecordingError(f"{name}: OpenCV opens no camera or film by this name")
    return capture
