"""The scripts run as programs, as a reader would copy them."""

import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import gvo
from gvo.geometry import se3
from tests.acceptance.conftest import SCRIPTS, Script
from tests.conftest import ENVIRONMENT, GVO, python
from tests.live.pipe import write_calibration

pytestmark = pytest.mark.acceptance

Output = Callable[..., list[str]]


@pytest.fixture
def output(script: Script) -> Output:
    """Return a function that runs a script and gives the lines that it prints."""

    def run(name: str, *arguments: object) -> list[str]:
        answer = script(name, *arguments)
        assert answer.code == 0, answer.err
        return answer.out.splitlines()

    return run


def test_a_bag_is_rendered(output: Output, tmp_path: Path) -> None:
    options = ["--world", "handheld", "--sensor", "rgbd", "--frames", 4]
    output("make_demo_bag", tmp_path / "room.bag", *options)
    assert gvo.open_recording(tmp_path / "room.bag").info.n_images == 4


def test_edges_of_a_table_are_smoothed(output: Output, tmp_path: Path) -> None:
    row = "0,0,{},0,0,0,1,0.01,0.1"
    rows = [f"b,100000000,a,{row.format(1)}", f"c,200000000,b,{row.format(1)}"]
    rows.append(f"c,200000000,a,{row.format(2.1)}")
    path = tmp_path / "edges.csv"
    path.write_text("\n".join(rows) + "\n")
    smoothed = output("smooth_edges", path)
    lines = [line for line in smoothed if line.startswith("smoothed")]
    assert [line.split()[1] for line in lines] == ["a", "b", "c"]
    # two thirds of the disagreement of 0.1 m go to the chain, which is twice as unsure
    assert "2.0667" in lines[-1]


def write_poses(path: Path, *, scale: float = 1.0) -> Path:
    turn = [np.array([0.0, 0.02, 0.0, 0.0, 0.0, scale])] * 60
    T = [np.eye(4)]
    for twist in turn:
        T.append(T[-1] @ se3.exp(twist))
    path.write_text("".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in T))
    return path


def test_a_pose_stream_is_smoothed_with_loops(output: Output, tmp_path: Path) -> None:
    drifting = write_poses(tmp_path / "drifting.txt", scale=1.02)
    true = write_poses(tmp_path / "true.txt")
    alone = output("smooth_pose_stream", drifting)
    assert "61 poses; the last one is 0.00 m from the odometry's" in " ".join(alone)
    tied = output("smooth_pose_stream", drifting, "--loops", true)
    moved = float(tied[-1].split("last one is ")[1].split(" m")[0])
    assert moved > 0.3


def test_opencvs_odometry_drives_the_window_or_is_said_to_be_missing(
    script: Script, room_bag: Path
) -> None:
    answer = script("odometry_of_opencv", room_bag)
    if not hasattr(cv2, "Odometry"):
        assert answer.code == 2
        assert "has no cv2.Odometry" in answer.err
        return
    assert answer.code == 0, answer.err
    errors = [float(line.split("ATE ")[1].split()[0]) for line in answer.out.splitlines()]
    assert len(errors) == 3
    assert max(errors) < 0.02


def ate_of(poses: Path, source: gvo.SyntheticRecording) -> float:
    """Return the error of all poses but those stamped otherwise than the recording, in metres."""
    truth, estimate = source.ground_truth(), gvo.read_trajectory(poses)
    stamps_ns = estimate.stamps_ns + truth.stamps_ns[0]
    return gvo.evaluate(truth, replace(estimate, stamps_ns=stamps_ns), name=poses.name).ate_m


def test_an_rgbd_camera_of_ones_own_is_tracked_without_a_dropped_frame(
    output: Output, tmp_path: Path
) -> None:
    source = gvo.SyntheticRecording("handheld", "rgbd", n_frames=10, scale=0.5)
    for n, frame in enumerate(gvo.frames(source)):
        assert isinstance(frame, gvo.RgbdFrame)
        counts = np.nan_to_num(np.rint(1000.0 * frame.depth)).astype(np.uint16)
        for kind, pixels in (("color", frame.image), ("depth", counts)):
            path = tmp_path / kind / f"{n:03}.png"
            path.parent.mkdir(exist_ok=True)
            assert n == 4 or cv2.imwrite(str(path), pixels)
    camera, stamps_ns = source.info.camera, source.ground_truth().stamps_ns
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    options = ["--intrinsics", *numbers, "--rate", 1e9 / np.diff(stamps_ns)[0]]
    lines = output("own_rgbd_camera", tmp_path, *options, "--out", tmp_path / "poses.txt")
    assert lines[-1].endswith("9 poses")
    assert ate_of(tmp_path / "poses.txt", source) < 0.01


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("own_rgbd_camera", "missing --intrinsics 1 1 1 1"),
        ("smooth_edges", "missing.csv"),
        ("smooth_pose_stream", "missing.txt"),
        ("odometry_of_opencv", "missing"),
        ("feed_recording", "missing.bag"),
        ("make_demo_bag", "x.bag --frames 0"),
        ("make_pictures", "--frame 0"),
    ],
)
def test_bad_input_is_told_in_one_line(script: Script, name: str, arguments: str) -> None:
    answer = script(name, *arguments.split())
    assert answer.code == 2
    assert "error" in answer.err.splitlines()[-1]
    assert "Traceback" not in answer.err


def test_a_recording_is_fed_to_a_live_run(drive_bag: Path, tmp_path: Path) -> None:
    calibrations = write_calibration(gvo.open_recording(drive_bag).info, tmp_path)
    feeder = [sys.executable, *map(str, (SCRIPTS / "feed_recording.py", drive_bag, "--rate=0"))]
    given = [f"--calibration={path}" for path in calibrations]
    options = ["--rectified", "--no-report", "--queue=1000", f"--out={tmp_path / 'out'}", *given]
    with subprocess.Popen(feeder, stdout=subprocess.PIPE, env=ENVIRONMENT) as sending:
        live = [*GVO[1:], "live", "-", *options]
        answer = python(*live, stdin=sending.stdout)
    assert answer.returncode == 0, answer.stderr
    assert "20 frames, all tracked" in answer.stdout
    # Who reads may end first.
    cut = f"{shlex.join(feeder)} | head -c 1000 > /dev/null; exit ${{PIPESTATUS[0]}}"
    ended = subprocess.run(["bash", "-c", cut], env=ENVIRONMENT, stderr=subprocess.PIPE, check=True)
    assert ended.stderr == b""
