"""Measure errors, cost, loops, darkness, pose graphs, the map of a long run, and a running camera.

Each sub-command says by `--help` what it measures and how.

Example: python scripts/benchmark.py errors kitti_06_start euroc_mh01_start
Example: python scripts/benchmark.py errors --kind hand --seeds 10 --readout 25 --keep rendered
Example: python scripts/benchmark.py cost kitti_06_start --demo --against ../before
"""

import argparse
import sys

from benchmarks import cost, dark, errors, graphs, live, loops, maps  # type: ignore[import-not-found]

import gvo

COMMANDS = {
    "errors": errors,
    "cost": cost,
    "loops": loops,
    "dark": dark,
    "graphs": graphs,
    "map": maps,
    "live": live,
}


def main() -> None:
    """Parse the arguments and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=module.__doc__.splitlines()[0],
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_options(command)
    arguments = parser.parse_args()
    COMMANDS[arguments.command].measure(arguments)


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"benchmark: error: {error}", file=sys.stderr)
        sys.exit(2)
