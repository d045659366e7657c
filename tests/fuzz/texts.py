"""Text: poses, pose graphs, edges, tables of recordings and runs, configurations, calibrations."""

from contextlib import suppress
from functools import cache, partial
from itertools import islice

import cv2
import numpy as np

from gvo.config import Config, describe_configuration, load_configuration
from gvo.errors import GvoError
from gvo.io.calibration.files import read_cameras
from gvo.io.edges.events import InputFaults
from gvo.io.edges.lines import parse_line
from gvo.io.edges.opening import parse_sigma
from gvo.io.edges.pose_graph import PoseGraphSource
from gvo.io.opening import open_recording
from gvo.io.poses.base_frame import parse_initial_pose
from gvo.io.poses.truth import parse_bag_truth, parse_truth
from gvo.io.recording import Sensor
from gvo.io.run_folder.reader import read_run
from gvo.io.run_folder.writer import RunFolder
from gvo.runs.smooth import POSES_HEADER, Smoother
from gvo.runs.smooth import _answer_all as answer_lines
from gvo.trajectory.formats import COVARIANCE_HEADER, read_covariances, read_trajectory
from gvo.trajectory.g2o import convert_line
from gvo.trajectory.g2o import parse_line as parse_g2o_line
from tests.fuzz.mutations import mutate_behind_first, mutate_text
from tests.fuzz.target import Target, folder, write

