"""Runs and checks over rendered recordings with faults; each image is rendered once."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gvo.config import Config
from gvo.diagnostics.check import check_recording
from gvo.errors import GvoError
from gvo.geometry import se3
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from gvo.testing.faults import FaultyImage
from gvo.trajectory.formats import read_covariances, read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from tests.conftest import run_of
from tests.faults.catalogue import NamedFault
from tests.faults.delivery import FaultySource
from tests.make.recordings import Held, hold

_SCALE = 0.4


@cache
def _rendered(sensor: Sensor) -> Held:
    return hold(SyntheticRecording("handheld", sensor, n_frames=330, scale=_SCALE))


def sound(sensor: Sensor, n_frames: int = 20) -> Held:
    """Return a recording without faults."""
    return _rendered(sensor).cut(n_frames)


@dataclass(frozen=True)
class Outcome:
    """What a run over a faulty recording left.

    `errors_m` and `deviations` are of the causal poses: their distance to the truth, and the
    Mahalanobis norm of the error; NaN where the truth is not known. `frames` are the numbers of
    the poses' frames in the sound recording; `rows` those of frames.csv.
    """

    exit_code: int
    message: str = ""
    warnings: tuple[str, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, str]] = field(default_factory=list)
    n_given: int = 0
    frames: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    poses: dict[str, FloatArray] = field(default_factory=dict)
    covariances: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    errors_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    deviations: FloatArray = field(default_factory=lambda: np.zeros(0))

    def n(self, status: str) -> int:
        return sum(row["status"] == status for row in self.rows)


def run(source: FaultySource, truth: Trajectory | None, out: Path) -> Outcome:
    """Run odometry; only a GvoError may come out of it, as the command line catches it."""
    assert truth is not None
    try:
        result = run_of(source, out)
    except GvoError as error:
        return Outcome(exit_code=2, message=str(error))
    with (out / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    poses = {name: read_trajectory(out / f"{name}.txt") for name in ("raw", "causal", "smoothed")}
    causal, covariances = poses["causal"], read_covariances(out / "causal_covariance.csv")[1]
    given = [image for image in _until_error(source) if image.given.stream == 0]
    with_pose = {int(row["stamp_ns"]) for row in rows if row["status"] != "skipped"}
    # where a stamp repeats, the first image has the pose
    of_stamp = {image.given.stamp_ns: image.frame for image in reversed(given)}
    frames = np.array([of_stamp[stamp_ns] for stamp_ns in causal.stamps_ns.tolist()])
    assert with_pose == set(causal.stamps_ns.tolist())
    errors_m, deviations = _errors(truth, frames, causal.T_world_frame, covariances)
    return Outcome(
        exit_code=0 if result.is_complete else 3,
        warnings=result.warnings,
        summary=result.summary,
        rows=rows,
        n_given=len(given),
        frames=frames,
        poses={name: trajectory.T_world_frame for name, trajectory in poses.items()},
        covariances=covariances,
        errors_m=errors_m,
        deviations=deviations,
    )


def complaints(source: FaultySource) -> set[str]:
    """Return what `gvo check` warns of, without the names of streams."""
    n_samples = 4 if source.info.sensor == "stereo" else 10
    result = check_recording(source, Config(), n_samples=n_samples)
    found = result.with_verdict("warning", "fault")
    return {finding.name.rpartition(": ")[2] for finding in found}


def faulty(fault: NamedFault, sensor: Sensor, *, is_lasting: bool = False) -> FaultySource:
    return fault.wrap(sound(sensor, fault.n_frames), is_lasting=is_lasting)


def _until_error(source: FaultySource) -> Iterator[FaultyImage]:
    with suppress(GvoError, OSError):
        yield from source.faulty_images()


def _errors(
    truth: Trajectory, frames: IntArray, poses: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    true = se3.invert(truth.T_world_frame[frames[0]]) @ truth.T_world_frame[frames]
    errors = se3.log(se3.invert(poses) @ true)
    solved = np.linalg.solve(covariances + 1e-10 * np.eye(6), errors[..., np.newaxis])
    distances = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    return distances, np.sqrt(np.einsum("ni,nij->n", errors, solved))
