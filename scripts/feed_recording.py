"""Write the images of a recording to standard output as `gvo live -` reads them, at their rate.

Example: python scripts/feed_recording.py drive.mcap | gvo live - --calibration camera.yaml
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

import gvo
from gvo.io.recording import Source

_ENCODINGS = {
    ("uint8", 2): "mono8",
    ("uint8", 3): "bgr8",
    ("uint16", 2): "16UC1",
    ("float32", 2): "32FC1",
}


def main() -> None:
    """Parse the arguments and send."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0, help="of the recorded one; 0: no pause")
    arguments = parser.parse_args()
    source = gvo.open_recording(arguments.recording)
    try:
        feed(source, arguments.rate)
    except (KeyboardInterrupt, BrokenPipeError):  # who reads has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def feed(source: Source, rate: float) -> None:
    """Write all images, as fast as they were recorded, times the rate; 0 without a pause."""
    names = ("left", "right") if source.info.sensor == "stereo" else ("color", "depth")
    first_ns, started_s = None, time.monotonic()
    for image in source.images():
        first_ns = image.stamp_ns if first_ns is None else first_ns
        if rate > 0:
            due_s = started_s + 1e-9 * (image.stamp_ns - first_ns) / rate
            time.sleep(max(due_s - time.monotonic(), 0.0))
        send(names[image.stream], image.stamp_ns, image.load())


def send(stream: str, stamp_ns: int, pixels: NDArray[Any]) -> None:
    """Write one image."""
    height, width = pixels.shape[:2]
    header = {
        "stream": stream,
        "stamp_ns": stamp_ns,
        "encoding": _ENCODINGS[pixels.dtype.name, pixels.ndim],
        "width": width,
        "height": height,
    }
    sys.stdout.buffer.write(json.dumps(header).encode() + b"\n" + pixels.tobytes())  # row by row
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"feed_recording: error: {error}", file=sys.stderr)
        sys.exit(2)
