"""Render a recording with exact ground truth and write it as a bag.

Example: python scripts/make_demo_bag.py room.bag --world handheld --sensor rgbd
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> None:
    """Parse the arguments, render, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag", type=Path, help=".bag, .mcap, or a ROS 2 folder to make")
    parser.add_argument("--world", choices=["driving", "handheld"], default="driving")
    parser.add_argument("--sensor", choices=["stereo", "rgbd"], default="stereo")
    parser.add_argument("--frames", type=int, choices=range(1, 100_000), default=100, metavar="N")
    parser.add_argument("--seed", type=int, choices=range(2**31), default=0, metavar="N")
    arguments = parser.parse_args()

    recording = gvo.SyntheticRecording(
        world=arguments.world,
        sensor=arguments.sensor,
        n_frames=arguments.frames,
        seed=arguments.seed,
    )
    written = gvo.convert(recording, arguments.bag)
    print(f"wrote {written.path}: {written.n_images} images, {written.n_poses} true poses")


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"make_demo_bag: error: {error}", file=sys.stderr)
        sys.exit(2)
