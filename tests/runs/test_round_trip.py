"""Recordings run forward, then backward."""

import json
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.opening import open_recording
from gvo.runs.round_trip import RoundTripResult, run_round_trip
from gvo.testing import faults as made
from gvo.testing.faults import FaultySource
from gvo.trajectory.evaluation import evaluate
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.round_trip import format_round_trip_errors
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Progress
from tests.recordings import Held

_N_FRAMES = 6


@pytest.fixture(scope="module")
def drive(drive_bag: Path) -> Held:
    """Return the start of a rendered drive, whose images are read once."""
    source = open_recording(drive_bag)
    images = islice(source.images(), 2 * _N_FRAMES)
    items = [replace(image, load=cache(image.load)) for image in images]
    info = replace(source.info, n_images=_N_FRAMES)
    return Held(info=info, items=items, truth=source.ground_truth())


def truth_of(drive: Held) -> Trajectory:
    assert drive.truth is not None
    return drive.truth.select(slice(0, _N_FRAMES))


def refused(first: int, end: int | None = None) -> made.Fault:
    return made.Unloadable(first=first, end=end, message="cut off")


@pytest.fixture(scope="module")
def driven(drive: Held, tmp_path_factory: pytest.TempPathFactory) -> tuple[RoundTripResult, Path]:
    out = tmp_path_factory.mktemp("round_trip")
    return run_round_trip(drive, out), out


def test_both_ways_are_in_the_run_folder(driven: tuple[RoundTripResult, Path], drive: Held) -> None:
    result, out = driven
    assert (result.is_complete, result.warnings) == (True, ())
    truth = truth_of(drive)
    for name in ("raw", "causal", "smoothed"):
        trajectory = read_trajectory(out / f"{name}.txt")
        there = trajectory.select(slice(0, _N_FRAMES))
        assert there.stamps_ns.tolist() == truth.stamps_ns.tolist()
        mirrored_ns = 2 * truth.stamps_ns[-1] - truth.stamps_ns[::-1]
        assert trajectory.stamps_ns[_N_FRAMES - 1 :].tolist() == mirrored_ns.tolist()
        # the way back is driven backwards: it ends near where it began, far from the turn
        back = trajectory.select(slice(_N_FRAMES - 1, None))
        expected = Trajectory(stamps_ns=mirrored_ns, T_world_frame=truth.T_world_frame[::-1])
        for part, reference in ((there, truth), (back, expected)):
            assert evaluate(reference, part, name=name, align="none").ate_max_m < 0.1
    assert float(np.ptp(truth.positions[:, 2])) > 2.0
    assert (out / "round_trip.png").read_bytes().startswith(b"\x89PNG")


def test_the_summary_holds_the_errors(driven: tuple[RoundTripResult, Path]) -> None:
    result, out = driven
    summary = json.loads((out / "summary.json").read_text())
    told = summary["round_trip"]["estimates"]
    assert list(told) == ["raw", "causal", "smoothed"]
    for name, numbers in told.items():
        ends = read_trajectory(out / f"{name}.txt").positions[[0, -1]]
        assert numbers["error_m"] == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=1e-6)
        assert 0.0 < numbers["error_pct"] < 1.0
    assert summary["frames"] == summary["tracked"] == 2 * _N_FRAMES - 1
    table = format_round_trip_errors(result.errors).splitlines()
    assert [line.split()[0] for line in table[2:]] == ["raw", "causal", "smoothed"]
    assert len({len(line) for line in table}) == 1


def test_a_wrong_scale_leaves_no_error(drive: Held, tmp_path: Path) -> None:
    result = run_round_trip(FaultySource(drive, made.WrongBaseline(factor=1.2)), tmp_path)
    path_m = float(np.linalg.norm(truth_of(drive).positions[-1]))
    travelled_m = float(np.linalg.norm(result.errors["raw"].forward.positions[-1]))
    assert travelled_m / path_m == pytest.approx(1.2, abs=0.02)
    error_pct = result.errors["raw"].error_pct
    assert error_pct is not None
    assert error_pct < 1.0


def test_faulty_frames_are_faulty_both_ways(drive: Held, tmp_path: Path) -> None:
    faulty = FaultySource(drive, refused(2, 3), refused(_N_FRAMES - 1))
    result = run_round_trip(faulty, tmp_path)
    assert not result.is_complete
    # the last frame lies behind the turn
    assert result.summary["status_counts"]["skipped"] == 3
    assert len(result.errors["raw"].forward) == _N_FRAMES - 2
    assert result.turn_ns == truth_of(drive).stamps_ns[-2]


def test_black_images_give_no_error_to_trust(drive: Held, tmp_path: Path) -> None:
    result = run_round_trip(FaultySource(drive, made.Black()), tmp_path)
    assert not result.is_complete
    assert "no frame could be registered" in result.warnings[0]


@pytest.mark.parametrize("n_sound", [0, 1])
def test_fewer_than_two_frames_cannot_be_driven(drive: Held, tmp_path: Path, n_sound: int) -> None:
    (tmp_path / "round_trip.png").write_text("of an earlier drive")
    with pytest.raises(RecordingError, match="cut off" if n_sound == 0 else "pose both ways: 1,"):
        run_round_trip(FaultySource(drive, refused(n_sound)), tmp_path, force=True)
    assert not (tmp_path / "round_trip.png").exists()


def test_progress_counts_both_ways(drive: Held, tmp_path: Path) -> None:
    told: list[Progress] = []
    config = Config.model_validate({"runtime": {"threads": 1}})
    run_round_trip(
        drive, tmp_path, config=config, excerpt=Excerpt(every=2), on_progress=told.append
    )
    assert [progress.n_done for progress in told] == list(range(1, 6))
    assert {progress.n_total for progress in told} == {5}
