"""Fuse the trajectories of two systems, and compare all three with the truth.

What to expect: each input is taken as odometry, so the fused steps are the mean of the inputs'
steps, weighted by their sigmas. Where errors are independent its drift is below that of both;
where one system is much better than its sigma says, as one that has closed loops, the fused
result lies between the two. With `--sigma` for each the better one gets its weight.

Example: python scripts/fuse_trajectories.py KITTI_00_gt.txt KITTI_00_ORB.txt KITTI_00_SPTAM.txt
"""

import argparse
import sys
from pathlib import Path

import gvo
from gvo.io.edges.opening import parse_sigma


def main() -> int:
    """Parse the arguments, fuse, print a row for each input and the fused one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("reference", type=Path, help="true poses")
    parser.add_argument("estimates", type=Path, nargs="+", help="files of poses, TUM or KITTI")
    parser.add_argument("--out", type=Path, default=Path("fused"), help="folder to write")
    parser.add_argument("--sigma", action="append", default=[], metavar="DEG,M")
    arguments = parser.parse_args()

    truth = gvo.read_trajectory(arguments.reference)
    sigmas = [parse_sigma(text) for text in arguments.sigma]
    source = gvo.open_edges(arguments.estimates, sigmas=sigmas)
    result = gvo.smooth_edges(source, arguments.out, ground_truth=truth)
    inputs = {path.stem: gvo.read_trajectory(path) for path in arguments.estimates}
    evaluations = [gvo.evaluate(truth, poses, name=name) for name, poses in inputs.items()]
    fused = [evaluation for evaluation in result.evaluations if evaluation.name == "smoothed"]
    print(gvo.format_evaluations([*evaluations, *fused]), end="")
    for warning in result.warnings:
        print(f"fuse_trajectories: warning: {warning}", file=sys.stderr)
    return 0 if result.is_complete else 3


if __name__ == "__main__":
    try:
        sys.exit(main())
    except gvo.GvoError as error:
        print(f"fuse_trajectories: error: {error}", file=sys.stderr)
        sys.exit(2)
