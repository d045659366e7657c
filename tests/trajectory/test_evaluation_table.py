"""Tables of evaluations."""

import json

import numpy as np

from gvo.trajectory.evaluation import Evaluation, evaluations_json, format_evaluations

FULL = Evaluation(
    name="smoothed",
    stamps_ns=np.arange(2),
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
    stamps_ns=np.arange(1),
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


def test_units_stand_in_the_header_and_values_in_the_rows() -> None:
    header, _, full, bare = format_evaluations([FULL, BARE]).splitlines()
    for unit in ("[m]", "[deg]", "[%]", "[deg/100 m]"):
        assert unit in header
    values = "smoothed 2 98.5 3.5355 4.0000 0.0123 0.2500 100..800 0.700 0.253 1.010"
    assert " ".join(full.split()) == values
    bare_values = "1 100.0 1234.5000 1234.5000 - - - - - -"
    assert " ".join(bare.removeprefix(BARE.name).split()) == bare_values


def test_the_json_holds_all_columns_of_the_table() -> None:
    keys = (
        "n reference_share ate_m ate_max_m rpe_m rpe_deg n_segments t_pct r_deg_per_100m path_ratio"
    )
    content = json.loads(json.dumps(evaluations_json([FULL, BARE]), allow_nan=False))
    assert content == {
        "estimates": [
            {key: getattr(each, key) for key in ("name", *keys.split())}
            | {"segments_m": list(each.segments_m)}
            for each in (FULL, BARE)
        ]
    }
    n_columns = len(format_evaluations([]).splitlines()[0].split("  ")) - 1
    assert len(content["estimates"][0]) > n_columns
    assert (FULL.n, FULL.ate_m, BARE.ate_m) == (2, 12.5**0.5, 1234.5)


def test_an_evaluation_is_shown_in_a_line() -> None:
    assert repr(FULL) == "Evaluation(smoothed: 2 poses, ATE 3.536 m, RPE 0.01235 m, 0.25 deg)"
    assert repr(BARE).endswith(": 1 poses, ATE 1234 m, RPE - m, - deg)")
