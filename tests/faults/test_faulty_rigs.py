"""Rigs with a fault, rendered: poses are right, or covariances, or the verdict names the cause.

Each fault also in half and twice its size, and some the other way round. What a verdict says then,
it says of no sound rig. The table in docs/SECURITY.md says what comes of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gvo.config import Config
from gvo.io.recording import Sensor, Source
from gvo.io.run_folder.verdict import verdict
from gvo.io.synthetic import RigError, SyntheticRecording, World
from gvo.trajectory.formats import read_trajectory
from gvo.types import FloatArray
from tests.conftest import run_of
from tests.faults import Elsewhere, FaultySource, along_ray, bonnet, mirrored, spoilt
from tests.worlds import KINDS, rendered

SCALE, N_FRAMES = 0.4, 300
DRIVE, HAND = KINDS["driving"], KINDS["handheld"]
RECORDED = (
    *("kitti_01_half", "kitti_06_start", "euroc_mh01_start", "euroc_mh01_imu"),
    *("rgbd_dataset_freiburg1_xyz_start", "rgbd_dataset_freiburg1_rpy_part", "sevenscenes_start"),
)
# What names a cause, and what of it no sound rig is told.
RIDES, STILL, ZOOM, LATE = "rides with", "images stand still", "zoom and focus", "the trigger"
SILENT = {RIDES, STILL, ZOOM, LATE}
CAUSES = (*SILENT, "the calibration,", "the rectification,", "a rolling shutter", "the scale,")
# Of positions, in per cent of the path, and of motions over a second.
POSITION, NEES = 3.0, 10.0
BONNET_PX = 18.0  # its disparity


def recorded(
    world: World, sensor: Sensor = "stereo", *, n_frames: int, **how: Any
) -> SyntheticRecording:
    return SyntheticRecording(world, sensor, n_frames=n_frames, scale=SCALE, **how)


def timed(world: World, when: Callable[[FloatArray], FloatArray]) -> World:
    """Return a world through which the camera moves at other times."""
    return replace(world, motion=lambda seed: lambda elapsed_s: world.motion(seed)(when(elapsed_s)))


def zoomed(world: World, ratio: float) -> World:
    fx, fy = ratio * world.camera.fx, ratio * world.camera.fy
    return replace(world, camera=replace(world.camera, fx=fx, fy=fy))


def with_bonnet(size: float, n_frames: int) -> Source:
    of_left, of_right = (
        spoilt(bonnet, part=0.3 * size, shift_px=shift_px, streams=(stream,))
        for stream, shift_px in enumerate((0.0, BONNET_PX))
    )
    return FaultySource(recorded(DRIVE, n_frames=n_frames), of_left, of_right)


def bent(size: float, n_frames: int, **constants: float) -> Source:
    error = RigError(constants={name: size * value for name, value in constants.items()})
    return recorded(DRIVE, n_frames=n_frames, rig_error=error)


def late(size: float, n_frames: int, late_s: float) -> Source:
    later = recorded(timed(DRIVE, lambda t: t + size * late_s), n_frames=n_frames)
    return FaultySource(recorded(DRIVE, n_frames=n_frames), Elsewhere(other=later, streams=(1,)))


def frozen(size: float, n_frames: int) -> Source:
    """Both cameras hang in the middle, of a drive that is faster by `size`; noise goes on."""
    end_s = n_frames // 2 / DRIVE.rate_hz
    driven = timed(DRIVE, lambda t: size * t)
    held = timed(driven, lambda t: np.minimum(t, end_s))
    hanging = Elsewhere(other=recorded(held, n_frames=n_frames))
    return FaultySource(recorded(driven, n_frames=n_frames), hanging)


def zoom(size: float, n_frames: int, world: World, sensor: Sensor) -> Source:
    other = recorded(zoomed(world, 1.0 + 0.1 * size), sensor, n_frames=n_frames)
    change = Elsewhere(other=other, first=n_frames // 2)
    return FaultySource(recorded(world, sensor, n_frames=n_frames), change)


def of_depth(size: float, n_frames: int, by: Callable[..., Any]) -> Source:
    hand = recorded(HAND, "rgbd", n_frames=n_frames)
    values = {"camera": hand.info.camera, "size": size} if by is along_ray else {}
    return FaultySource(hand, spoilt(by, of="depth", **values))


_ROLL, _YAW = np.deg2rad(0.3), 1.0 / (SCALE * DRIVE.camera.fx)  # the latter of one pixel
FAULTS: dict[str, Callable[[float, int], Source]] = {
    "bonnet": with_bonnet,
    "rolled": partial(bent, dy=_ROLL, rx=_ROLL),
    "yawed": partial(bent, d0=1.0, dxx=_YAW, rxy=_YAW),
    "scaled": partial(bent, dx=-0.005, ry=0.005),
    "late-10": partial(late, late_s=0.01),
    "late-30": partial(late, late_s=0.03),
    "frozen": frozen,
    "along-ray": partial(of_depth, by=along_ray),
    "mirrored": partial(of_depth, by=mirrored),
    "zoom": partial(zoom, world=DRIVE, sensor="stereo"),
    "zoom-rgbd": partial(zoom, world=HAND, sensor="rgbd"),
}
# The sizes, and what the verdict tells; empty where poses are right, or covariances large enough.
CASES: list[tuple[str, tuple[float, ...], str]] = [
    ("bonnet", (0.5, 1.0), ""),
    ("bonnet", (2.0,), RIDES),
    ("rolled", (0.5, 1.0, 2.0), ""),
    ("yawed", (0.5, 1.0, 2.0, -1.0), ""),
    ("scaled", (0.5, 1.0, 2.0, -1.0), ""),
    ("late-10", (0.5, 1.0, 2.0), ""),
    ("late-30", (0.5, 1.0, 2.0, -1.0), LATE),
    ("frozen", (0.5, 1.0, 2.0), STILL),
    ("along-ray", (0.5, 1.0, 2.0), ""),
    ("mirrored", (1.0,), ""),
    ("zoom", (0.5, 1.0, 2.0, -1.0), ZOOM),
    ("zoom-rgbd", (0.5, 1.0, 2.0, -1.0), ZOOM),
]
# One of each mechanism.
LASTING = ("bonnet", "yawed", "late-30", "along-ray", "mirrored")


def halting(elapsed_s: FloatArray) -> FloatArray:
    """Return the time on the road of a car that brakes by 5 m/s^2, waits for 2 s, and goes on."""
    fine = np.arange(0.0, 60.0, 0.01)
    pace = np.interp(fine, [2.0, 4.0, 6.0, 8.0], [1.0, 0.0, 0.0, 1.0])
    return np.interp(elapsed_s, fine, 0.01 * np.cumsum(pace))


SOUND: dict[str, tuple[World, Sensor]] = {
    "halt": (timed(DRIVE, halting), "stereo"),
    "hand": (HAND, "stereo"),
    "hand-rgbd": (HAND, "rgbd"),
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Error of the last position (% of the path), NEES over 1 s (rotation, translation), causes."""

    error_percent: float
    nees: tuple[float, float]
    causes: set[str]
    verdict: str


