"""Effects of swept parameters, against planted ones, plain means, scipy and brute force."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gvo.parameter_effects import (
    ParameterEffect,
    Runs,
    accuracy_front,
    is_non_dominated,
    parameter_effects,
)
from gvo.types import BoolArray, FloatArray

Sweep: TypeAlias = Mapping[str, Sequence[int | float | str | bool]]
SWEEP: Sweep = {"window.size": [5, 10, 20], "frontend.kind": ["orb", "klt"]}


def crossed(n_recordings: int, sweep: Sweep) -> Runs:
    """Return every recording with every combination of values, all runs complete."""
    cells = [*itertools.product(range(n_recordings), *sweep.values())]
    return Runs(
        recordings=[f"recording {cell[0]}" for cell in cells],
        variants=[str(cell[1:]) for cell in cells],
        parameters={name: [cell[n] for cell in cells] for n, name in enumerate(sweep, start=1)},
        is_failed=np.zeros(len(cells), dtype=np.bool_),
        n_poses=np.full(len(cells), 100.0),
    )


def failing(runs: Runs, is_failed: BoolArray) -> Runs:
    return Runs(
        recordings=runs.recordings,
        variants=runs.variants,
        parameters=runs.parameters,
        is_failed=is_failed,
        n_poses=np.where(is_failed, np.nan, runs.n_poses),
    )


def planted(runs: Runs, ratios: Mapping[str, Mapping[object, float]]) -> FloatArray:
    """Return errors that are the product of the recording's level and its values' ratios."""
    levels = 10.0 ** (runs.recording_codes() % 5 - 2.0)
    for name, by_value in ratios.items():
        levels = levels * np.array([by_value[value] for value in runs.parameters[name]])
    return np.asarray(levels, dtype=np.float64)


def by_name(effects: Sequence[ParameterEffect]) -> dict[str, ParameterEffect]:
    return {effect.name: effect for effect in effects}


def logs_of(effect: ParameterEffect) -> list[float]:
    return [math.log(each.ratio) if each.ratio is not None else math.nan for each in effect.values]


RATIOS: dict[str, dict[object, float]] = {
    "window.size": {5: 1.0, 10: 2.0, 20: 1.0},
    "frontend.kind": {"orb": 1.0, "klt": 1.1},
}


def test_a_planted_ratio_of_two_is_a_difference_of_log_two() -> None:
    runs = crossed(4, SWEEP)
    size, kind = parameter_effects(runs, planted(runs, RATIOS))
    assert [size.name, kind.name] == ["window.size", "frontend.kind"]
    logs = logs_of(size)
    assert logs[1] - logs[0] == pytest.approx(math.log(2.0), abs=1e-12)
    assert logs[2] == pytest.approx(logs[0], abs=1e-12)
    assert sum(logs) == pytest.approx(0.0, abs=1e-12)
    assert size.span == pytest.approx(2.0)
    assert [each.value for each in kind.values] == ["orb", "klt"]
    assert kind.values[1].ratio == pytest.approx(math.sqrt(1.1))
    # without noise the interval is the value itself, and the main effects explain all
    assert size.values[1].low == pytest.approx(size.values[1].ratio, rel=1e-9)
    assert size.share is not None
    assert kind.share is not None
    assert size.share + kind.share == pytest.approx(1.0)


def test_a_full_sweep_gives_the_plain_means_and_the_paired_interval_of_scipy() -> None:
    runs = crossed(5, SWEEP)
    rng = np.random.default_rng(3)
    errors = planted(runs, RATIOS) * np.exp(0.3 * rng.normal(size=len(runs.recordings)))
    for name, effect in by_name(parameter_effects(runs, errors)).items():
        table = np.log(errors).reshape(5, 3, 2)
        centred = table - table.mean(axis=(1, 2), keepdims=True)
        per_recording = centred.mean(axis=2 if name == "window.size" else 1)
        mean, sem = per_recording.mean(axis=0), stats.sem(per_recording, axis=0)
        low, high = stats.t.interval(0.95, 4, loc=mean, scale=sem)
        expected = np.exp([mean, low, high]).T.ravel().tolist()
        found = [number for each in effect.values for number in (each.ratio, each.low, each.high)]
        assert found == pytest.approx(expected, rel=1e-9)
        n_each = 30 / len(mean)
        share = n_each * np.sum(mean**2) / np.sum(centred**2)
        assert effect.share == pytest.approx(share)
        assert effect.chance_share == pytest.approx((len(mean) - 1) / 25)
        assert effect.n_recordings == 5


@pytest.mark.parametrize("share_failed", [0.0, 0.25])
def test_intervals_hold_the_planted_effect_as_often_as_they_say(share_failed: float) -> None:
    n_seeds = 400
    n_inside = n_given = 0
    complete = crossed(6, SWEEP)
    truth = math.sqrt(1.1)
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        n = len(complete.recordings)
        runs = failing(complete, rng.random(n) < share_failed)
        # what differs between recordings, and what between runs
        tastes = 0.2 * rng.normal(size=(6, 2))
        of_kind = [value == "klt" for value in runs.parameters["frontend.kind"]]
        noise = tastes[runs.recording_codes(), np.array(of_kind, dtype=np.int64)]
        errors = planted(runs, RATIOS) * np.exp(noise + 0.2 * rng.normal(size=n))
        value = by_name(parameter_effects(runs, errors))["frontend.kind"].values[1]
        if value.low is not None and value.high is not None:
            n_given += 1
            n_inside += value.low <= truth <= value.high
    assert n_given > 0.98 * n_seeds
    low, high = stats.binom.ppf(np.array([0.001, 0.999]), n_given, 0.95) / n_given
    assert low <= n_inside / n_given <= (high if share_failed == 0.0 else 1.0)


def test_runs_that_fail_on_hard_recordings_do_not_make_their_value_look_better() -> None:
    runs = crossed(6, SWEEP)
    errors = planted(runs, RATIOS)
    is_hard = runs.recording_codes() % 5 == 4
    is_klt = np.array([kind == "klt" for kind in runs.parameters["frontend.kind"]])
    is_large = np.array([size == 20 for size in runs.parameters["window.size"]])
    # the slightly worse value fails where errors are largest, and where the other is at its worst
    is_ten = np.array([size == 10 for size in runs.parameters["window.size"]])
    is_failed = is_klt & ((is_hard & is_large) | is_ten)
    plain = errors[is_klt & ~is_failed].mean() / errors[~is_klt].mean()
    assert plain < 0.8
    found = by_name(parameter_effects(failing(runs, is_failed), errors))
    kind, size = found["frontend.kind"], found["window.size"]
    assert np.diff(logs_of(kind)) == pytest.approx([math.log(1.1)], abs=1e-9)
    assert np.diff(logs_of(size)) == pytest.approx([math.log(2.0), -math.log(2.0)], abs=1e-9)
    assert [each.n_failed for each in kind.values] == [0, int(np.sum(is_failed))]
    assert [each.n_compared for each in kind.values] == [18, 18 - int(np.sum(is_failed))]


def test_a_run_that_lost_the_camera_is_set_aside_where_others_did_not() -> None:
    runs = crossed(3, {"frontend.kind": ["orb", "klt"]})
    errors = planted(runs, {"frontend.kind": {"orb": 1.0, "klt": 2.0}})
    n_poses = np.full(6, 100.0)
    n_poses[1], errors[1] = 40.0, 1e-6
    # there all lost it: nothing is wrong with either
    n_poses[4:] = 40.0
    part = Runs(
        recordings=runs.recordings,
        variants=runs.variants,
        parameters=runs.parameters,
        is_failed=runs.is_failed,
        n_poses=n_poses,
    )
    assert part.is_comparable().tolist() == [True, False, True, True, True, True]
    [kind] = parameter_effects(part, errors)
    assert np.diff(logs_of(kind)) == pytest.approx([math.log(2.0)], abs=1e-12)
    assert [each.n_set_aside for each in kind.values] == [0, 1]
    assert kind.n_recordings == 2


def test_one_recording_has_means_without_intervals() -> None:
    runs = crossed(1, SWEEP)
    for effect in parameter_effects(runs, planted(runs, RATIOS)):
        assert all(each.ratio is not None for each in effect.values)
        assert all(each.low is None and each.high is None for each in effect.values)


def test_a_value_that_a_single_recording_tells_of_has_no_interval() -> None:
    runs = crossed(4, {"window.size": [5, 10, 20]})
    is_failed = np.array([size == 20 for size in runs.parameters["window.size"]])
    is_failed[-1] = False
    rng = np.random.default_rng(0)
    [size] = parameter_effects(failing(runs, is_failed), np.exp(rng.normal(size=12)))
    assert [each.low is None for each in size.values] == [False, False, True]
    assert size.values[2].ratio is not None
    # and the mean value is that of the two others
    assert sum(logs_of(size)[:2]) == pytest.approx(0.0, abs=1e-12)


def test_a_value_that_always_fails_leaves_the_others_to_be_compared() -> None:
    runs = crossed(4, SWEEP)
    is_failed = np.array([size == 20 for size in runs.parameters["window.size"]])
    found = by_name(parameter_effects(failing(runs, is_failed), planted(runs, RATIOS)))
    size = found["window.size"]
    assert size.values[2].ratio is None
    assert size.values[2].n_failed == 8
    assert np.diff(logs_of(size)[:2]) == pytest.approx([math.log(2.0)], abs=1e-12)
    assert size.values[0].low is not None


def test_parameters_that_change_only_together_cannot_be_told_apart() -> None:
    runs = crossed(3, {"a": [1, 2]})
    together = Runs(
        recordings=runs.recordings,
        variants=runs.variants,
        parameters={"a": runs.parameters["a"], "b": [v == 1 for v in runs.parameters["a"]]},
        is_failed=runs.is_failed,
        n_poses=runs.n_poses,
    )
    for effect in parameter_effects(together, np.arange(1.0, 7.0)):
        assert effect.share is None
        assert effect.span is None
        assert [each.ratio for each in effect.values] == [None, None]
    # beside a third that is crossed, that one is told
    half = crossed(3, {"a": [1, 2], "c": [1, 2, 3]})
    mixed = Runs(
        recordings=half.recordings,
        variants=half.variants,
        parameters={**half.parameters, "b": [2 * int(str(v)) for v in half.parameters["a"]]},
        is_failed=half.is_failed,
        n_poses=half.n_poses,
    )
    errors = planted(mixed, {"c": {1: 1.0, 2: 3.0, 3: 1.0}})
    first, *rest = parameter_effects(mixed, errors)
    assert first.name == "c"
    assert first.span == pytest.approx(3.0)
    assert [effect.share for effect in rest] == [None, None]


def test_without_a_measure_nothing_is_told_and_all_is_counted() -> None:
    runs = crossed(2, {"a": [2, 1]})
    [effect] = parameter_effects(runs, np.full(4, np.nan))
    assert [each.value for each in effect.values] == [1, 2]
    assert [(each.ratio, each.n_compared, each.n_set_aside) for each in effect.values] == [
        (None, 0, 2)
    ] * 2
    [equal] = parameter_effects(runs, np.ones(4))
    assert equal.share == 0.0
    assert parameter_effects(crossed(2, {}), np.ones(2)) == []


def test_a_parameter_without_effect_explains_no_more_than_by_chance() -> None:
    runs = crossed(4, SWEEP)
    shares = []
    for seed in range(300):
        errors = np.exp(np.random.default_rng(seed).normal(size=24))
        effect = by_name(parameter_effects(runs, errors))["window.size"]
        shares.append(effect.share)
        assert effect.chance_share == pytest.approx(2 / 20)
    assert np.mean(np.array(shares, dtype=np.float64)) == pytest.approx(0.1, abs=0.015)


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=25))
def test_the_front_is_what_brute_force_finds(points: list[tuple[int, int]]) -> None:
    found = is_non_dominated(np.array(points, dtype=np.float64).reshape(-1, 2))
    truth = [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points) for x, y in points]
    assert found.tolist() == truth


def test_the_front_holds_the_fast_and_the_accurate_but_none_that_failed() -> None:
    runs = crossed(3, {"v": ["fast", "good", "bad", "lucky"]})
    levels = planted(runs, {"v": {"fast": 2.0, "good": 1.0, "bad": 2.0, "lucky": 0.1}})
    times = planted(runs, {"v": {"fast": 1.0, "good": 4.0, "bad": 4.0, "lucky": 0.1}})
    is_failed = np.zeros(12, dtype=np.bool_)
    is_failed[11] = True
    found = accuracy_front(failing(runs, is_failed), levels, times)
    assert [each.name for each in found if each.is_on_front] == ["('fast',)", "('good',)"]
    assert [each.is_candidate for each in found] == [True, True, True, False]
    assert [each.n_compared for each in found] == [3, 3, 3, 2]
    assert {each.n_recordings for each in found} == {3}
    mean = 4.0 ** (1 / 3)
    expected = [2.0 / mean, 1.0 / mean, 2.0 / mean, 0.1 / mean]
    assert [each.error_ratio for each in found] == pytest.approx(expected)


def test_where_none_completed_all_those_with_most_are_compared_on_what_they_share() -> None:
    runs = crossed(3, {"v": ["x", "y", "z"]})
    is_failed = np.zeros(9, dtype=np.bool_)
    is_failed[[0, 4, 2, 5]] = True  # x fails on the first recording, y on the second, z on both
    errors = planted(runs, {"v": {"x": 1.0, "y": 3.0, "z": 0.5}})
    x, y, z = accuracy_front(failing(runs, is_failed), errors, np.ones(9))
    assert (x.is_candidate, y.is_candidate, z.is_candidate) == (True, True, False)
    assert (x.is_on_front, y.is_on_front, z.is_on_front) == (True, False, False)
    assert x.error_ratio == pytest.approx(3.0**-0.5)
    assert z.error_ratio == pytest.approx(0.5 * 3.0**-0.5)
    nothing = accuracy_front(failing(runs, np.ones(9, dtype=np.bool_)), errors, np.ones(9))
    assert not any(each.is_on_front or each.is_candidate for each in nothing)
    assert {each.error_ratio for each in nothing} == {None}
    # nothing in common: nothing to compare
    apart = crossed(2, {"v": ["x", "y"]})
    found = accuracy_front(
        failing(apart, np.array([True, False, False, True])), np.ones(4), np.ones(4)
    )
    assert [each.error_ratio for each in found] == [None, None]
