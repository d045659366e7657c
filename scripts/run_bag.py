"""Run odometry over a bag or a data-set folder, and compare raw with smoothed.

Where the recording holds its truth, both are compared with it; else smoothed with raw.

Example: python scripts/run_bag.py drive.mcap out --set window.n_links=2
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> int:
    """Parse the arguments, run, print the errors, draw both from above."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="bag, MCAP, or data-set folder")
    parser.add_argument("out", type=Path, help="folder for trajectories, summary and pictures")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()

    config = gvo.load_configuration(settings=arguments.set)
    source = gvo.open_recording(arguments.recording, config=config)
    print(*source.info.decisions, sep="\n")
    result = gvo.run_recording(source, arguments.out, config=config)
    for warning in result.warnings:
        print(f"run_bag: warning: {warning}", file=sys.stderr)

    names = ("raw", "smoothed")
    poses = {name: gvo.read_trajectory(arguments.out / f"{name}.txt") for name in names}
    reference = source.ground_truth() or poses.pop("raw")
    evaluations = [gvo.evaluate(reference, each, name=name) for name, each in poses.items()]
    print(gvo.format_evaluations(evaluations), end="")
    gvo.plot_trajectories(arguments.out / "compared.png", reference, poses)
    return 0 if result.is_complete else 3


if __name__ == "__main__":
    try:
        sys.exit(main())
    except gvo.GvoError as error:
        print(f"run_bag: error: {error}", file=sys.stderr)
        sys.exit(2)
