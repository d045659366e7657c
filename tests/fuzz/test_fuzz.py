"""Each target stands its seeds and some hundred changes of them; the long runs are a script's."""

import importlib.util
import random
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.mutations import mutate_bytes
from tests.fuzz.target import Target
from tests.fuzz.targets import TARGETS

SCRIPT = Path(__file__).parents[1] / "quality" / "fuzz.py"
# What opens files, or smooths, takes milliseconds an execution.
_N_SLOW = 40
_N_QUICK = 400
_SLOW = {"smoothed_lines", "sqlite_bags", "mcap_bags", "ros1_bags", "recordings", "configurations"}
_IN_SHORT_RUN = "edge_lines"
_TARGETS = [
    pytest.param(target, id=name, marks=() if name == _IN_SHORT_RUN else pytest.mark.acceptance)
    for name, target in TARGETS.items()
]


@pytest.mark.parametrize("target", _TARGETS)
def test_a_target_stands_its_seeds_and_changes_of_them(target: Target) -> None:
    rng = random.Random(target.name)
    seeds = target.seeds()
    for seed in seeds:
        target.execute(seed)
    mutate = target.mutate or mutate_bytes
    for _ in range(_N_SLOW if target.name in _SLOW else _N_QUICK):
        data = rng.choice(seeds)
        for _ in range(rng.choice((1, 1, 2, 5))):
            data = mutate(data, rng)
        target.execute(data[: target.max_bytes])


@pytest.mark.acceptance
def test_seeds_are_what_a_target_understands() -> None:
    """Most seeds get through: a fuzzer that starts from refusals never gets deep."""
    for target in TARGETS.values():
        n_read = sum(_is_read(target, seed) for seed in target.seeds())
        assert n_read > 0, target.name


def _is_read(target: Target, seed: bytes) -> bool:
    try:
        target.run(seed)
    except Exception:  # noqa: BLE001 - refused, for whatever reason
        return False
    return True


def test_a_finding_is_found() -> None:
    def run(data: bytes) -> None:
        raise KeyError(data)

    with pytest.raises(KeyError):
        Target(name="broken", run=run, seeds=lambda: [b""]).execute(b"x")


@pytest.mark.acceptance
@pytest.mark.skipif(
    importlib.util.find_spec("atheris") is None, reason="atheris has no wheel for this machine"
)
def test_the_script_counts_and_replays(tmp_path: Path) -> None:
    ran = _fuzz("--target", "encoded_images", "--runs", "300", "--findings", str(tmp_path))
    assert ran.returncode == 0, ran.stderr
    executions = int(ran.stdout.splitlines()[1].split()[1])
    assert executions >= 300
    seed = tmp_path / "seed"
    seed.write_bytes(TARGETS["encoded_images"].seeds()[0])
    replayed = _fuzz("--target", "encoded_images", "--replay", str(seed))
    assert replayed.returncode == 0, replayed.stderr
    assert "stands it" in replayed.stdout


def _fuzz(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, check=False
    )
