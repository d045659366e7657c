"""Each row of the table in docs/SECURITY.md, over rendered recordings with exact poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gvo.io.recording import Sensor
from tests.faults import (
    Elsewhere,
    Exchanged,
    FaultySource,
    Frozen,
    Lagging,
    PixelFault,
    rows_shifted,
    spoilt,
)
from tests.faults.catalogue import FAULTS, MADE, PAGE, NamedFault, parameters
from tests.faults.fault_bench import Outcome, complaints, faulty, run, sound

# Of six honest errors, 3 in 10,000 are beyond five sigmas; those of 20 poses are dependent.
_MAX_DEVIATION = 6.0
# Of a fault that deceives: apart from that limit, so that none is on either side of it by chance.
_MIN_SILENT_DEVIATION = 5.0
# Of poses that no wrong image takes part in; without any fault it is 0.008 m.
_MAX_ERROR_M = 0.03
_OF_IMAGES = (PixelFault, Frozen, Lagging, Elsewhere, Exchanged)

# How many rows of frames.csv are skipped; 0 where nothing stands here.
SKIPPED: dict[str, tuple[str, ...]] = {
    "1": ("late-frame", "stamp-ahead", "stamp-behind"),
    "2": ("image-damaged", "image-unreadable", "decoder-fails"),
    "3": (
        "delivered-twice", "transposed", "type-float", "type-16-bit",
        "depth-nan", "depth-negative",
    ),
    "4": ("dropped-right",),
    "6": ("frozen", "right-frozen"),
    "8": ("clock-set-back",),
    "19": (
        "stamps-zero", "stamps-equal", "stamps-backwards", "stamps-in-seconds", "clocks-drift",
    ),
}  # fmt: skip
N_SKIPPED = {name: int(n) for n, names in SKIPPED.items() for name in names}
N_UNPAIRED = {"dropped-depth": 4, "depth-offset": 1}
# A part of the warning, or of the message where no frame is usable.
TOLD = {
    "dropped-right": "no right image within",
    "dropped-depth": "4 images have no partner",
    "no-right": "no right image within",
    "no-depth": "no depth image within",
    "no-colour": "it holds no image",
    "empty": "it holds no image",
    "delivered-twice": "repeats",
    "frozen": "pixel by pixel: the camera hangs",
    "right-frozen": "the right image is that of the frame before",
    "late-frame": "the stamp goes back",
    "shuffled": "the stamp goes back",
    "cut-off": "not all could be read, 12 frames were: the file is cut off",
    "disk-fails": "cannot be read on: OSError: Input/output error",
    "image-damaged": "the image is damaged",
    "image-unreadable": "OSError: Input/output error",
    "decoder-fails": "bad decode",
    "all-damaged": "the image is damaged",
    "lost": "(frames.csv: coasting, lost)",
    "elsewhere": "(frames.csv: coasting, lost)",
    "clock-set-back": "the stamp goes back",
    "stamp-ahead": "the stamp is 3600.03 s ahead of the one before",
    "stamp-behind": "the stamp goes back",
    "stamps-zero": "--set sync.stamps=recording",
    "stamps-equal": "repeats",
    "stamps-backwards": "the stamp goes back",
    "stamps-negative": "share no stamps",
    "stamps-in-seconds": "repeats",
    "stamps-in-microseconds": "share no stamps",
    "stamps-apart": "sync.stereo_tolerance_ms=0: the nearest is",
    "clocks-offset": "the nearest is 30 ms away",
    "clocks-drift": "the nearest is 0.666667 ms away",
    "black": "3 of 20 poses continue the last velocity",
    "white": "3 of 20 poses continue the last velocity",
    "all-black": "are the images dark?",
    "transposed": "expected 256x192 pixels by the calibration, got 192x256",
    "resized": "expected 256x192 pixels by the calibration, got 128x96",
    "depth-resized": "expected 256x192 pixels by the calibration, got 128x96",
    "type-float": "got float64",
    "type-16-bit": "got uint16",
    "depth-16-bit": "got uint16",
    "depth-in-colour": "got float32 (192, 256, 3)",
    "exchanged": "are left and right exchanged",
    "mirrored": "are left and right exchanged",
    "right-lower": "no frame could be registered",
    "depth-in-mm": "depth.scale wrong",
    "depth-holes": "no frame could be registered",
    "depth-noisy": "no frame could be registered",
    "baseline-in-mm": "is the calibration",
    "baseline-negative": "are left and right exchanged?",
    "baseline-zero": "the baseline must be positive",
    "focal-length-of-one": "not rectified to one camera",
    **dict.fromkeys(
        ("depth-nan", "depth-negative", "depth-all-nan"),
        "no pixel of the depth image is known",
    ),
}


def _rows() -> list[Any]:
    """Return all faults with a sensor each: where both can have it, they take turns."""
    faults = enumerate(FAULTS.values())
    pairs = [(fault, fault.sensors[index % len(fault.sensors)]) for index, fault in faults]
    return [
        parameters(fault, sensor, fault=fault, id_=f"{fault.name}-{sensor}")
        for fault, sensor in pairs
    ]


@pytest.mark.parametrize(("fault", "sensor"), _rows())
def test_a_run_over_a_bad_recording_does_what_the_table_says(
    fault: NamedFault, sensor: Sensor, tmp_path: Path
) -> None:
    source = faulty(fault, sensor)
    outcome = run(source, sound(sensor, fault.n_frames).truth, tmp_path)
    assert outcome.exit_code == fault.exit_code, outcome.message or outcome.warnings
    told = TOLD.get(fault.name, "")
    assert told in outcome.message + "\n".join(outcome.warnings)
    assert not fault.exit_code or told
    assert "\n" not in outcome.message
    if fault.exit_code != 2:
        _nothing_is_lost(fault, outcome)
        _all_is_finite(outcome)
        _a_coasting_pose_gets_less_sure(outcome)
        _wrong_poses_are_told(fault, outcome, source)


@pytest.mark.acceptance
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_rows_that_lost_their_place_hardly_give_false_poses(sensor: Sensor, tmp_path: Path) -> None:
    recording = sound(sensor, 20)
    n_wrong = 0
    for number in range(6):
        most_px = 20 + 20 * (number % 2)
        bands = spoilt(rows_shifted, most_px=most_px, first=8, end=10, seed=number // 2)
        out = tmp_path / str(number)
        outcome = run(FaultySource(recording, bands), recording.truth, out)
        assert outcome.n("coasting") > 0
        n_wrong += bool(outcome.deviations.max() > _MAX_DEVIATION)
    # Without a check of rows and of the view nearly all are.
    assert n_wrong <= 2


def _nothing_is_lost(fault: NamedFault, outcome: Outcome) -> None:
    n_unpaired = outcome.summary["unpaired_images"]
    assert len(outcome.rows) + n_unpaired == outcome.n_given
    skipped = [row for row in outcome.rows if row["status"] == "skipped"]
    assert all(row["reason"] for row in skipped)
    counts = outcome.summary["status_counts"]
    assert {status: n for status, n in counts.items() if n} == {
        status: outcome.n(status) for status in {row["status"] for row in outcome.rows}
    }
    for trajectory in outcome.poses.values():
        assert len(trajectory) == len(outcome.rows) - len(skipped)
    if fault.name == "shuffled":
        assert 0 < len(skipped) < 10
        return
    assert len(skipped) == N_SKIPPED.get(fault.name, 0)
    assert n_unpaired == N_UNPAIRED.get(fault.name, 0)


def _all_is_finite(outcome: Outcome) -> None:
    for T in outcome.poses.values():
        assert np.isfinite(T).all()
    assert np.isfinite(outcome.covariances).all()
    assert np.linalg.eigvalsh(outcome.covariances).min() > 0


def _a_coasting_pose_gets_less_sure(outcome: Outcome) -> None:
    statuses = [row["status"] for row in outcome.rows if row["status"] != "skipped"]
    sizes = np.trace(outcome.covariances, axis1=1, axis2=2)
    for before, now, status in zip(sizes, sizes[1:], statuses[1:], strict=False):
        assert status not in ("coasting", "lost") or now > before


def _wrong_poses_are_told(fault: NamedFault, outcome: Outcome, source: FaultySource) -> None:
    if fault.is_silent:
        # where this fails, something has become better, and the table is out of date
        assert outcome.deviations.max() > _MIN_SILENT_DEVIATION
        return
    untouched = _untouched(source)
    rows = [row for row in outcome.rows if row["status"] != "skipped"]
    # Until a segment is joined its place is a guess: that is told by a warning.
    joined_at = {row["segment"]: k for k, row in enumerate(rows) if row["status"] == "resumed"}
    is_sound = np.array([
        frame in untouched
        and row["status"] in ("ok", "resumed")
        and (row["segment"] == "0" or k >= joined_at[row["segment"]])
        for k, (frame, row) in enumerate(zip(outcome.frames.tolist(), rows, strict=True))
    ])  # fmt: skip
    # Of what is left after blurred images the covariance tells that it is hardly known.
    sigmas_m = np.sqrt(np.trace(outcome.covariances[:, 3:, 3:], axis1=1, axis2=2))
    is_sound &= sigmas_m < 2.0 * _MAX_ERROR_M
    assert outcome.errors_m[is_sound].max(initial=0.0) <= _MAX_ERROR_M
    assert outcome.deviations.max() <= _MAX_DEVIATION


def _untouched(source: FaultySource) -> set[int]:
    """Return the frames both images of which show what they should."""
    touching = [fault for fault in source.faults if isinstance(fault, _OF_IMAGES)]
    images = list(FaultySource(source._source).faulty_images())
    touched = {image.frame for image in images for fault in touching if fault.applies_to(image)}
    return {image.frame for image in images} - touched


# The check looks at the same things for both kinds; that of depth is quicker.
@pytest.mark.parametrize("fault", [parameters(fault, fault=fault) for fault in FAULTS.values()])
def test_a_check_of_a_bad_recording_finds_what_the_table_says(fault: NamedFault) -> None:
    found = complaints(faulty(fault, fault.sensors[-1], is_lasting=True))
    if fault.found_by:
        assert fault.found_by in found
    else:
        assert found == set()


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_a_sound_recording_is_complete(sensor: Sensor, tmp_path: Path) -> None:
    source = FaultySource(sound(sensor))
    outcome = run(source, sound(sensor).truth, tmp_path)
    assert (outcome.exit_code, outcome.warnings, outcome.n("ok")) == (0, (), 20)
    assert outcome.errors_m.max() < 0.4 * _MAX_ERROR_M
    assert outcome.deviations.max() < _MAX_DEVIATION
    assert complaints(source) == set()


def test_the_page_shows_each_fault_that_is_made() -> None:
    assert list(FAULTS) == list(MADE)
    assert f"{len(FAULTS)} faults" in PAGE.read_text()
    assert any(fault.is_silent for fault in FAULTS.values())
