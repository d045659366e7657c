"""Run odometry over a bag or a data-set folder, as `gvo run` does.

Example: python scripts/run_bag.py drive.mcap out --set window.n_links=2
"""

import argparse
import sys
from pathlib import Path

import gvo


def main() -> int:
    """Parse the arguments, run, print the errors where the truth is known."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="bag, MCAP, or data-set folder")
    parser.add_argument("out", type=Path, help="folder for trajectories, summary and picture")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()

    config = gvo.load_configuration(settings=arguments.set)
    source = gvo.open_recording(arguments.recording, config=config)
    print(*source.info.decisions, sep="\n")
    result = gvo.run_recording(source, arguments.out, config=config)
    if result.evaluations:
        print(gvo.format_evaluations(result.evaluations), end="")
    for warning in result.warnings:
        print(f"run_bag: warning: {warning}", file=sys.stderr)
    return 0 if result.is_complete else 3


if __name__ == "__main__":
    try:
        sys.exit(main())
    except gvo.GvoError as error:
        print(f"run_bag: error: {error}", file=sys.stderr)
        sys.exit(2)
