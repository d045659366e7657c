"""Write the images of a recording to standard output as `gvo live -` reads them, at their rate.

Example: python scripts/feed_recording.py drive.mcap | gvo live - --calibration camera.yaml
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

import gvo
from gvo.io.recording import StampedImage

_ENCODINGS = {("u", 2): "mono8", ("u", 3): "bgr8", ("f", 2): "32FC1"}


def main() -> None:
    """Parse the arguments and send."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0, help="of the recorded one; 0: no pause")
    arguments = parser.parse_args()
    source = gvo.open_recording(arguments.recording)
    names = ("left", "right") if source.info.sensor == "stereo" else ("color", "depth")
    first_ns, started_s = None, time.monotonic()
    for image in source.images():
        first_ns = image.stamp_ns if first_ns is None else first_ns
        if arguments.rate > 0:
            due_s = started_s + 1e-9 * (image.stamp_ns - first_ns) / arguments.rate
            time.sleep(max(due_s - time.monotonic(), 0.0))
        send(image, names[image.stream])


def send(image: StampedImage, stream: str) -> None:
    """Write one image."""
    pixels = np.ascontiguousarray(image.load())
    height, width = pixels.shape[:2]
    header = {
        "stream": stream,
        "stamp_ns": image.stamp_ns,
        "encoding": _ENCODINGS[pixels.dtype.kind, pixels.ndim],
        "width": width,
        "height": height,
    }
    sys.stdout.buffer.write(json.dumps(header).encode() + b"\n" + pixels.tobytes())
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
