"""Odometry of an RGB-D camera of your own, from a folder of colour and depth images.

Example: python scripts/own_rgbd_camera.py room --intrinsics 525 525 319.5 239.5 --rate 30

The folder holds `color/` with images of any kind and `depth/` with 16-bit images registered to
them, of the same names. A number without one of its images counts as a frame that was dropped.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import gvo


def read_frames(folder: Path, *, rate_hz: float, depth_scale: float) -> Iterator[gvo.RgbdFrame]:
    """Yield the frames of a folder, stamped by their number."""
    for n, path in enumerate(sorted((folder / "color").glob("*"))):
        color = cv2.imread(str(path), cv2.IMREAD_COLOR)
        counts = cv2.imread(str(folder / "depth" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
        if color is None or counts is None:
            print(f"{path.name}: dropped", file=sys.stderr)
            continue
        depth = counts.astype(np.float32) / np.float32(depth_scale)
        depth[counts == 0] = np.nan  # unknown
        grey = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY).astype(np.uint8)
        yield gvo.RgbdFrame(stamp_ns=round(n * 1e9 / rate_hz), image=grey, depth=depth)


def main() -> int:
    """Read the first image for its size, track, write the trajectory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="with color/ and depth/")
    numbers = ("FX", "FY", "CX", "CY")
    parser.add_argument("--intrinsics", type=float, nargs=4, metavar=numbers, required=True)
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second")
    parser.add_argument("--depth-scale", type=float, default=1000.0, help="counts per metre")
    parser.add_argument("--out", type=Path, default=Path("smoothed.txt"), help="poses, TUM format")
    arguments = parser.parse_args()

    if not (arguments.rate > 0.0 and arguments.depth_scale > 0.0):
        parser.error("--rate and --depth-scale must be positive")
    options = {"rate_hz": arguments.rate, "depth_scale": arguments.depth_scale}
    first = next(read_frames(arguments.folder, **options), None)
    if first is None:
        raise gvo.GvoError(f"{arguments.folder}: no image in color/ with one in depth/")
    (height, width), (fx, fy, cx, cy) = first.image.shape, arguments.intrinsics
    camera = gvo.PinholeCamera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    odometry = gvo.Odometry(camera)
    for frame in read_frames(arguments.folder, **options):
        result = odometry.track(frame)
        print(frame.stamp_ns, result.status, result.causal.T_world_frame[:3, 3])
    smoothed = odometry.trajectories()["smoothed"]
    smoothed.write(arguments.out)
    print(f"wrote {arguments.out}: {len(smoothed)} poses")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (gvo.GvoError, ValueError) as error:
        print(f"own_rgbd_camera: error: {error}", file=sys.stderr)
        sys.exit(2)
