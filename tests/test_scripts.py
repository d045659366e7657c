"""The scripts run as programs, as a reader would copy them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gvo

SCRIPTS = Path(__file__).parent.parent / "scripts"
# The scripts import the same package as the tests do.
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(gvo.__file__).parent.parent)}


def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPTS / f"{name}.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )


def test_run_and_compare_a_bag(room_bag: Path, tmp_path: Path) -> None:
    ran = run("run_bag", room_bag, tmp_path, "--set", "window.n_links=2")
    assert ran.returncode == 0, ran.stderr
    assert "smoothed" in ran.stdout
    files = [tmp_path / "raw.txt", tmp_path / "smoothed.txt"]
    compared = run("compare_trajectories", room_bag, *files, "--plot", tmp_path / "plot.png")
    assert compared.returncode == 0, compared.stderr
    assert len(compared.stdout.splitlines()) == 4
    assert (tmp_path / "plot.png").exists()


def test_a_rendered_bag_can_be_run(tmp_path: Path) -> None:
    options = ["--world", "handheld", "--sensor", "rgbd", "--frames", 3]
    made = run("make_demo_bag", tmp_path / "room.bag", *options)
    assert made.returncode == 0, made.stderr
    source = gvo.open_recording(tmp_path / "room.bag")
    assert source.info.n_images == 3
    assert source.ground_truth() is not None


def test_the_benchmark_prints_errors_stages_and_the_yardstick(drive_bag: Path) -> None:
    measured = run("benchmark", drive_bag)
    assert measured.returncode == 0, measured.stderr
    words = ("raw", "smoothed", "read", "extract", "register", "links", "window", "total")
    for word in (*words, "CPU", "yardstick"):
        assert word in measured.stdout


@pytest.mark.recorded
def test_a_data_set_folder_becomes_a_bag(gvo_data: Path, tmp_path: Path) -> None:
    converted = run("convert_dataset", gvo_data / "euroc_mh01_start", tmp_path / "e.mcap")
    assert converted.returncode == 0, converted.stderr
    assert gvo.open_recording(tmp_path / "e.mcap").info.n_images == 50


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("run_bag", ["missing.bag", "out"]),
        ("compare_trajectories", ["missing.txt", "missing.txt"]),
        ("convert_dataset", ["missing", "out.bag"]),
        ("benchmark", ["missing.bag"]),
        ("make_demo_bag", ["missing/folder/that/is.a.txt"]),
        ("make_demo_bag", ["x.bag", "--frames", "0"]),
    ],
)
def test_bad_input_is_told_without_a_traceback(name: str, arguments: list[str]) -> None:
    answer = run(name, *arguments)
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr
    assert "error" in answer.stderr
