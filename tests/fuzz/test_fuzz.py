"""Each reader stands its seeds and some hundred changes of them."""

import random

import pytest

from tests.fuzz import bags, pictures, texts
from tests.fuzz.target import Target

TARGETS = [*pictures.TARGETS, *bags.TARGETS, *texts.TARGETS]


def stand(target: Target, n_changes: int) -> None:
    rng, seeds = random.Random(target.name), target.seeds()
    n_understood = sum(target.execute(seed) for seed in seeds)
    assert n_understood > 0
    for _ in range(n_changes):
        data = rng.choice(seeds)
        for _ in range(rng.choice((1, 1, 2, 5))):
            data = target.mutate(data, rng)
        target.execute(data[:32768])


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_reader_stands_seeds_and_a_few_changes_of_them(target: Target) -> None:
    stand(target, 5)


@pytest.mark.acceptance
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_reader_stands_many_changes(target: Target) -> None:
    stand(target, 40 if target.is_slow else 500)
