"""Medians at the values of swept parameters, against planted effects."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.batch.effects import (
    ERROR,
    comparable,
    is_non_dominated,
    relative,
    value_medians,
    variant_means,
)
from gvo.batch.results import to_frame
from gvo.batch.tasks import BatchRow
from tests.batch.rows import complete, failed

SIZES, KINDS = (5, 10, 20), ("orb", "klt")
RATIOS = {5: 1.0, 10: 2.0, 20: 1.5, "orb": 1.0, "klt": 1.1}


def crossed(n_recordings: int) -> list[BatchRow]:
    """Return every recording with every pair of values; errors are products of what is planted."""
    return [
        complete(
            recording=f"recording {number}",
            variant=f"{size} {kind}",
            parameters={"frontend.kind": kind, "window.size": size},
            ate_smoothed_m=10.0**number * RATIOS[size] * RATIOS[kind],
            frame_ms=5.0 / RATIOS[size],
        )
        for number, size, kind in itertools.product(range(n_recordings), SIZES, KINDS)
    ]


def failing(rows: Sequence[BatchRow], fails: Callable[[BatchRow], bool]) -> list[BatchRow]:
    return [failed(row) if fails(row) else row for row in rows]


def medians(effect: pd.DataFrame, measure: str = "error") -> list[float]:
    values: list[float] = effect[measure, "median"].tolist()
    return values


def test_planted_ratios_come_back_those_of_the_largest_change_first() -> None:
    effects = value_medians(to_frame(crossed(4)))
    assert [*effects] == ["window.size", "frontend.kind"]
    size, kind = effects.values()
    assert size.index.tolist() == [5, 10, 20]
    assert kind.index.tolist() == ["orb", "klt"]
    assert np.array(medians(size)) / medians(size)[0] == pytest.approx([1.0, 2.0, 1.5])
    assert medians(size, "time") == pytest.approx([1.5, 0.75, 1.0])
    assert medians(kind)[1] / medians(kind)[0] == pytest.approx(1.1)
    assert size["runs", "compared"].tolist() == [8, 8, 8]


def test_quartiles_are_those_of_numpy_over_all_runs_of_a_value() -> None:
    errors = np.exp(np.random.default_rng(3).normal(size=(5, 3, 2)))
    rows = [
        replace(row, ate_smoothed_m=float(error))
        for row, error in zip(crossed(5), errors.ravel(), strict=True)
    ]
    size = value_medians(to_frame(rows))["window.size"]
    ratios = errors / np.median(errors, axis=(1, 2), keepdims=True)
    expected = np.quantile(ratios, [0.25, 0.5, 0.75], axis=(0, 2)).T
    np.testing.assert_allclose(size["error"][["low", "median", "high"]].to_numpy(), expected)


def test_a_value_that_always_fails_is_counted_and_leaves_the_others_to_be_compared() -> None:
    table = to_frame(failing(crossed(4), lambda row: row.parameters["window.size"] == 20))
    size = value_medians(table)["window.size"]
    assert np.isnan(medians(size)[2])
    assert medians(size)[1] / medians(size)[0] == pytest.approx(2.0)
    assert size["runs", "failed"].tolist() == [0, 0, 8]
    assert size["runs", "set aside"].tolist() == [0, 0, 0]


def test_a_run_that_lost_the_camera_is_set_aside_where_others_did_not() -> None:
    rows = crossed(2)
    rows[0] = replace(rows[0], coverage_percent=40.0, ate_smoothed_m=1e-6)
    # there all lost it: nothing is wrong with either
    rows[6:] = [replace(row, coverage_percent=40.0) for row in rows[6:]]
    table = to_frame(rows)
    assert comparable(table).tolist() == [False, *[True] * 11]
    size = value_medians(table)["window.size"]
    assert size["runs", "set aside"].tolist() == [1, 0, 0]
    without = value_medians(to_frame(rows[1:]))["window.size"]
    pd.testing.assert_frame_equal(size[["error"]], without[["error"]])
    # what is set aside has its ratio, but is in no median
    assert relative(table, ERROR)[0] < 1e-5


def test_without_truth_times_are_compared() -> None:
    rows = [replace(row, ate_smoothed_m=None) for row in crossed(2)]
    effects = value_medians(to_frame(rows))
    assert [*effects] == ["window.size", "frontend.kind"]
    assert np.isnan(medians(effects["window.size"])).all()
    assert effects["window.size"]["runs", "compared"].tolist() == [4, 4, 4]


def test_where_all_runs_failed_they_are_counted() -> None:
    effects = value_medians(to_frame(failing(crossed(1), lambda _: True)))
    assert [effect["runs", "failed"].tolist() for effect in effects.values()] == [[3, 3], [2] * 3]


def test_one_configuration_has_nothing_to_compare() -> None:
    rows = [replace(row, parameters={}) for row in crossed(2)]
    assert value_medians(to_frame(rows)) == {}


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
