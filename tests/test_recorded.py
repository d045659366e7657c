"""Limits on the error of the recorded starts, and the same bytes from every container."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gvo

Command = Callable[..., Any]
KITTI = "kitti_06_start"
XYZ = "rgbd_dataset_freiburg1_xyz_start"
ROOM = "sevenscenes_start"
EUROC = "euroc_mh01_start"

pytestmark = [pytest.mark.recorded, pytest.mark.slow]


@pytest.fixture
def errors(command: Command, gvo_data: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Return a function that runs a recording and compares raw and smoothed with the truth."""

    def measure(name: str, *settings: str) -> dict[str, Any]:
        options = [part for setting in settings for part in ("--set", setting)]
        ran = command("run", gvo_data / name, "--out", tmp_path, *options)
        assert ran.code == 0, ran.err
        assert json.loads((tmp_path / "summary.json").read_text())["coverage"] == 1.0
        files = [tmp_path / "raw.txt", tmp_path / "smoothed.txt"]
        compared = command("compare", gvo_data / name, *files, "--json")
        estimates = json.loads(compared.out)["estimates"]
        return {entry["name"]: entry for entry in estimates}

    return measure


def test_kitti_drifts_by_at_most_1_2_percent(errors: Callable[..., dict[str, Any]]) -> None:
    measured = errors(KITTI)
    assert measured["raw"]["n"] == measured["smoothed"]["n"] == 51
    assert measured["raw"]["t_pct"] <= 1.2
    assert measured["smoothed"]["t_pct"] <= 1.2


@pytest.mark.parametrize("metric", ["reprojection", "distance"])
def test_plain_umeyama_drifts_by_at_most_2_percent(
    errors: Callable[..., dict[str, Any]], metric: str
) -> None:
    measured = errors(
        KITTI,
        "registration.refine=none",
        "registration.weighting=none",
        f"ransac.inlier_metric={metric}",
    )
    assert measured["raw"]["t_pct"] <= 2.0
    assert measured["smoothed"]["t_pct"] <= 2.0


def test_freiburg1_xyz_is_within_10_5_mm(errors: Callable[..., dict[str, Any]]) -> None:
    assert errors(XYZ)["smoothed"]["ate_m"] <= 0.0105


def test_smoothing_pays_on_a_camera_that_looks_back(
    errors: Callable[..., dict[str, Any]],
) -> None:
    measured = errors(ROOM, "depth.scale=1000")
    assert measured["smoothed"]["ate_m"] <= 0.024
    assert measured["smoothed"]["ate_m"] < measured["raw"]["ate_m"]


def test_mh01_is_within_5_mm(errors: Callable[..., dict[str, Any]]) -> None:
    assert errors(EUROC)["smoothed"]["ate_m"] <= 0.005


@pytest.mark.parametrize("name", [KITTI, XYZ, EUROC])
def test_folder_and_bags_give_the_same_bytes(
    command: Command, gvo_data: Path, tmp_path: Path, name: str
) -> None:
    recordings = {"folder": gvo_data / name}
    for suffix in (".bag", ".mcap", ""):
        recordings[suffix] = tmp_path / f"recording{suffix}"
        assert command("convert", gvo_data / name, recordings[suffix]).code == 0
    for kind, recording in recordings.items():
        answer = command("run", recording, "--out", tmp_path / f"out_{kind}")
        assert answer.code == 0, answer.err
    for kind in recordings:
        for path in (tmp_path / "out_folder").glob("*.[tc][xs][tv]"):
            other = tmp_path / f"out_{kind}" / path.name
            assert path.read_bytes() == other.read_bytes(), (kind, path.name)


@pytest.mark.parametrize(
    ("name", "t_pct", "r_deg_per_100m", "ate_m"),
    [("KITTI_00_ORB", 0.700, 0.253, 1.303), ("KITTI_00_SPTAM", 1.487, 0.558, 3.74)],
)
def test_published_trajectories_have_their_published_errors(
    command: Command,
    gvo_data: Path,
    *,
    name: str,
    t_pct: float,
    r_deg_per_100m: float,
    ate_m: float,
) -> None:
    folder = gvo_data / "trajectories"
    answer = command("compare", folder / "KITTI_00_gt.txt", folder / f"{name}.txt", "--json")
    measured = json.loads(answer.out)["estimates"][0]
    assert measured["t_pct"] == pytest.approx(t_pct, abs=5e-4)
    assert measured["r_deg_per_100m"] == pytest.approx(r_deg_per_100m, abs=5e-4)
    assert measured["ate_m"] == pytest.approx(ate_m, abs=5e-3)


def test_the_real_rgbd_bag_runs_or_is_explained(
    command: Command, gvo_data: Path, tmp_path: Path
) -> None:
    answer = command("run", gvo_data / "bags/good/realsense_rgbd.bag", "--out", tmp_path)
    assert answer.code in (0, 2, 3)
    if answer.code == 2:
        assert answer.err.startswith("gvo: error: ")
        assert answer.err.count("\n") == 1
    else:
        assert len(gvo.read_trajectory(tmp_path / "raw.txt")) >= 1
