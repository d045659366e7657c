"""Time reading a bag as frames against the bare loop of rosbags that decodes the same images.

Both read the same two topics on one thread, in turns; what is compared is process CPU time. The
bare loop takes each message, deserialises it, decodes the image (a view of raw pixels, OpenCV for
compressed ones) and calls OpenCV once to make it grey and once to rectify it, where that is needed.
`gvo` checks, pairs by stamp and makes depth metres with NaN for unknown besides.

Example: python scripts/benchmark_reading.py drive.mcap
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

import gvo
from gvo.geometry.camera import rectification_maps
from gvo.io.bag.source import BagSource
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Source

Maps: TypeAlias = list[Any]

_ENCODINGS: dict[str, tuple[type[np.generic], int]] = {
    "8UC1": (np.uint8, 1),
    "mono8": (np.uint8, 1),
    "bgr8": (np.uint8, 3),
    "rgb8": (np.uint8, 3),
    "16UC1": (np.uint16, 1),
    "mono16": (np.uint16, 1),
    "32FC1": (np.float32, 1),
}


def main() -> None:
    """Parse the arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    parser.add_argument("--rounds", type=int, default=5, help="passes of each, in turns")
    arguments = parser.parse_args()
    if arguments.rounds < 1:
        parser.error("--rounds must be at least 1")
    print("| bag | images | bare ms | frames ms | ratio |")
    print("|---|---|---|---|---|")
    with one_opencv_thread():
        for bag in arguments.bags:
            print(measure(bag, arguments.rounds))


def measure(bag: Path, n_rounds: int) -> str:
    """Return one line of the table, milliseconds of CPU per image."""
    source = gvo.open_recording(bag)
    if not isinstance(source, BagSource):
        raise gvo.GvoError(f"{bag}: is no bag")
    maps = make_maps(source)
    bare, whole = [], []
    n_images = 0
    for _ in range(n_rounds):
        elapsed_ms, n_images = timed(lambda: read_bare(bag, source, maps))
        bare.append(elapsed_ms / n_images)
        elapsed_ms, _ = timed(lambda: read_frames(source))
        whole.append(elapsed_ms / n_images)
    ratio = statistics.median(b / a for a, b in zip(bare, whole, strict=True))
    medians = f"{statistics.median(bare):.2f} | {statistics.median(whole):.2f}"
    return f"| {bag.name} | {n_images} | {medians} | {ratio:.2f} |"


def timed(read: Callable[[], int]) -> tuple[float, int]:
    """Return milliseconds of CPU and what a function returns."""
    start = time.process_time()
    n_images = read()
    return 1e3 * (time.process_time() - start), n_images


def read_bare(bag: Path, source: BagSource, maps: Maps) -> int:
    """Read the images of both topics with rosbags alone; return their number."""
    n_images = 0
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic in source.image_topics]
        for connection, _, data in reader.messages(connections=connections):
            image: Any = pixels(reader.deserialize(data, connection.msgtype))
            if image.ndim == 3 and image.shape[2] == 3:
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            stream = source.image_topics.index(connection.topic)
            if maps[stream] is not None:
                is_depth = stream == 1 and source.info.sensor == "rgbd"
                map_u, map_v = maps[stream]
                mode = cv2.INTER_NEAREST if is_depth else cv2.INTER_LINEAR
                cv2.remap(image, map_u, map_v, mode)
            n_images += 1
    return n_images


def make_maps(source: BagSource) -> Maps:
    """Return the maps that rectify both streams; None where that is not needed."""
    info = source.info
    first, second = (rectification_maps(c) for c in (info.calibrations * 2)[:2])
    if info.sensor == "stereo":
        second = rectification_maps(info.calibrations[1])
    fixed = [
        maps if maps is None or is_depth else cv2.convertMaps(*maps, cv2.CV_16SC2)
        for maps, is_depth in ((first, False), (second, info.sensor == "rgbd"))
    ]
    return fixed


def pixels(message: Any) -> np.ndarray[Any, Any]:  # noqa: ANN401 - made at run time
    """Return the pixels of a message as they stand there."""
    if hasattr(message, "format"):
        skipped = 12 if "compressedDepth" in message.format else 0
        return np.asarray(cv2.imdecode(message.data[skipped:], cv2.IMREAD_UNCHANGED))
    dtype, n_channels = _ENCODINGS[message.encoding]
    shape = (message.height, message.width, n_channels)
    return np.asarray(message.data.view(dtype).reshape(shape[: 2 + (n_channels > 1)]))


def read_frames(source: Source) -> int:
    """Read the frames; return their number."""
    config = gvo.load_configuration(settings=["runtime.threads=1"])
    return sum(1 for _ in gvo.frames(source, config))


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"benchmark_reading: error: {error}", file=sys.stderr)
        sys.exit(2)
