"""Each reader stands its seeds and some hundred changes of them."""

import random

import pytest

from tests.fuzz.mutations import mutate_bytes
from tests.fuzz.target import Target
from tests.fuzz.targets import TARGETS

# What opens files, or smooths, takes milliseconds an execution.
_SLOW = {"smoothed_lines", "sqlite_bags", "mcap_bags", "ros1_bags", "recordings", "configurations"}


def stand(target: Target, n_changes: int) -> None:
    rng = random.Random(target.name)
    seeds = target.seeds()
    for seed in seeds:
        target.execute(seed)
    mutate = target.mutate or mutate_bytes
    for _ in range(n_changes):
        data = rng.choice(seeds)
        for _ in range(rng.choice((1, 1, 2, 5))):
            data = mutate(data, rng)
        target.execute(data[: target.max_bytes])


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_stands_seeds_and_a_few_changes_of_them(name: str) -> None:
    stand(TARGETS[name], 5)


@pytest.mark.acceptance
@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_stands_many_changes(name: str) -> None:
    stand(TARGETS[name], 80 if name in _SLOW else 1000)


@pytest.mark.acceptance
@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_what_a_reader_understands(name: str) -> None:
    def is_read(seed: bytes) -> bool:
        try:
            TARGETS[name].run(seed)
        except Exception:  # noqa: BLE001 - refused, for whatever reason
            return False
        return True

    assert any(map(is_read, TARGETS[name].seeds()))
