"""Tables of evaluations."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gvo.trajectory.evaluation import Evaluation, evaluations_json, format_evaluations
from tests.trajectory.paths import still

TWO = still([0, 1])
FULL = Evaluation(
    name="smoothed",
    trajectory=TWO,
    reference=TWO,
    estimate=TWO,
    errors_m=np.array([3.0, 4.0]),
    rpe_m=0.0123456,
    rpe_deg=0.25,
    t_pct=0.7004,
    r_deg_per_100m=0.2533,
    n_segments=7,
    segments_m=(100.0, 200.0, 800.0),
    reference_share=0.985,
    path_ratio=1.01,
)
BARE = Evaluation(
    name="a name that is longer than its header",
    trajectory=TWO,
    reference=TWO,
    estimate=TWO,
    errors_m=np.array([1234.5]),
    rpe_m=None,
    rpe_deg=None,
    t_pct=None,
    r_deg_per_100m=None,
    n_segments=0,
    segments_m=(20.0, 50.0),
    reference_share=1.0,
    path_ratio=None,
)


def test_a_column_holds_the_measures_with_their_units() -> None:
    head, rule, *lines = format_evaluations([FULL, BARE]).splitlines()
    assert head.split(maxsplit=2) == ["estimate", "smoothed", BARE.name]
    assert rule == "-" * len(head)
    assert [" ".join(line.split()) for line in lines] == [
        "poses 2 1",
        "of reference [%] 98.5 100.0",
        "ATE RMSE [m] 3.5355 1234.5000",
        "ATE mean [m] 3.5000 1234.5000",
        "ATE median [m] 3.5000 1234.5000",
        "ATE std [m] 0.5000 0.0000",
        "ATE max [m] 4.0000 1234.5000",
        "RPE RMSE [m] 0.0123 -",
        "RPE RMSE [deg] 0.2500 -",
        "segments [m] 100..800 -",
        "t_err [%] 0.700 -",
        "r_err [deg/100 m] 0.253 -",
        "path ratio 1.010 -",
    ]


@pytest.mark.parametrize(("n", "length"), [(1, 8), (7, 8), (40, 3), (3, 37), (3, 90)])
def test_tables_fit_a_terminal_and_hold_every_name(n: int, length: int) -> None:
    names = [f"{number}".rjust(length, "x") for number in range(n)]
    text = format_evaluations([replace(FULL, name=name) for name in names])
    tables = text.split("\n\n")
    assert [name for table in tables for name in table.split("\n")[0].split()[1:]] == names
    widths = {len(line) for line in text.splitlines()}
    assert max(widths) <= 80 or (length > 60 and len(tables) == n)


def test_the_json_holds_all_columns_of_the_table() -> None:
    keys = (
        "n reference_share ate_m ate_mean_m ate_median_m ate_std_m ate_max_m rpe_m rpe_deg "
        "n_segments t_pct r_deg_per_100m path_ratio scale scaled_ate_m"
    )
    content = json.loads(json.dumps(evaluations_json([FULL, BARE]), allow_nan=False))
    assert content == {
        "estimates": [
            {key: getattr(each, key) for key in ("name", *keys.split())}
            | {"segments_m": list(each.segments_m), "jumps": []}
            for each in (FULL, BARE)
        ]
    }
    assert (FULL.n, FULL.ate_m, BARE.ate_m) == (2, 12.5**0.5, 1234.5)


def test_an_evaluation_is_shown_in_a_line() -> None:
    assert repr(FULL) == "Evaluation(smoothed: 2 poses, ATE 3.536 m, RPE 0.01235 m, 0.25 deg)"
    assert repr(BARE).endswith(": 1 poses, ATE 1234 m, RPE - m, - deg)")
