"""Forms of calibration files, by the systems that write them: which a file has, its cameras."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml

from gvo._text import MAX_CHARACTERS, YamlError, access_fault, load_yaml, read_text, shortened
from gvo.errors import CalibrationError, named_faults
from gvo.geometry import se3
from gvo.geometry.imu import LARGEST_DENSITY, MAX_SHIFT_S
from gvo.io.calibration.camera_info import (
    ROTATION_TOLERANCE,
    CameraFields,
    RegionOfInterest,
    known_model,
    read_array,
    read_numbers,
    supported_model,
)
from gvo.types import FloatArray

Content: TypeAlias = Mapping[Any, Any]
ImuFacts: TypeAlias = dict[str, Any]
"""What is said of an IMU: values of `Imu` by name, `T_body_imu` (4, 4), and its `topic`."""

_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"
# OpenCV also reads `data:[0]` and `PointSize:2`, as the files of ORB-SLAM have them.
_KEY_WITHOUT_BLANK = re.compile(r"^(\s*[\w.]+):(?=\S)", re.MULTILINE)
_KITTI_ROW = re.compile(r"^P(?:_rect_0)?([0-9]):?[ \t](.*)$", re.MULTILINE)
_CHAIN = re.compile(r"cam([0-9]{1,3})")
_KNOWN = (
    "expected a file of ROS (camera_info), OpenCV, Kalibr (camchain), EuRoC (sensor.yaml), "
    "ORB-SLAM, stella_vslam, VINS, OpenVINS or KITTI (P0, P1)"
)
_KEYS = {
    "width": ("image_width", "width", "cols"),
    "height": ("image_height", "height", "rows"),
    "model": ("distortion_model", "model_type", "model", "type"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "distortion_coeffs", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
}
_PINHOLE = ("fx", "fy", "cx", "cy")
_RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
# What VINS calls them of a fisheye.
_OF_KANNALA_BRANDT = dict(
    zip(("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5"), _PINHOLE + _FISHEYE, strict=True)
)
# By their keys whether they map the other way round.
_TO_BODY = {"T_BS": False, "T_cam_imu": True, "T_imu_cam": False}
# Kalibr's, of a camera whose body is the IMU: t_imu = t_cam + timeshift.
_TO_IMU = ("T_cam_imu", "T_imu_cam")
TIMESHIFT = "timeshift_cam_imu"
# Kalibr's and EuRoC's densities of an IMU, by what `Imu` calls them.
IMU_DENSITIES = {
    "gyro_noise": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "acceleration_noise": "accelerometer_noise_density",
    "acceleration_walk": "accelerometer_random_walk",
}
_FROM_PREVIOUS = {"T_cn_cnm1": False, "T_c1_c2": True, "Tlr": True}
_COMMON = ("type", "width", "height")
_DEPTH_KEYS = ("depth_scale", "DepthMapFactor", "depthmap_factor")
_MAX_COUNT = 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescribedCamera:
    """A camera of a calibration file.

    Parameters
    ----------
    fields : CameraFields
        As they stand there, not checked; width and height 0 where the file does not say them.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the raw camera to the body (EuRoC: T_BS, Kalibr: the inverse of T_cam_imu), metres.
    T_cam_previous : ndarray of float64, shape (4, 4), optional
        Maps the raw camera before it in a chain to this one (Kalibr: T_cn_cnm1), metres.
    focal_x_baseline : float, optional
        Of a rectified pair whose cameras are both like this one, pixels times metres.
    depth_scale : float, optional
        Counts per metre of integer depth.
    imu : ImuFacts
        What is said of the IMU beside it.
    """

    fields: CameraFields
    T_body_cam: FloatArray | None = None
    T_cam_previous: FloatArray | None = None
    focal_x_baseline: float | None = None
    depth_scale: float | None = None
    imu: ImuFacts = field(default_factory=dict)


def read_calibration_file(path: Path) -> tuple[DescribedCamera, ...]:
    """Read a camera, a pair or a chain in any form of `FORMS`, or the rows P0, P1, ... of KITTI.

    A file may hold the counts per metre of depth: `depth_scale`, or what ORB-SLAM and stella_vslam
    call their factor.
    """
    text = _read(path)
    rows = sorted(_KITTI_ROW.findall(text))
    if rows:
        return tuple(_described({"P": row.split()}, f"{path}: P{n}") for n, row in rows)
    content = _load(text, path)
    scale = _depth_scale(content, path)
    return tuple(replace(each, depth_scale=scale) for each in _cameras(content, path, FORMS))


def read_imu_file(path: Path) -> ImuFacts:
    """Read what the file of an IMU says: Kalibr's imu.yaml, EuRoC's sensor.yaml of `imu0`.

    Empty where it is a file of cameras.
    """
    text = _read(path)
    if _KITTI_ROW.search(text):
        return {}
    content = _load(text, path)
    own = _part(content, "imu0") or content
    if not any(key in own for key in IMU_DENSITIES.values()):
        return {}
    facts = _imu_beside(own, str(path))
    for name, key in IMU_DENSITIES.items():
        if key in own:
            facts[name] = float(_array(own, key, (1,), str(path))[0])
            if not 0.0 < facts[name] <= LARGEST_DENSITY:
                most = f"positive and at most {LARGEST_DENSITY:g}"
                raise CalibrationError(f"{path}: {key} must be {most}, got {facts[name]:g}")
    if "T_BS" in own:
        facts["T_body_imu"] = _transform(own, {"T_BS": False}, str(path))
    return facts | ({"topic": str(own["rostopic"])} if "rostopic" in own else {})


def _imu_beside(content: Content, where: str) -> ImuFacts:
    """Return what a camera or an IMU says of how both belong together."""
    facts: ImuFacts = {"T_body_imu": np.eye(4)} if any(map(content.get, _TO_IMU)) else {}
    if content.get(TIMESHIFT) is not None:
        facts["delay_s"] = shift_s = 0.0 - float(_array(content, TIMESHIFT, (1,), where)[0])
        if not abs(shift_s) <= MAX_SHIFT_S:
            raise CalibrationError(f"{where}: {TIMESHIFT} must be within {MAX_SHIFT_S:g} s")
    elif TIMESHIFT in content:
        facts["delay_s"] = None  # it is said not to be known
    return facts


def _cameras(content: Content, path: Path, forms: Iterable[Form]) -> tuple[DescribedCamera, ...]:
    for key, read in forms:
        if any(re.fullmatch(key, str(each)) for each in content):
            return tuple(read(content, path))
    raise CalibrationError(f"{path}: not a calibration that gvo knows: {_KNOWN}")


def _of_vins(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read the cameras of VINS-Fusion in files of their own, and their poses on the body."""
    for n in range(2):
        if f"cam{n}_calib" in content:
            camera = _elsewhere(path, content[f"cam{n}_calib"])[0]
            T_body_cam = _transform(content, {f"body_T_cam{n}": False}, str(path))
            yield replace(camera, T_body_cam=T_body_cam)


