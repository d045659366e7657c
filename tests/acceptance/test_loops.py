"""The judgement of loop closure: what counts as a visit, as a wrong loop, as a blackout."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.geometry import se3
from gvo.testing import Black, FaultySource
from gvo.trajectory.g2o import format_edge
from tests.acceptance.conftest import SCRIPTS, Script
from tests.conftest import python, run_of

pytestmark = pytest.mark.acceptance

SIGMAS = np.diag([0.01] * 3 + [0.1] * 3)  # rad, m


@pytest.fixture
def loops(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the script, which imports others beside it."""
    monkeypatch.syspath_prepend(SCRIPTS)
    return importlib.import_module("benchmark_loops")


def round_trip() -> gvo.Trajectory:
    """Return two rounds of 20 s on a circle of 10 m, then half of one the other way round."""
    turns = (
        2.0 * np.pi * np.concatenate([np.arange(0.0, 2.0, 0.05), 2.0 - np.arange(0.0, 0.5, 0.05)])
    )
    T = se3.exp(np.outer(turns, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    T[:, :3, 3] = 10.0 * np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
    T[40:] = T[40:] @ se3.exp(np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0]))
    stamps_ns = 1_000_000_000 * np.arange(len(T))
    return gvo.Trajectory(stamps_ns=stamps_ns, T_world_frame=T)


def test_a_visit_is_a_place_seen_before_from_the_same_side(loops: Any) -> None:
    earlier, later = loops.visits(round_trip())
    np.testing.assert_array_equal(later, np.arange(20, 40))
    np.testing.assert_array_equal(earlier, np.arange(20))


def test_the_error_of_a_visit_is_that_of_the_relative_pose(loops: Any) -> None:
    truth = round_trip()
    T = truth.T_world_frame.copy()
    T[20:, 0, 3] += 0.3
    estimate = gvo.Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=T)
    n, *errors = loops.of_visits(truth, [estimate, truth])
    assert n == 20
    np.testing.assert_allclose(errors, [0.3, 0.0, 0.0, 0.0, 0.0], atol=1e-6)


def write_loops(folder: Path, truth: gvo.Trajectory) -> None:
    """Write five loops: three accepted, of which one is unlikely and one wrong, and two refused."""
    noises = [[0.0] * 5 + [0.1], [0.0] * 5 + [0.45], [0.0, 0.1, 0.0, 0.0, 0.0, 0.0]]
    noises += [[0.0] * 5 + [3.0], [0.0] * 5 + [0.2]]
    lines = [
        "stamp_ns,reference_ns,n_matches,n_inliers,x_m,y_m,z_m,qx,qy,qz,qw,residual,weight,reason"
    ]
    graph = [f"VERTEX_SE3:QUAT {k} 0 0 0 0 0 0 1  # {k}" for k in range(2)]
    for k, noise in enumerate(noises):
        earlier, later = truth.T_world_frame[[k, 20 + k]]
        T = se3.invert(earlier) @ later @ se3.exp(np.array(noise))
        numbers = ",".join(map(repr, [*T[:3, 3].tolist(), *se3.quaternions(T[:3, :3]).tolist()]))
        reason = "lonely" if k > 2 else ""
        lines.append(f"{20 + k}000000000,{k}000000000,50,40,{numbers},1.0,{int(k < 3)},{reason}")
        if not reason:
            graph.append(format_edge(k, 20 + k, T, SIGMAS**2 / (1.0 + k)))
    (folder / "loops.csv").write_text("\n".join(lines) + "\n")
    (folder / "graph.g2o").write_text("\n".join(graph) + "\n")


def test_loops_are_counted_by_what_the_truth_says(loops: Any, tmp_path: Path) -> None:
    truth = round_trip()
    write_loops(tmp_path, truth)
    assert loops.of_loops(truth, tmp_path) == [5, 2, 3, 1, 2]
    # A loop whose truth is not known is not judged.
    assert loops.of_loops(truth.select(slice(1, None)), tmp_path) == [4, 2, 2, 1, 2]


def test_the_light_goes_out_and_the_lens_breathes(loops: Any) -> None:
    room = gvo.SyntheticRecording("handheld", n_frames=12, scale=0.1)
    dark = loops.Spoiling(dark_s=(0.1, 0.3)).darkened(room)
    left = [image.load().any() for image in dark.images() if image.stream == 0]
    assert np.flatnonzero(~np.array(left)).tolist() == list(range(3, 9))
    with pytest.raises(gvo.GvoError, match="--dark: expected a time within the"):
        loops.Spoiling(dark_s=(0.1, 3.0)).darkened(room)
    assert loops.Spoiling().darkened(room) is room


def test_what_is_magnified_moves_away_from_the_middle(loops: Any) -> None:
    image = np.zeros((101, 201), dtype=np.uint8)
    image[50, 180] = 255

    class At:
        stamp_ns = 10_000_000_000  # a quarter of a breath

    grown = loops.Breathing(amount=0.05).spoil(image, None, At)
    assert np.unravel_index(grown.argmax(), grown.shape) == (50, 184)


def test_the_table_shows_the_errors_that_the_runs_tell(tmp_path: Path) -> None:
    options = ["--loops", "--seeds", "2-2", "--kind", "room", "--frames", "40", "--dark", "0.5-0.8"]
    answer = python(SCRIPTS / "benchmark.py", *options)
    assert answer.returncode == 0, answer.stderr
    table = [line for line in answer.stdout.splitlines() if line.startswith("|")]
    cells = [cell.strip() for cell in table[2].strip("| ").split("|")]
    room = gvo.SyntheticRecording("handheld", "rgbd", n_frames=40, seed=2, scale=0.5)
    dark = FaultySource(room, Black(first=15, end=24))
    run_of(dark, tmp_path / "dark")
    run_of(room, tmp_path / "unbroken")
    rows = (tmp_path / "dark/frames.csv").read_text().splitlines()[1:]
    is_lit = [row.split(",")[1] in ("ok", "resumed") for row in rows]
    assert 28 <= sum(is_lit) <= 31
    ates = [
        gvo.evaluate(
            room.ground_truth(),
            gvo.read_trajectory(tmp_path / name).select(np.array(is_lit)),
            name=name,
        ).ate_m
        for name in ("dark/smoothed.txt", "dark/global.txt", "unbroken/global.txt")
    ]
    assert cells[0] == "handheld-rgbd"
    assert cells[4:6] == ["0", "-, -"]  # it is too short to come back
    assert cells[7:13] == ["-", "0", "0", "0", "0", "0"]
    found = [float(cells[k]) for k in (1, 2, 14)]
    np.testing.assert_allclose(found, ates, atol=6e-5)
    assert cells[13] == "1"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["x.bag", "--drift", "1"], "--drift and --dark go with --loops"),
        (["--loops", "x.bag", "--drift", "9"], "--drift takes 0 to 5"),
        (["--loops", "x.bag", "--dark", "3"], "argument --dark"),
        (["--loops"], "name recordings"),
        (["--loops", "missing.bag"], "missing.bag"),
        (["--loops", "x.bag", "--set", "loops.enabled=false"], "expected loops.enabled"),
    ],
)
def test_what_cannot_be_judged_is_told(script: Script, options: list[str], message: str) -> None:
    assert message in script("benchmark", options)
