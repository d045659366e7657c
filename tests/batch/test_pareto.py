"""The front of accuracy against time, against brute force and planted configurations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.batch.pareto import is_non_dominated, variant_means
from gvo.batch.results import to_frame
from gvo.batch.rows import BatchRow
from tests.batch.rows import complete, failed

LEVELS = (0.01, 1.0, 100.0)


def runs_of(
    variants: dict[str, tuple[float, float]], failures: set[tuple[str, int]]
) -> list[BatchRow]:
    """Return runs of configurations with an error and a time each; pairs with a number failed."""
    rows = []
    for number, level in enumerate(LEVELS):
        for name, (error, time) in variants.items():
            row = complete(
                recording=f"recording {number}",
                variant=name,
                ate_smoothed_m=level * error,
                frame_ms=time,
            )
            rows.append(failed(row) if (name, number) in failures else row)
    return rows


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=25))
def test_the_front_is_what_brute_force_finds(points: list[tuple[int, int]]) -> None:
    found = is_non_dominated(np.array(points, dtype=np.float64).reshape(-1, 2))
    truth = [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points) for x, y in points]
    assert found.tolist() == truth


def test_the_front_holds_the_fast_and_the_accurate_but_none_that_failed() -> None:
    variants = {"bad": (2.0, 4.0), "lucky": (0.1, 0.1), "fast": (2.0, 1.0), "good": (1.0, 4.0)}
    means = variant_means(to_frame(runs_of(variants, {("lucky", 2)})))
    assert means.index.tolist() == ["good", "fast", "bad", "lucky"]
    assert means["is_on_front"].tolist() == [True, True, False, False]
    assert means["is_candidate"].tolist() == [True, True, True, False]
    assert means["n_compared"].tolist() == [3, 3, 3, 2]
    assert set(means["n_recordings"]) == {3}
    mean = 4.0 ** (1 / 3)
    assert means["error"].tolist() == pytest.approx([1 / mean, 2 / mean, 2 / mean, 0.1 / mean])


def test_where_none_completed_all_those_with_most_are_compared_on_what_they_share() -> None:
    variants = {"x": (1.0, 1.0), "y": (3.0, 1.0), "z": (0.5, 1.0)}
    failures = {("x", 0), ("y", 1), ("z", 0), ("z", 1)}
    means = variant_means(to_frame(runs_of(variants, failures)))
    assert means.index.tolist() == ["x", "y", "z"]
    assert means["is_candidate"].tolist() == [True, True, False]
    assert means["is_on_front"].tolist() == [True, False, False]
    assert means["error"].tolist() == pytest.approx([3.0**-0.5, 3.0**0.5, 0.5 * 3.0**-0.5])


def test_without_a_common_recording_there_is_no_front() -> None:
    variants = {"x": (1.0, 1.0), "y": (1.0, 1.0)}
    means = variant_means(to_frame(runs_of(variants, {("x", 0), ("y", 1), ("x", 2), ("y", 2)})))
    assert means["error"].isna().all()
    assert not means["is_on_front"].any()
    every = {(name, number) for name in variants for number in range(len(LEVELS))}
    means = variant_means(to_frame(runs_of(variants, every)))
    assert means["error"].isna().all()
    assert not (means["is_candidate"] | means["is_on_front"]).any()
