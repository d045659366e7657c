"""Write a data-set folder (KITTI odometry, EuRoC, TUM RGB-D) as a bag.

Example: python scripts/convert_dataset.py kitti/sequences/06 kitti_06.bag
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> None:
    """Parse the arguments and convert."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="data-set folder")
    parser.add_argument("bag", type=Path, help=".bag, .mcap, or a ROS 2 folder to make")
    parser.add_argument("--rectify", action="store_true", help="rectify the images")
    arguments = parser.parse_args()

    source = gvo.open_recording(arguments.folder)
    written = gvo.convert(source, arguments.bag, rectify=arguments.rectify)
    print(f"wrote {written.path}: {written.n_images} images, {written.n_poses} true poses")


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"convert_dataset: error: {error}", file=sys.stderr)
        sys.exit(2)
