"""Write a data-set folder (KITTI odometry, EuRoC, TUM RGB-D) as a bag, or a bag as such a folder.

Example: python scripts/convert_dataset.py kitti/sequences/06 kitti_06.bag
Example: python scripts/convert_dataset.py drive.mcap drive --layout euroc
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> int:
    """Parse the arguments, convert, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="+", type=Path, help="data-set folder, or bags")
    parser.add_argument("target", type=Path, help=".bag, .mcap, .db3, or a folder to make")
    parser.add_argument(
        "--layout",
        choices=("bag", "kitti", "euroc", "tum"),
        help="of the folder; a data set's for a bag, else a bag's",
    )
    parser.add_argument("--rectify", action="store_true", help="rectify the images")
    parser.add_argument("--png", action="store_true", help="compress the images of a bag")
    arguments = parser.parse_args()

    written = gvo.convert(
        gvo.open_recording(arguments.recording),
        arguments.target,
        layout=arguments.layout,
        rectify=arguments.rectify,
        compress=arguments.png,
    )
    print(f"wrote {written.path}: {written.n_images} images, {written.n_poses} true poses")
    for line in written.skipped:
        print(f"convert_dataset: warning: {line}", file=sys.stderr)
    return 3 if written.skipped else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except gvo.GvoError as error:
        print(f"convert_dataset: error: {error}", file=sys.stderr)
        sys.exit(2)
