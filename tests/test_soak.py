"""A window lives long: the soak of the benchmark, a tenth of its length."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gvo

BENCHMARK = Path(__file__).parent.parent / "scripts" / "benchmark.py"
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(Path(gvo.__file__).parent.parent),
    "OMP_NUM_THREADS": "1",
}


def soak(n: int) -> subprocess.CompletedProcess[str]:
    """Run in a process of its own, as the memory of this one is that of other tests, too."""
    return subprocess.run(
        [sys.executable, str(BENCHMARK), "--soak", str(n), "--untimed"],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )


def assert_sound(answer: subprocess.CompletedProcess[str], n: int) -> None:
    # It fails by itself where a pose was not handed over exactly once, an estimate is not
    # finite, or the memory of the last tenth is above that of the second.
    assert answer.returncode == 0, answer.stderr
    tenths = [line.split() for line in answer.stdout.splitlines()[1:11]]
    assert [int(tenth) for tenth, _, _ in tenths] == list(range(1, 11))
    assert f"n_poses={n}," in answer.stdout
    # What a long life brings was there.
    for count in ("n_gated", "n_rejected", "n_coasting", "n_priors"):
        assert f"{count}=0" not in answer.stdout


def test_a_short_life_ends_well() -> None:
    assert_sound(soak(2000), 2000)


@pytest.mark.slow
def test_a_long_life_costs_no_memory_and_loses_no_pose() -> None:
    assert_sound(soak(100_000), 100_000)
