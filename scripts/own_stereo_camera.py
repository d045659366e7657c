"""Odometry of a stereo camera of your own, whose driver gives both images side by side.

Example: python scripts/own_stereo_camera.py 0 --calibration camchain.yaml
Example: python scripts/own_stereo_camera.py pairs.avi --calibration left.yaml right.yaml
"""

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Thread

import cv2
import numpy as np

import gvo
from gvo.trajectory.formats import write_tum

Pair = tuple[int, np.ndarray]


def pairs_of_file(capture: cv2.VideoCapture) -> Iterator[Pair]:
    """Yield all pairs of a video, stamped by its rate."""
    period_ns = 1e9 / (capture.get(cv2.CAP_PROP_FPS) or 30.0)
    n = 0
    while (answer := capture.read())[0]:
        yield round(n * period_ns), answer[1]
        n += 1


def pairs_of_device(capture: cv2.VideoCapture) -> Iterator[Pair]:
    """Yield the newest pair of a camera each time; those that came meanwhile are dropped."""
    waiting: Queue[Pair | None] = Queue()

    def grab() -> None:
        while (answer := capture.read())[0]:
            with suppress(Empty):  # where the loop was fast enough
                waiting.get_nowait()
            waiting.put((time.monotonic_ns(), answer[1]))
        waiting.put(None)

    Thread(target=grab, daemon=True).start()
    while (pair := waiting.get()) is not None:
        yield pair


def track(pairs: Iterator[Pair], rig: gvo.Rig) -> Iterator[gvo.Estimate]:
    """Print the pose of each pair, and yield the smoothed poses; Ctrl-C ends."""
    odometry = gvo.Odometry(rig.camera)
    try:
        for stamp_ns, pair in pairs:
            left, right = np.hsplit(pair, 2)
            result = odometry.track(rig.frame(stamp_ns, left, right))
            print(f"{stamp_ns * 1e-9:.3f} s", result.status, result.causal.T_world_frame[:3, 3])
            yield from result.finished
    except KeyboardInterrupt:
        print("interrupted")
    yield from odometry.finish()


def main() -> int:
    """Open camera and calibration, track, write the trajectory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("camera", help="number of a device, or a video")
    parser.add_argument("--calibration", type=Path, nargs="+", required=True, metavar="FILE")
    parser.add_argument("--rectified", action="store_true", help="the images are rectified")
    parser.add_argument("--out", type=Path, default=Path("smoothed.txt"), help="poses, TUM format")
    arguments = parser.parse_args()

    rig = gvo.Rig(*arguments.calibration, is_rectified=arguments.rectified)
    is_device = arguments.camera.isdecimal()
    capture = cv2.VideoCapture(int(arguments.camera) if is_device else arguments.camera)
    if not capture.isOpened():
        raise gvo.GvoError(f"{arguments.camera}: OpenCV cannot open it; give a device or a video")
    pairs = pairs_of_device(capture) if is_device else pairs_of_file(capture)
    trajectory = gvo.Trajectory.of(track(pairs, rig))
    write_tum(arguments.out, trajectory)
    print(f"wrote {arguments.out}: {len(trajectory)} poses")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (gvo.GvoError, ValueError) as error:
        print(f"own_stereo_camera: error: {error}", file=sys.stderr)
        sys.exit(2)
