"""What makes a run this run and no other, and what is told of its IMU."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import gvo
from gvo.errors import RecordingError
from gvo.geometry.se3 import make_transform
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import StampedImage
from gvo.io.synthetic import SyntheticRecording, rendered_imu
from gvo.runs.summary import run_identity
from gvo.trajectory.trajectory import Trajectory
from tests.conftest import run_of

MOVED = make_transform(np.eye(3), np.array([0.1, 0.2, 0.3]))


class Recording:
    """A recording of three pairs of grey images."""

    def __init__(self, *, grey: int = 7, **changes: Any) -> None:
        rendered = SyntheticRecording("driving", "stereo", n_frames=3, scale=0.25)
        self.info = replace(rendered.info, **changes)
        self._grey = grey

    def images(self) -> Iterator[StampedImage]:
        for n in range(3):
            for stream in (0, 1):
                yield StampedImage(stream=stream, stamp_ns=n, load=partial(self._load, stream))

    def _load(self, stream: int) -> NDArray[Any]:
        if self._grey < 0:
            raise RecordingError("the image is cut off")
        return np.full((4, 6), self._grey + stream, dtype=np.uint8)

    def ground_truth(self) -> Trajectory | None:
        return None


def identity(recording: Recording | None = None, **options: Any) -> dict[str, Any]:
    asked: dict[str, Any] = {"base_frame": BaseFrame("camera"), "excerpt": None}
    return run_identity(recording or Recording(), **(asked | options))


def other_calibrations() -> Any:
    first, second = Recording().info.calibrations
    return replace(first, K=first.K + 1e-9 * np.eye(3, k=2)), second


def test_the_same_run_is_the_same_as_a_file_gives_it_back() -> None:
    found = json.loads(json.dumps(identity(excerpt=Excerpt())))
    assert found == identity()
    assert found["version of gvo"] == gvo.__version__


@pytest.mark.parametrize(
    "options",
    [
        {"recording": Recording(grey=8)},
        {"recording": Recording(grey=-1)},
        {"recording": Recording(n_images=99)},
        {"recording": Recording(calibrations=other_calibrations())},
        {"excerpt": Excerpt(every=2)},
        {"excerpt": Excerpt(duration_s=5.0)},
        {"base_frame": BaseFrame("base_link")},
        {"base_frame": BaseFrame("camera", MOVED)},
        {"base_frame": BaseFrame("camera", T_initial=MOVED)},
        {"start": Trajectory(stamps_ns=np.array([1]), T_world_frame=np.eye(4)[np.newaxis])},
    ],
)
def test_another_run_is_told_apart(options: dict[str, Any]) -> None:
    assert identity(**options) != identity()


def test_another_version_is_another_run(monkeypatch: pytest.MonkeyPatch) -> None:
    before = identity()
    monkeypatch.setattr("gvo.runs.summary.__version__", "99.0")
    assert identity() != before


def test_what_was_learnt_of_an_imu_is_told_as_learnt(tmp_path: Path) -> None:
    known = rendered_imu()
    imu = replace(known, imu=replace(known.imu, T_camera_imu=None, delay_s=None), delay_s=0.02)
    recording = SyntheticRecording("turning", "stereo", n_frames=110, scale=0.25, imu=imu)
    result = run_of(recording, tmp_path)
    told = result.summary["imu"]
    assert (told["has_started"], told["is_rotation_learnt"], told["is_delay_learnt"]) == (True,) * 3
    assert told["delay_ms"] == pytest.approx(20.0, abs=1.0)
    R = np.array(told["T_camera_imu"])[:3, :3]
    assert Rotation.from_matrix(R.T @ known.T_camera_imu[:3, :3]).magnitude() < 0.03
    assert "the IMU had nothing to carry; its delay of 20 ms was learnt" in str(result)
