"""Measure the tests themselves: the branches they take, and the faults that they notice.

--coverage   runs the whole suite, commands that it starts among it, and prints the branch coverage
             of each file of gvo/ that is not covered wholly, and of all
--mutation   plants small faults in geometry/, backend/ and evaluation.py, one at a time, and
             prints how many make a test fail; see `mutants.py` and `mutation.py` beside

A sample (--sample, --seed) comes with the 95 % interval of the share of all (Wilson's).

Example: python tests/quality/assurance.py --mutation --sample 400 --seed 0 --jobs 2
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from mutation import (  # type: ignore[import-not-found]
    KILLED,
    SURVIVED,
    TIMEOUT,
    UNUSABLE,
    Mutation,
)

ROOT = Path(__file__).resolve().parents[2]
PATHS = ("gvo/geometry", "gvo/backend", "gvo/trajectory/evaluation.py")
TESTS = ("tests/geometry", "tests/backend", "tests/trajectory", "tests/odometry/test_graph.py")
MIN_COVERAGE = 0.95
MIN_KILLED = 0.85
RESULTS = Path(tempfile.gettempdir()) / "gvo-mutation.json"
COVERAGE = """
[run]
branch = true
source_pkgs = gvo
parallel = true
core = ctrace
patch = subprocess
sigterm = true
data_file = {folder}/data
[report]
exclude_also =
    if TYPE_CHECKING:
"""


def main() -> int:
    """Parse the arguments, measure, and return 1 where less than the aim was reached."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--coverage", action="store_true")
    which.add_argument("--mutation", action="store_true")
    parser.add_argument("--paths", nargs="+", default=PATHS, help="files or folders to mutate")
    parser.add_argument("--tests", nargs="+", help="what pytest is given")
    parser.add_argument("--sample", type=int, help="number of mutants; all where omitted")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS, help="kept between runs")
    parser.add_argument("--spare-s", type=float, default=5.0, help="for each test of a mutant")
    parser.add_argument("--again", action="store_true", help="run what survived once more")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    os.environ["OMP_NUM_THREADS"] = "1"
    return measure_coverage(arguments) if arguments.coverage else measure_mutation(arguments)


def measure_coverage(arguments: argparse.Namespace) -> int:
    """Run the suite under coverage.py; 1 where tests fail or too few branches are taken."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "coveragerc"
        settings.write_text(COVERAGE.format(folder=folder), encoding="utf-8")
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        world = {
            **os.environ,
            "COVERAGE_RCFILE": str(settings),
            "PYTHONPATH": os.pathsep.join(paths),
        }

        def run(*command: str) -> int:
            return subprocess.run(
                [sys.executable, "-m", *command], env=world, check=False
            ).returncode

        tests, jobs = arguments.tests or [], str(arguments.jobs)
        failed = run("coverage", "run", "-m", "pytest", "-q", "-m", "", "-n", jobs, *tests)
        run("coverage", "combine", "--quiet")
        run("coverage", "json", "--quiet", "-o", f"{folder}/report.json")
        run("coverage", "report", "--show-missing", "--skip-covered", "--sort=cover")
        totals = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))["totals"]
    taken, n_branches = totals["covered_branches"], totals["num_branches"]
    print(f"branches taken: {taken} of {n_branches}, {100.0 * taken / n_branches:.1f} %")
    return failed or int(taken < MIN_COVERAGE * n_branches)


def measure_mutation(arguments: argparse.Namespace) -> int:
    """Run the mutants and print what became of those of each file."""
    sys.path.insert(0, str(ROOT))
    plugin = Mutation(
        paths=[file for path in arguments.paths for file in python_files(Path(path))],
        results_file=arguments.results.resolve(),
        sample=arguments.sample,
        seed=arguments.seed,
        jobs=arguments.jobs,
        spare_s=arguments.spare_s,
        again=arguments.again,
    )
    options = [
        *("-q", "-s", "-p", "no:cacheprovider", "-n", "0", "-m", "not acceptance", "--tb=native"),
    ]
    with redirect_stdout(sys.stderr):
        pytest.main([*options, *(arguments.tests or TESTS)], plugins=[plugin])
    return print_results(plugin, is_sample=arguments.sample is not None)


def python_files(path: Path) -> list[Path]:
    """Return a file, or those of a folder."""
    return sorted(path.rglob("*.py")) if path.is_dir() else [path]


def print_results(plugin: Mutation, *, is_sample: bool) -> int:
    """Print survivors and a table; 1 where too many survived."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant in sorted(plugin.mutants, key=lambda each: (str(each.path), each.lines)):
        result = plugin.results.get(mutant.key, "not run")
        counts[str(mutant.path)][result] += 1
        if result == SURVIVED:
            change = f"{mutant.before!r} -> {mutant.after!r}"
            print(f"{mutant.path}:{mutant.lines[0]} {mutant.scope}: {mutant.operator} {change}")
    total = sum(counts.values(), Counter())
    columns = (KILLED, TIMEOUT, SURVIVED, UNUSABLE, "not run")
    print(f"{'file':<36}" + "".join(f"{name:>10}" for name in columns) + f"{'share':>9}")
    for name, row in [*counts.items(), ("all", total)]:
        cells = "".join(f"{row[column]:>10}" for column in columns)
        print(f"{name:<36}{cells}{100.0 * share(row):>7.1f} %")
    if is_sample or total["not run"]:
        low, high = interval(total)
        print(f"share of all mutants, 95 % interval: {100.0 * low:.1f} to {100.0 * high:.1f} %")
    return int(share(total) < MIN_KILLED)


def share(row: Counter[str]) -> float:
    """Return the share that was noticed, of those that ran."""
    noticed = row[KILLED] + row[TIMEOUT]
    return noticed / max(noticed + row[SURVIVED], 1)


def interval(row: Counter[str]) -> tuple[float, float]:
    """Return Wilson's interval of a share, 95 %."""
    n, p, z = row[KILLED] + row[TIMEOUT] + row[SURVIVED], share(row), 1.96
    if n == 0:
        return 0.0, 1.0
    centre = p + z * z / (2.0 * n)
    half = z * math.sqrt(p * (1.0 - p) / n + z * z / (4.0 * n * n))
    return (centre - half) / (1.0 + z * z / n), (centre + half) / (1.0 + z * z / n)


if __name__ == "__main__":
    sys.exit(main())
