"""`rig.yaml`: what a run learnt of its camera, and the camera that it belongs to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from gvo._text import MAX_CHARACTERS, MAX_SHOWN, YamlError, cut, load_yaml, read_text
from gvo.errors import CalibrationError, named_faults
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.rig import LearntRig
from gvo.io.recording import RecordingInfo

# Digits that are written, and by how much another machine may rectify otherwise, relatively.
_DIGITS = 9
_MAX_DIFFERENCE = 1e-5


class _Constant(BaseModel):
    model_config = ConfigDict(extra="forbid")
    value: float
    sigma: float


class _File(BaseModel):
    """What stands in the file."""

    model_config = ConfigDict(extra="forbid")
    sensor: Literal["stereo", "rgbd"]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float = 0.0
    frames: int
    constants: dict[str, _Constant]
    information: list[list[float]]

    def camera(self) -> StereoCamera | PinholeCamera:
        """Return the camera that it belongs to, with what was learnt of it."""
        if len({*map(len, self.information)}) > 1:
            raise CalibrationError("information has rows of different lengths")
        rig = LearntRig(
            constants={name: (each.value, each.sigma) for name, each in self.constants.items()},
            information=np.array(self.information, dtype=np.float64),
            n_frames=self.frames,
        )
        names = "width", "height", "fx", "fy", "cx", "cy"
        camera = PinholeCamera(**{name: getattr(self, name) for name in names}, rig=rig)
        is_stereo = self.sensor == "stereo"
        return StereoCamera.from_pinhole(camera, self.baseline_m) if is_stereo else camera


def rig_json(camera: StereoCamera | PinholeCamera, rig: LearntRig) -> dict[str, Any]:
    """Return what `rig.yaml` holds, and `summary.json` of it."""
    return {
        **_camera_json(camera),
        "frames": rig.n_frames,
        "constants": {
            name: {"value": _rounded(value), "sigma": _rounded(sigma)}
            for name, (value, sigma) in rig.constants.items()
        },
        "information": [[*map(_rounded, row)] for row in rig.information.tolist()],
    }


def _camera_json(camera: StereoCamera | PinholeCamera) -> dict[str, Any]:
    names = "width", "height", "fx", "fy", "cx", "cy"
    values = {name: getattr(camera, name) for name in names}
    if isinstance(camera, StereoCamera):
        return {"sensor": "stereo", **values, "baseline_m": camera.baseline}
    return {"sensor": "rgbd", **values}


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def with_rig(info: RecordingInfo, path: str | Path | None) -> RecordingInfo:
    """Return what is known of a recording, with what an earlier run learnt of its camera.

    Raises
    ------
    CalibrationError
        If the file cannot be read, or belongs to another camera.
    """
    if path is None:
        return info
    faults = YamlError, UnicodeDecodeError, CalibrationError
    with named_faults(CalibrationError, path, others=faults):
        camera = camera_of(load_yaml(read_text(Path(path), max_bytes=MAX_CHARACTERS)))
        theirs, ours = _camera_json(camera), _camera_json(info.camera)
        for name in ours:
            if not _is_same(theirs.get(name), ours[name]):
                raise CalibrationError(
                    f"learnt of a camera of {name} {theirs.get(name)}, that of {info.name} has "
                    f"{ours[name]}; --rig takes what a run with the same calibration wrote"
                )
    return replace(info, rig=camera.rig)


def camera_of(values: object) -> StereoCamera | PinholeCamera:
    """Return the camera that `rig_json` was made of, with its rig.

    Raises
    ------
    CalibrationError
        For other values.
    """
    try:
        return _File.model_validate(values).camera()
    except ValidationError as error:
        first = error.errors()[0]
        where = cut(".".join(map(str, first["loc"])), MAX_SHOWN)
        raise CalibrationError(
            f"is no rig.yaml of a run: {where and f'{where}: '}{first['msg'].lower()}"
        ) from error


def _is_same(theirs: object, ours: object) -> bool:
    if isinstance(theirs, float) and isinstance(ours, float):
        return abs(theirs - ours) <= _MAX_DIFFERENCE * abs(ours)
    return theirs == ours
