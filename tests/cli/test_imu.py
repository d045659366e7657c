"""Recordings with an IMU on the command line."""

import json
from pathlib import Path

import pytest

import gvo
from gvo.io.synthetic.imu import rendered_imu
from tests.conftest import Command, assert_same_files, refused

_QUICK = ("--no-report", "--duration", "0.3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an EuRoC folder with an IMU."""
    path = tmp_path_factory.mktemp("imu") / "room"
    source = gvo.SyntheticRecording(
        "handheld", "stereo", n_frames=12, scale=0.25, imu=rendered_imu()
    )
    gvo.convert(source, path, layout="euroc")
    return path


def test_the_imu_is_named_and_changes_no_pose_where_nothing_is_lost(
    command: Command, folder: Path, tmp_path: Path
) -> None:
    assert command("convert", folder, tmp_path / "a.mcap").code == 0
    lines = {
        folder: "imu: imu0; placed by the calibration, its delay is 0 ms",
        tmp_path / "a.mcap": "imu: /imu (",
    }
    for n, (recording, line) in enumerate(lines.items()):
        with_imu, without = tmp_path / f"with{n}", tmp_path / f"without{n}"
        answer = command("run", recording, "--out", with_imu, *_QUICK)
        assert answer.code == 0, answer.err
        assert line in answer.out
        answer = command("run", recording, "--out", without, *_QUICK, "--imu", "none")
        assert answer.code == 0, answer.err
        assert "imu: " not in answer.out
        names = [f"{name}.txt" for name in ("raw", "causal", "smoothed")]
        assert_same_files(with_imu, without, names)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "a.mcap", "--imu", "/gyro"], r"a.mcap: has no IMU topic /gyro; it has /imu ("),
        (["check", "a.mcap", "--imu", "/gyro"], "it has /imu (sensor_msgs/msg/Imu, "),
        (["run", "{folder}", "--imu", "/imu"], "--imu chooses a topic of a bag"),
        (["live", "-", "--imu", "/imu"], "-: --imu chooses a topic of a bag or of ROS"),
        (["run", "a.mcap", "--calibration", "imu.yaml"], "gyroscope_noise_density must hold"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(
    command: Command, here: Path, folder: Path, arguments: list[str], expected: str
) -> None:
    gvo.convert(gvo.open_recording(folder), here / "a.mcap")
    (here / "imu.yaml").write_text("gyroscope_noise_density: none\n")
    assert expected in refused(command(*(each.format(folder=folder) for each in arguments)))


def test_a_table_that_is_damaged_far_behind_ends_the_imu_alone(
    command: Command, folder: Path, tmp_path: Path
) -> None:
    gvo.convert(gvo.open_recording(folder), tmp_path / "a.bag")
    gvo.convert(gvo.open_recording(tmp_path / "a.bag"), tmp_path / "long", layout="euroc")
    table = tmp_path / "long" / "mav0" / "imu0" / "data.csv"
    header, *rows = table.read_text().splitlines()
    first_ns = int(rows[0].split(",")[0])
    rows = [f"{first_ns + k * 1_000_000},0,0,0,0,9.81,0" for k in range(600)]
    table.write_text("\n".join([header, *rows, "oh"]) + "\n")
    answer = command("run", tmp_path / "long", "--out", tmp_path / "out", "--no-report")
    assert answer.code == 3
    assert "data.csv, line 602: expected a stamp" in answer.err
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["frames"] == 12


def test_a_conversion_leaves_the_imu_out_if_asked(
    command: Command, folder: Path, tmp_path: Path
) -> None:
    assert command("convert", folder, tmp_path / "a.bag", "--imu", "none").code == 0
    assert gvo.open_recording(tmp_path / "a.bag").info.imu is None
    answer = command("convert", folder, tmp_path / "b.bag")
    assert (answer.code, answer.err) == (0, "")
    assert gvo.open_recording(tmp_path / "b.bag").info.imu is not None
