"""Compare trajectories with a reference, as `gvo compare` does.

Example: python scripts/compare_trajectories.py groundtruth.txt out/raw.txt out/smoothed.txt
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> None:
    """Parse the arguments, print the table, draw where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("reference", type=Path, help="poses, a recording's folder, or a bag")
    parser.add_argument("estimates", type=Path, nargs="+", help="files of poses")
    parser.add_argument("--plot", type=Path, help="picture to write")
    arguments = parser.parse_args()

    truth = gvo.read_ground_truth(arguments.reference)
    trajectories = {str(path): gvo.read_trajectory(path) for path in arguments.estimates}
    evaluations = [
        gvo.evaluate(truth, estimate, name=name) for name, estimate in trajectories.items()
    ]
    print(gvo.format_evaluations(evaluations), end="")
    if arguments.plot:
        gvo.plot_trajectories(arguments.plot, truth, trajectories)


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"compare_trajectories: error: {error}", file=sys.stderr)
        sys.exit(2)
