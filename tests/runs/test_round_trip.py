"""Recordings run forward, then backward."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry.camera import StereoCamera
from gvo.io.excerpt import Excerpt
from gvo.io.opening import open_recording
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.runs.round_trip import RoundTripResult, run_round_trip
from gvo.trajectory.evaluation import evaluate
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.round_trip import format_round_trip_errors
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Progress

_N_FRAMES = 6


class Rendered:
    """The start of a rendered drive; some images damaged, or all of them black."""

    def __init__(self, path: Path) -> None:
        source = open_recording(path)
        self.info: RecordingInfo = replace(source.info, n_images=_N_FRAMES)
        truth = source.ground_truth()
        assert truth is not None
        self.truth = truth.select(slice(0, _N_FRAMES))
        images = islice(source.images(), 2 * _N_FRAMES)
        self.images_read = [replace(image, load=_kept(image)) for image in images]
        self.faulty: set[int] = set()
        self.is_black = False

    def images(self) -> Iterator[StampedImage]:
        for number, image in enumerate(self.images_read):
            if number // 2 in self.faulty:
                yield replace(image, load=_refuse)
            elif self.is_black:
                yield replace(image, load=partial(_black, image))
            else:
                yield image

    def ground_truth(self) -> Trajectory | None:
        return None


def _kept(image: StampedImage) -> Any:
    pixels = image.load()
    return lambda: pixels


def _black(image: StampedImage) -> NDArray[Any]:
    return np.zeros_like(image.load())


def _refuse() -> NDArray[Any]:
    raise RecordingError("cut off")


@pytest.fixture(scope="module")
def rendered(drive_bag: Path) -> Rendered:
    return Rendered(drive_bag)


@pytest.fixture
def drive(rendered: Rendered) -> Iterator[Rendered]:
    yield rendered
    rendered.faulty, rendered.is_black = set(), False


@pytest.fixture(scope="module")
def driven(
    rendered: Rendered, tmp_path_factory: pytest.TempPathFactory
) -> tuple[RoundTripResult, Path]:
    out = tmp_path_factory.mktemp("round_trip")
    return run_round_trip(rendered, out), out


def test_both_ways_are_in_the_run_folder(
    driven: tuple[RoundTripResult, Path], rendered: Rendered
) -> None:
    result, out = driven
    assert (result.is_complete, result.warnings) == (True, ())
    truth = rendered.truth
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


def test_a_wrong_scale_leaves_no_error(drive: Rendered, tmp_path: Path) -> None:
    info, (left, right) = drive.info, drive.info.calibrations
    assert isinstance(info.camera, StereoCamera)
    try:
        wide = type(right).from_camera(right.pinhole(), baseline=1.2 * info.camera.baseline)
        drive.info = replace(info, calibrations=(left, wide))
        result = run_round_trip(drive, tmp_path)
    finally:
        drive.info = info
    path_m = float(np.linalg.norm(drive.truth.positions[-1]))
    travelled_m = float(np.linalg.norm(result.errors["raw"].forward.positions[-1]))
    assert travelled_m / path_m == pytest.approx(1.2, abs=0.02)
    error_pct = result.errors["raw"].error_pct
    assert error_pct is not None
    assert error_pct < 1.0


def test_faulty_frames_are_faulty_both_ways(drive: Rendered, tmp_path: Path) -> None:
    drive.faulty = {2, _N_FRAMES - 1}
    result = run_round_trip(drive, tmp_path)
    assert not result.is_complete
    # the last frame lies behind the turn
    assert result.summary["status_counts"]["skipped"] == 3
    assert len(result.errors["raw"].forward) == _N_FRAMES - 2
    assert result.turn_ns == drive.truth.stamps_ns[-2]


def test_black_images_give_no_error_to_trust(drive: Rendered, tmp_path: Path) -> None:
    drive.is_black = True
    result = run_round_trip(drive, tmp_path)
    assert not result.is_complete
    assert "no frame could be registered" in result.warnings[0]


@pytest.mark.parametrize("n_sound", [0, 1])
def test_fewer_than_two_frames_cannot_be_driven(
    drive: Rendered, tmp_path: Path, n_sound: int
) -> None:
    (tmp_path / "round_trip.png").write_text("of an earlier drive")
    drive.faulty = set(range(n_sound, _N_FRAMES))
    with pytest.raises(RecordingError, match="cut off" if n_sound == 0 else "pose both ways: 1,"):
        run_round_trip(drive, tmp_path, force=True)
    assert not (tmp_path / "round_trip.png").exists()


def test_progress_counts_both_ways(drive: Rendered, tmp_path: Path) -> None:
    told: list[Progress] = []
    config = Config.model_validate({"runtime": {"threads": 1}})
    run_round_trip(
        drive, tmp_path, config=config, excerpt=Excerpt(every=2), on_progress=told.append
    )
    assert [progress.n_done for progress in told] == list(range(1, 6))
    assert {progress.n_total for progress in told} == {5}