def run(source: Source, out: Path, **options: Any) -> Outcome:
    summary, truth = run_of(source, out, **options).summary, source.ground_truth()
    assert truth is not None
    row = summary["nees"]["window"]["1s"]["bare"]
    error_m = read_trajectory(out / "smoothed.txt").positions[-1] - truth.positions[-1]
    said = verdict(summary)
    return Outcome(
        error_percent=100.0 * float(np.linalg.norm(error_m)) / float(truth.distances()[-1]),
        nees=(row["rotation"], row["translation"]),
        causes={cause for cause in CAUSES if cause in said},
        verdict=said,
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "size", "told"),
    [(name, size, told) for name, sizes, told in CASES for size in sizes],
)
def test_a_faulty_rig_is_not_certain(name: str, size: float, told: str, tmp_path: Path) -> None:
    assert_not_certain(name, size, told, N_FRAMES, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("name", "told"),
    [(name, told) for name, sizes, told in CASES if 1.0 in sizes and name in LASTING],
)
def test_a_lasting_fault_is_not_certain_after_a_while(name: str, told: str, tmp_path: Path) -> None:
    assert_not_certain(name, 1.0, told, N_FRAMES // 2, tmp_path)


def assert_not_certain(name: str, size: float, told: str, n_frames: int, out: Path) -> None:
    found = run(FAULTS[name](size, n_frames), out)
    if told:
        assert_told(found, told, size, n_frames)
    else:
        assert found.error_percent < POSITION or max(found.nees) < NEES


def assert_told(found: Outcome, cause: str, size: float, n_frames: int) -> None:
    assert found.causes == {cause}, found.verdict
    if cause == STILL:
        assert f"stand still from frame {n_frames // 2 + 1} on, at " in found.verdict
    if cause == ZOOM:
        assert f"is {1.0 + 0.1 * size:.3g} times as large from " in found.verdict


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
@pytest.mark.parametrize(
    ("name", "right"), [("frozen", STILL), ("zoom", ZOOM), ("zoom-rgbd", ZOOM)]
)
def test_a_sudden_fault_is_told_within_seconds(
    name: str, right: str, kind: str, tmp_path: Path
) -> None:
    config = Config.model_validate({"frontend": {"kind": kind}})
    assert_told(run(FAULTS[name](1.0, 40), tmp_path, config=config), right, 1.0, 40)


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_rig_is_told_of_no_fault(name: str, tmp_path: Path) -> None:
    world, sensor = SOUND[name]
    assert not SILENT & run(recorded(world, sensor, n_frames=50), tmp_path).causes


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("name", SOUND)
def test_sound_rigs_are_told_of_no_fault(name: str, seed: int, tmp_path: Path) -> None:
    world, sensor = SOUND[name]
    found = run(recorded(world, sensor, n_frames=150, seed=seed), tmp_path)
    assert not SILENT & found.causes, found.verdict


@pytest.mark.thorough
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_no_world_looks_like_a_fault_of_the_rig(kind: str, tmp_path: Path) -> None:
    found = run(rendered(kind, n_frames=N_FRAMES, scale=SCALE), tmp_path)
    assert not SILENT & found.causes, found.verdict


@pytest.mark.recorded
@pytest.mark.acceptance
@pytest.mark.parametrize("name", RECORDED)
def test_no_recording_is_told_of_a_fault(name: str, gvo_data: Path, tmp_path: Path) -> None:
    said = verdict(run_of(gvo_data / name, tmp_path).summary)
    assert not [cause for cause in SILENT if cause in said], said
