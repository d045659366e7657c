"""`rig.yaml`: written by a run, read by another one of the same camera."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import gvo
from gvo.errors import CalibrationError
from gvo.geometry.rig import LearntRig
from gvo.io.rig_file import rig_json, with_rig

INFO = gvo.SyntheticRecording("driving", n_frames=2).info
RIG = LearntRig(
    constants={"d0": (-0.31, 0.01), "r0": (0.2, 0.03), "readout_s": (0.004, 0.001)},
    information=np.array([[9000.0, 10.0, -400.0], [10.0, 1000.0, 0.0], [-400.0, 0.0, 9e5]]),
    n_frames=77,
)


def written(folder: Path, **changes: Any) -> Path:
    values = rig_json(INFO.camera, RIG) | changes
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in values.items() if v != "left out"}))
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    rig = with_rig(INFO, written(tmp_path)).camera.rig
    assert rig is not None
    assert dict(rig.constants) == dict(RIG.constants)
    assert rig.n_frames == 77
    np.testing.assert_array_equal(rig.information, RIG.information)
    assert with_rig(INFO, None) is INFO


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": "rgbd"}, "sensor rgbd, that of .* has stereo"),
        ({"width": 640}, f"width 640, that of .* has {INFO.camera.width}"),
        ({"fx": 500.0}, "fx 500.0, that of .* has"),
        ({"baseline_m": 0.3}, "baseline_m 0.3, that of .* has"),
        ({"baseline_m": "left out"}, "baseline must be positive"),
        ({"height": "left out"}, "is no rig.yaml of a run: height: field required"),
        ({"frames": "many"}, "is no rig.yaml of a run: frames: "),
        ({"kind": 3}, "is no rig.yaml of a run: kind: "),
        ({"constants": {"k9": {"value": 1, "sigma": 1}}}, "unknown constants k9"),
        ({"constants": {"d0": {"value": 1}}}, "constants.d0.sigma: field required"),
        ({"information": [[1.0, 2.0]]}, "information of 3 constants must be as many rows"),
        ({"information": [[1.0], [1.0, 2.0]]}, "rows of different lengths"),
        ({"information": [[1.0, 2, 3], [4, 5, 6], [7, 8, 9]]}, "must be symmetric"),
        ({"information": np.full((3, 3), np.nan).tolist()}, "must be finite"),
        ({"information": np.diag([1.0, -1.0, 1.0]).tolist()}, "not negative"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, change: Any, message: str) -> None:
    path = written(tmp_path, **change)
    with pytest.raises(CalibrationError, match=message) as caught:
        with_rig(INFO, path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"- 1", b"{", b"\xff\xfe\x00"])
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=r"rig\.yaml: "):
        with_rig(INFO, path)
    with pytest.raises(CalibrationError, match="No such file"):
        with_rig(INFO, tmp_path / "none.yaml")


def test_another_machine_may_rectify_a_little_otherwise(tmp_path: Path) -> None:
    path = written(tmp_path, fx=INFO.camera.fx * (1 + 1e-7))
    assert with_rig(INFO, path).rig is not None
    assert replace(INFO.camera, rig=RIG) == INFO.camera