def _of_estimator(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read the chain that the configuration of OpenVINS names."""
    return _elsewhere(path, content["relative_config_imucam"])


def _elsewhere(path: Path, name: object) -> tuple[DescribedCamera, ...]:
    """Read the file that another names, which must not name a third."""
    other = path.parent / str(name)
    if fault := access_fault(other):
        raise CalibrationError(f"{other}: {fault}; {path.name} names it: put it there")
    return _cameras(_load(_read(other), other), other, FORMS[2:])


def _of_chain(content: Content, path: Path) -> Iterable[DescribedCamera]:
    chain = {int(match[1]): key for key in content if (match := _CHAIN.fullmatch(str(key)))}
    return [_described(_part(content, chain[n]), f"{path}: {chain[n]}") for n in sorted(chain)]


def _of_pair(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read a pair; raw cameras of ORB-SLAM without P are those of its camera and its `bf`."""
    names = ("left", "right") if _part(content, "left") else ("LEFT", "RIGHT")
    sides = {name: _part(content, name) for name in names}
    if "bf" in _part(content, "Camera") and not any("P" in side for side in sides.values()):
        return _rectified_to_camera(content, path, sides)
    return [_described(side, f"{path}: {name}") for name, side in sides.items()]


def _of_slam(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read the camera of ORB-SLAM or stella_vslam, and the right one where it has its own."""
    camera, second = _part(content, "Camera"), _part(content, "Camera2")
    where = f"{path}: Camera of {'stella_vslam' if 'model' in camera else 'ORB-SLAM'}"
    stereo = {"Tlr": content["Tlr"]} if "Tlr" in content else _part(content, "Stereo")
    yield _described(camera | _part(content, "Camera1") | stereo, where)
    if "fx" in second:
        common = {key: camera[key] for key in _COMMON if key in camera}
        yield _described(common | stereo | second, f"{path}: Camera2")


def _of_rectifier(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read the raw pair that stella_vslam rectifies to its camera."""
    rectifier = _part(content, "StereoRectifier")
    sides = {
        f"{side} of StereoRectifier": {
            str(key).removesuffix(f"_{side}"): value for key, value in rectifier.items()
        }
        for side in ("left", "right")
    }
    return _rectified_to_camera(content, path, sides)


def _rectified_to_camera(
    content: Content, path: Path, sides: Mapping[str, Content]
) -> Iterable[DescribedCamera]:
    camera, *_ = _of_slam(content, path)
    fields, offset = camera.fields, 0.0
    for name, side in sides.items():
        if _first(side, _KEYS["R"]) is None:
            raise CalibrationError(f"{path}: {name} lacks R, its rotation to the rectified camera")
        P = np.hstack([np.reshape(fields.K, (3, 3)), [[offset], [0.0], [0.0]]])
        size = {"cols": fields.width, "rows": fields.height}
        yield _described({**size, **side, "P": P}, f"{path}: {name}")
        offset = -(camera.focal_x_baseline or 0.0)


def _of_one(content: Content, path: Path) -> Iterable[DescribedCamera]:
    """Read one camera; VINS has its numbers in parts."""
    numbers = _part(content, "projection_parameters") | _part(content, "distortion_parameters")
    if content.get("model_type") == "KANNALA_BRANDT":
        numbers = {_OF_KANNALA_BRANDT.get(key, key): value for key, value in numbers.items()}
    return [_described({**content, **numbers}, str(path))]


def _part(content: Content, name: str) -> dict[Any, Any]:
    """Return the keys under a name, or those that begin with it and a dot, which is left out."""
    part, start = content.get(name), f"{name}."
    if isinstance(part, Mapping):
        return dict(part)
    return {k.removeprefix(start): v for k, v in content.items() if str(k).startswith(start)}


def _described(content: Content, where: str) -> DescribedCamera:
    fields = _fields(content, where)
    return DescribedCamera(
        fields=fields,
        T_body_cam=_transform(content, _TO_BODY, where),
        T_cam_previous=_transform(content, _FROM_PREVIOUS, where),
        focal_x_baseline=_focal_x_baseline(content, fields, where),
        imu=_imu_beside(content, where),
    )


def _fields(content: Content, where: str) -> CameraFields:
    values = {name: _first(content, keys) for name, keys in _KEYS.items()}
    model = str(values["model"] or "")
    for key in ("camera_model", *_KEYS["model"][1:]):
        supported_model(str(content.get(key, "pinhole")), where)  # with coefficients or without
    if values["D"] is None:
        order = _FISHEYE if known_model(model) == "equidistant" else _RADIAL_TANGENTIAL
        values["D"] = [content[name] for name in order if name in content]
    size = content.get("resolution", [values["width"] or 0, values["height"] or 0])
    width, height = map(int, read_array(_data(size), (2,), f"{where}: width and height"))
    return CameraFields(
        where=where,
        width=width,
        height=height,
        model=model or _assumed_model(content, values["D"], where),
        K=_K(content, values, where),
        D=values["D"],
        R=np.zeros(9) if values["R"] is None else values["R"],
        P=np.zeros(12) if values["P"] is None else values["P"],
        binning=(_count(content, "binning_x", where), _count(content, "binning_y", where)),
        roi=_region(content.get("roi"), where),
        is_distorted_by_zeros=values["K"] is None,
    )


def _K(content: Content, values: Content, where: str) -> FloatArray:  # noqa: N802 - its name
    """Return K, of a matrix, a list or numbers with keys of their own; zeros beside P alone."""
    if values["K"] is not None:
        return read_array(values["K"], (3, 3), f"{where}: K")
    if "intrinsics" in content:
        fx, fy, cx, cy = _array(content, "intrinsics", (4,), where)
    elif all(name in content for name in _PINHOLE):
        fx, fy, cx, cy = read_array([content[name] for name in _PINHOLE], (4,), f"{where}: fx, ...")
    elif values["P"] is not None:
        return np.zeros((3, 3))
    else:
        missing = ", ".join(name for name in _PINHOLE if name not in content)
        raise CalibrationError(f"{where}: lacks camera_matrix, intrinsics or {missing}; {_KNOWN}")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _focal_x_baseline(content: Content, fields: CameraFields, where: str) -> float | None:
    for key in ("bf", "focal_x_baseline", "b"):
        if key in content:
            fx = np.ravel(fields.K)[0] if key == "b" else 1.0
            return float(fx * _array(content, key, (1,), where)[0])
    return None


def _region(content: object, where: str) -> RegionOfInterest:
    if not isinstance(content, Mapping):
        return RegionOfInterest()
    counts = {name: _count(content, name, f"{where}: roi") for name in RegionOfInterest.__slots__}
    return RegionOfInterest(**counts)


def _count(content: Content, key: str, where: str) -> int:
    count = content.get(key, 0)
    if not isinstance(count, int) or not 0 <= count <= _MAX_COUNT:
        raise CalibrationError(f"{where}: {key} must be a count, got {shortened(count)}")
    return count


def _assumed_model(content: Content, D: object, where: str) -> str:
    """Tell the model by what OpenCV writes: a flag for fisheyes, else the count decides."""
    if content.get("fisheye_model"):
        return "equidistant"
    n_numbers = read_numbers(D, f"{where}: D").size
    return "rational_polynomial" if n_numbers > 5 else "plumb_bob"


def _first(content: Content, keys: tuple[str, ...]) -> Any:  # noqa: ANN401 - YAML
    return _data(next((content[key] for key in keys if key in content), None))


def _data(value: Any) -> Any:  # noqa: ANN401 - YAML
    return value.get("data", value) if isinstance(value, Mapping) else value


def _transform(content: Content, keys: Mapping[str, bool], where: str) -> FloatArray | None:
    """Return the first of these that is there, inverted where it maps the other way round."""
    key = next((key for key in keys if key in content), None)
    if key is None:
        return None
    numbers = read_numbers(_data(content[key]), f"{where}: {key}")
    if numbers.size == 12:
        numbers = np.concatenate([numbers, np.eye(4)[3]])  # ORB-SLAM left the last row out
    T = read_array(numbers, (4, 4), f"{where}: {key}")
    T[3] = np.round(T[3], 6)  # programs that invert transforms write their rounding
    fault = se3.transform_fault(T, tolerance=ROTATION_TOLERANCE)
    if fault:
        raise CalibrationError(f"{where}: {key} {fault}")
    return se3.invert(se3.normalize(T)) if keys[key] else se3.normalize(T)


def _array(content: Content, key: str, shape: tuple[int, ...], where: str) -> FloatArray:
    return read_array(_data(content[key]), shape, f"{where}: {key}")


def _depth_scale(content: Content, path: Path) -> float | None:
    parts = (content, _part(content, "RGBD"), _part(content, "Preprocessing"))
    found = [(key, part[key]) for part in parts for key in _DEPTH_KEYS if key in part]
    if not found:
        return None
    key, scale = found[0]
    is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if not (is_number and 0 < scale < np.inf):
        raise CalibrationError(f"{path}: {key} must be a positive number, got {shortened(scale)}")
    # a factor of 1 is of depth in metres, of which there are no counts
    return float(scale) if key == "depth_scale" or scale > 1 else None


def _read(path: Path) -> str:
    try:
        with named_faults(CalibrationError, path, "the calibration cannot be read"):
            return read_text(path, max_bytes=MAX_CHARACTERS)
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: the calibration is not text") from error


def _load(text: str, path: Path) -> dict[Any, Any]:
    """Load YAML, also as OpenCV reads it."""
    if text.startswith("%YAML"):  # with OpenCV's colon it is no directive of YAML
        text = _KEY_WITHOUT_BLANK.sub(r"\1: ", text.partition("\n")[2])
    try:
        # Of several documents, as `ros2 topic echo` prints them, the first counts.
        content = load_yaml(text, _Loader)
    except YamlError as error:
        raise CalibrationError(f"{path}: not YAML ({error}); {_KNOWN}") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: holds no keys; {_KNOWN}")
    return content


class _Loader(yaml.SafeLoader):
    """Reads the matrices of OpenCV as the keys that they consist of."""


_Loader.add_constructor(_OPENCV_MATRIX, partial(_Loader.construct_mapping, deep=True))

Form: TypeAlias = tuple[str, Callable[[Content, Path], Iterable[DescribedCamera]]]
"""A pattern of one of its keys, and what reads the cameras."""
FORMS: tuple[Form, ...] = (
    ("cam0_calib", _of_vins),
    ("relative_config_imucam", _of_estimator),
    (_CHAIN.pattern, _of_chain),
    (r"(left|LEFT)(\..*)?", _of_pair),
    (r"StereoRectifier(\..*)?", _of_rectifier),
    (r"Camera1?(\..*)?", _of_slam),
    ("intrinsics|camera_matrix|[Kk]|projection_.*", _of_one),
)
"""The first that fits; the first two name other files."""
