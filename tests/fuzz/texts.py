"""Text files and lines: poses, pose graphs, edges, the tables of recordings."""

from functools import cache, partial
from itertools import islice

import cv2
import numpy as np

from gvo.config import Config
from gvo.errors import GvoError
from gvo.io.edges.events import InputFaults
from gvo.io.edges.lines import parse_line
from gvo.io.edges.opening import open_edges, parse_sigma
from gvo.io.edges.pose_graph import PoseGraphSource
from gvo.io.opening import open_recording
from gvo.io.poses.base_frame import parse_initial_pose
from gvo.io.poses.truth import parse_bag_truth, parse_truth
from gvo.io.recording import StampedImage
from gvo.io.run_folder.writer import RunFolder
from gvo.runs.smooth import POSES_HEADER, Smoother
from gvo.runs.smooth import _answer_all as answer_lines
from gvo.trajectory.formats import COVARIANCE_HEADER, read_covariances, read_trajectory
from gvo.trajectory.g2o import convert_line
from gvo.trajectory.g2o import parse_line as parse_g2o_line
from gvo.trajectory.trajectory import Trajectory
from tests.fuzz.mutations import mutate_behind_first, mutate_text
from tests.fuzz.target import Folder, Target

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
SENSOR = b"""sensor_type: camera
T_BS: {data: [1, 0, 0, %s, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
resolution: [8, 6]
camera_model: pinhole
intrinsics: [8.0, 8.0, 4.0, 3.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""


@cache
def _folder() -> Folder:
    return Folder()


def _poses(data: bytes) -> None:
    trajectory = read_trajectory(_folder().write("poses.txt", data))
    _check_finite(trajectory)
    trajectory.transformed(np.eye(4))


def _check_finite(trajectory: Trajectory) -> None:
    if not np.all(np.isfinite(trajectory.T_world_frame)):
        raise AssertionError("poses that are not finite were taken")


def _covariances(data: bytes) -> None:
    read_covariances(_folder().write("covariance.csv", data))


def _g2o_line(data: bytes) -> None:
    for line in data.decode(errors="replace").splitlines():
        parse_g2o_line(line)
        convert_line(line)


def _g2o_file(data: bytes) -> None:
    source = PoseGraphSource(_folder().write("graph.g2o", data))
    for _ in source.events():
        pass
    for _ in source.measurement_lines:
        pass
    source.faults.warnings()


def _edge_files(data: bytes) -> None:
    source = open_edges([_folder().write("edges.txt", data)])
    for _ in islice(source.events(), 1000):
        pass


def _edge_line(data: bytes) -> None:
    line = data.decode(errors="replace")
    if line.strip():
        parse_line(line)


def _smoothed_lines(data: bytes) -> None:
    """Smooth lines as `smooth_lines` does, without the pictures at its end."""
    lines = data.decode(errors="replace").split("\n")
    with RunFolder(_folder().path / "out", columns=POSES_HEADER) as folder:
        smoother = Smoother(folder, Config(), keyframes="distance")
        try:
            answer_lines(lines, _check_answer, smoother, InputFaults())
        finally:
            smoother.finish()


def _check_answer(answer: str) -> None:
    answer.encode()
    if "\n" in answer and not answer.startswith('"') and len(answer) > 20000:
        raise AssertionError(f"an answer of more than a line: {answer[:200]!r}")


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


@cache
def _recordings() -> dict[str, Folder]:
    """Return a small whole folder of each kind; one of its files is replaced at a time."""
    pixels = np.arange(48, dtype=np.uint8).reshape(6, 8)
    picture = cv2.imencode(".png", pixels)[1].tobytes()
    depth = cv2.imencode(".png", np.full((6, 8), 5000, np.uint16))[1].tobytes()
    folders = {kind: Folder() for kind in ("kitti", "tum", "euroc")}
    for kind, files in _FILES.items():
        for name, content in files.items():
            folders[kind].write(name, content)
    for name in ("image_0/000000.png", "image_1/000000.png"):
        folders["kitti"].write(name, picture)
    for name in ("cam0/data/1.png", "cam1/data/1.png"):
        folders["euroc"].write(name, picture)
    folders["tum"].write("rgb/1.png", picture)
    folders["tum"].write("depth/1.png", depth)
    return folders


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
_PLACES = [(kind, name) for kind, files in _FILES.items() for name in files]


def _recording(data: bytes) -> None:
    """Replace the file that the first byte chooses, open the folder, then mend it again."""
    kind, name = _PLACES[data[0] % len(_PLACES) if data else 0]
    folder = _recordings()[kind]
    folder.write(name, data[1:])
    try:
        source = open_recording(folder.path)
        for image in islice(source.images(), 10):
            _load(image)
        source.ground_truth()
    finally:
        folder.write(name, _FILES[kind][name])


def _load(image: StampedImage) -> None:
    try:
        image.load()
    except GvoError:
        return


def _recording_seeds() -> list[bytes]:
    return [bytes([number]) + _FILES[kind][name] for number, (kind, name) in enumerate(_PLACES)]


_text = partial(Target, mutate=mutate_text)

TARGETS = (
    _text(name="poses", run=_poses, seeds=lambda: [_TUM, _KITTI, _EUROC, _STATE]),
    _text(
        name="covariances",
        run=_covariances,
        seeds=lambda: [f"{COVARIANCE_HEADER}\n1,".encode() + _UPPER.replace(b" ", b",") + b"\n"],
    ),
    _text(
        name="g2o_lines", run=_g2o_line, seeds=lambda: _lines_of(_GRAPH), documented=(ValueError,)
    ),
    _text(name="g2o_files", run=_g2o_file, seeds=lambda: [_GRAPH]),
    _text(name="edge_files", run=_edge_files, seeds=lambda: [_GRAPH, _TUM, _KITTI, _EUROC]),
    _text(
        name="edge_lines",
        run=_edge_line,
        seeds=lambda: _lines_of(_JSON),
        documented=(ValueError,),
    ),
    _text(name="smoothed_lines", run=_smoothed_lines, seeds=lambda: [_JSON]),
    _text(
        name="words",
        run=_words,
        seeds=lambda: [b"tf:odom:base", b"/odom", b"topic:odom", b"0.1,0.02", b"1,2,3,0,0,0,1"],
    ),
    Target(name="recordings", run=_recording, seeds=_recording_seeds, mutate=mutate_behind_first),
)