_TUM = b"# stamp tx ty tz qx qy qz qw\n1.5 0 0 0 0 0 0 1\n1.6 1 0 0 0 0 0.7071 0.7071\n"
_KITTI = b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1.5 0 1 0 0 0 0 1 2e0\n"
_EUROC = (
    b"#timestamp, p_RS_R_x [m], y, z, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    b"1403636580838555648,4.6,-1.7,0.7,0.5341,-0.1530,-0.8273,-0.0820\n"
)
_STATE = b"1403636580838555648,4.6,-1.7,0.7,0.5341,-0.1530,-0.8273,-0.0820" + b",0.1" * 9 + b"\n"
_UPPER = b"1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
_GRAPH = (
    b"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nFIX 0\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + _UPPER + b"\n"
    b"EDGE3 1 2 1 0 0 0 0 0.1\nVERTEX3 2 1 1 1 0 0 0\nEDGE_SE3:QUAT 2 0 1 0 0 0 0 0 1 "
    + _UPPER
    + b"\n"
)
_JSON = b"""{"id": 0, "stamp_ns": 0}
{"id": 1, "stamp_ns": 100, "reference": 0, "pose": [0, 0, 1, 0, 0, 0, 1]}
{"id": 1, "edges": [{"reference": 0, "pose": [0, 0, 1, 0, 0, 0, 1], "kernel": "huber"}]}
{"id": "x", "stamp_ns": 200, "prior": {"position": [1, 2, 3], "sigmas": [1, 1, 1]}, "keep": true}
{"id": "y", "stamp_ns": 300, "prior": {"pose": [1, 2, 3, 0, 0, 0, 1]}, "keep": false}
"""
CALIBRATION = b"""image_width: 8
image_height: 6
camera_matrix: {rows: 3, cols: 3, data: [8, 0, 4, 0, 8, 3, 0, 0, 1]}
"""
_KALIBR = b"""cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
cam1:
  T_cn_cnm1:
    - [1.0, 0.0, 0.0, -0.11]
    - [0.0, 1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0, 0.0]
    - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: equidistant
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
"""
_SLAM = (
    b"""%YAML:1.0
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.9
Camera1.fy: 190.9
Camera1.cx: 254.9
Camera1.cy: 256.8
Camera1.k1: 0.003
Camera1.k2: 0.001
Camera1.k3: -0.002
Camera1.k4: 0.0
Camera2.fx: 190.4
Camera2.fy: 190.4
Camera2.cx: 252.5
Camera2.cy: 254.9
Camera2.k1: 0.003
Camera2.k2: 0.001
Camera2.k3: -0.002
Camera2.k4: 0.0
Camera.width: 512
Camera.height: 512
Stereo.T_c1_c2: !!opencv-matrix
  rows: 3
  cols: 4
  dt: f
  data:[1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0]
""",
    b"""Camera:
  {model: perspective, fx: 61, fy: 61, cx: 24, cy: 16, cols: 48, rows: 32, focal_x_baseline: 6}
StereoRectifier:
  K_left: [61, 0, 24, 0, 61, 16, 0, 0, 1]
  D_left: [0, 0, 0, 0]
  K_right: [61, 0, 24, 0, 61, 16, 0, 0, 1]
""",
    b"""model_type: PINHOLE
image_width: 48
image_height: 32
projection_parameters: {fx: 61, fy: 61, cx: 24, cy: 16}
""",
)
_OPENCV = b"""%YAML:1.0
---
LEFT.height: 480
LEFT.width: 752
LEFT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.28, 0.07, 0.0002, 1.8e-05, 0.0]
LEFT.K: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [458, 0, 367, 0, 457, 248, 0, 0, 1]}
RIGHT.height: 480
RIGHT.width: 752
RIGHT.K: &k !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [458, 0, 367, 0, 457, 248, 0, 0, 1]}
RIGHT.P: !!opencv-matrix {data: [458, 0, 367, -47, 0, 457, 248, 0, 0, 0, 1, 0]}
"""
_INFO = b"""width: 8
height: 6
distortion_model: plumb_bob
k: [8, 0, 4, 0, 8, 3, 0, 0, 1]
d: [0.1, 0, 0, 0, 0]
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [8, 0, 4, 0, 0, 8, 3, 0, 0, 0, 1, 0]
binning_x: 2
roi: {x_offset: 1, y_offset: 1, width: 4, height: 4}
depth_scale: 5000
---
width: 9
"""
SENSOR = b"""sensor_type: camera
T_BS: {data: [1, 0, 0, %s, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
resolution: [8, 6]
camera_model: pinhole
intrinsics: [8.0, 8.0, 4.0, 3.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""


def _poses(data: bytes) -> None:
    trajectory = read_trajectory(write("poses.txt", data))
    assert np.all(np.isfinite(trajectory.T_world_frame))
    trajectory.transformed(np.eye(4))


def _covariances(data: bytes) -> None:
    read_covariances(write("covariance.csv", data))


def _g2o_line(data: bytes) -> None:
    for line in data.decode(errors="replace").splitlines():
        parse_g2o_line(line)
        convert_line(line)


def _g2o_file(data: bytes) -> None:
    source = PoseGraphSource(write("graph.g2o", data))
    for _ in source.events():
        pass
    for _ in source.measurement_lines:
        pass
    source.faults.warnings()


def _edge_line(data: bytes) -> None:
    line = data.decode(errors="replace")
    if line.strip():
        parse_line(line)


def _smoothed_lines(data: bytes) -> None:
    """Smooth lines as `smooth_lines` does, without the pictures at its end."""
    lines = data.decode(errors="replace").split("\n")
    with RunFolder(folder() / "out", columns=POSES_HEADER) as out:
        smoother = Smoother(out, Config(), keyframes="distance")
        try:
            answer_lines(lines, _check_answer, smoother, InputFaults())
        finally:
            smoother.finish()


def _check_answer(answer: str) -> None:
    answer.encode()
    assert "\n" not in answer or answer.startswith('"') or len(answer) <= 20000


def _words(data: bytes) -> None:
    text = data.decode(errors="replace")
    refusals = []
    for parse in (parse_truth, parse_bag_truth, parse_sigma, parse_initial_pose):
        try:
            parse(text)
        except GvoError as error:
            refusals.append(error)
    if len(refusals) == 4:
        raise refusals[0]


def _lines_of(*texts: bytes) -> list[bytes]:
    return [line for text in texts for line in text.splitlines()]


_P = b"P%d: 8 0 4 %s 0 8 3 0 0 0 1 0\n"
_FILES = {
    "kitti": {
        "calib.txt": _P % (0, b"0") + _P % (1, b"-4"),
        "times.txt": b"0.000000e+00\n1.000000e-01\n",
        "poses.txt": _KITTI,
    },
    "tum": {
        "rgb.txt": b"# colour\n1.5 rgb/1.png\n1.6 rgb/2.png\n",
        "depth.txt": b"1.5 depth/1.png\n",
        "calibration.yaml": CALIBRATION,
        "groundtruth.txt": _TUM,
    },
    "euroc": {
        "cam0/sensor.yaml": SENSOR % b"0",
        "cam1/sensor.yaml": SENSOR % b"0.1",
        "cam0/data.csv": b"#timestamp [ns],filename\n1,1.png\n2,2.png\n",
        "cam1/data.csv": b"1,1.png\n",
        "state_groundtruth_estimate0/data.csv": _EUROC,
    },
}
_RUN = {
    "frames.csv": b"stamp_ns,status,n_inliers,reason\n1500000000,ok,40,\n1600000000,lost,0,dark\n",
    "edges.csv": b"stamp_ns,reference_ns,kind,is_accepted,chi2\n1600000000,1500000000,step,1,2.5\n",
    "timings.csv": b"stamp_ns,read_ms,window_ms\n1500000000,1.5,\n",
    "raw.txt": b"1.500000000 0 0 0 0 0 0 1\n1.600000000 1 0 0 0 0 0 1\n",
    "raw_covariance.csv": f"{COVARIANCE_HEADER}\n1500000000,".encode() + _UPPER.replace(b" ", b","),
    "causal.txt": b"1.500000000 0 0 0 0 0 0 1\n",
    "smoothed.txt": b"",
    "ground_truth.txt": b"1.5 0 0 0 0 0 0 1\n",
    "summary.json": b"""{"recording": "x", "ground_truth_stamps_from": "file",
        "T_base_truth": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]}""",
}
_FILES["run"] = _RUN
_PLACES = [(kind, name) for kind, files in _FILES.items() for name in files]


@cache
def _write_folders() -> None:
    """Write a small whole folder of each kind; one of its files is replaced at a time."""
    picture = cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()
    depth = cv2.imencode(".png", np.full((6, 8), 5000, np.uint16))[1].tobytes()
    for kind, name in _PLACES:
        write(f"{kind}/{name}", _FILES[kind][name])
    for name in ("kitti/image_{}/000000.png", "euroc/cam{}/data/1.png"):
        for side in (0, 1):
            write(name.format(side), picture)
    write("tum/rgb/1.png", picture)
    write("tum/depth/1.png", depth)


def _folder(data: bytes) -> None:
    """Replace the file that the first byte chooses, read its folder, then mend it again."""
    _write_folders()
    kind, name = _PLACES[data[0] % len(_PLACES) if data else 0]
    path = write(f"{kind}/{name}", data[1:])
    try:
        if kind == "run":
            record = read_run(folder() / kind)
            record.comparable()
            str(record.name)
            return
        source = open_recording(folder() / kind)
        for image in islice(source.images(), 10):
            with suppress(GvoError):
                image.load()
        source.ground_truth()
    finally:
        path.write_bytes(_FILES[kind][name])


def _configuration(data: bytes) -> None:
    describe_configuration(load_configuration(write("file.yaml", data)))


def _settings(data: bytes) -> None:
    texts = data.decode(errors="surrogateescape").split("\n")
    describe_configuration(load_configuration(None, texts))


def _calibration(data: bytes) -> None:
    path, refusals = write("file.yaml", data), []
    uses: list[tuple[Sensor, bool]] = [("stereo", False), ("stereo", True), ("rgbd", False)]
    for sensor, is_rectified in uses:
        try:
            cameras = read_cameras(
                path, sensor=sensor, is_rectified=is_rectified, image_size=lambda: (48, 32)
            )
        except GvoError as error:
            refusals.append(error)
        else:
            assert all(np.all(np.isfinite(camera.P)) for camera in cameras.calibrations)
    if len(refusals) == len(uses):
        raise refusals[0]


_text = partial(Target, mutate=mutate_text)
_CALIBRATIONS = [
    CALIBRATION,
    SENSOR % b"0",
    _KALIBR,
    _OPENCV,
    _INFO,
    *_SLAM,
    _P % (0, b"0") + _P % (1, b"-4"),
]
_CONFIGURATIONS = [b"images:\n  black: 3\nwindow: {size: 4}\n"]
_WORDS = [b"tf:odom:base", b"/odom", b"topic:odom", b"0.1,0.02", b"1,2,3,0,0,0,1"]
_SETTINGS = [b"window.n_links=3", b"klt.n_corners=300\nsync.stamps=recording"]

TARGETS = (
    _text(name="poses", run=_poses, seeds=lambda: [_TUM, _KITTI, _EUROC, _STATE]),
    _text(name="covariances", run=_covariances, seeds=lambda: [_RUN["raw_covariance.csv"] + b"\n"]),
    _text(
        name="g2o_lines", run=_g2o_line, seeds=lambda: _lines_of(_GRAPH), documented=(ValueError,)
    ),
    _text(name="g2o_files", run=_g2o_file, seeds=lambda: [_GRAPH]),
    _text(
        name="edge_lines",
        run=_edge_line,
        seeds=lambda: _lines_of(_JSON),
        documented=(ValueError,),
    ),
    _text(name="smoothed_lines", run=_smoothed_lines, seeds=lambda: [_JSON], is_slow=True),
    _text(name="words", run=_words, seeds=lambda: _WORDS),
    _text(name="settings", run=_settings, seeds=lambda: _SETTINGS),
    _text(name="configurations", run=_configuration, seeds=lambda: _CONFIGURATIONS, is_slow=True),
    _text(name="calibrations", run=_calibration, seeds=lambda: _CALIBRATIONS),
    Target(
        name="folders",
        run=_folder,
        seeds=lambda: [bytes([n]) + _FILES[kind][name] for n, (kind, name) in enumerate(_PLACES)],
        mutate=mutate_behind_first,
        is_slow=True,
    ),
)
