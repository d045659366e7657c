"""Recordings written as data-set folders, by way of a bag, and read back."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.config import Config
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry.camera import Calibration, rectification_maps
from gvo.geometry.se3 import make_transform
from gvo.io.bag.source import BagSource
from gvo.io.convert.convert import Conversion, Layout, convert
from gvo.io.frames import frames
from gvo.io.opening import open_recording
from gvo.io.recording import DepthView, Source
from gvo.trajectory.formats import read_trajectory, write_euroc, write_tum
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame, FloatArray, RgbdFrame
from tests.io.conftest import Tiny
from tests.make.recordings import Held, Item

_STEP_NS = 50_000_000
_START_NS = 1_403_636_579_763_555_584
_LENSES = {
    "radial-tangential": ([-0.28, 0.07, 2e-4, 1.8e-5], "plumb_bob"),
    "rational_polynomial": ([0.4, 0.1, 1e-4, -2e-4, 0.01, 0.7, 0.2, 0.02], "rational_polynomial"),
    "equidistant": ([-0.01, 0.02, -0.005, 0.001], "equidistant"),
}


def write_folder(source: Source, path: Path, **options: Any) -> Conversion:
    """Write a folder in the layout that fits best, also of what is no bag."""
    if not isinstance(source, BagSource):
        options = {"layout": "tum" if source.info.sensor == "rgbd" else "kitti"} | options
    return convert(source, path, **options)


def _truth(n: int, *, start_ns: int = _START_NS, step_ns: int = _STEP_NS) -> Trajectory:
    rng = np.random.default_rng(5)
    R = np.asarray(Rotation.from_rotvec(rng.normal(0, 1, (n, 3))).as_matrix())
    stamps_ns = start_ns + step_ns * np.arange(n, dtype=np.int64)
    return Trajectory(
        stamps_ns=stamps_ns, T_world_frame=make_transform(R, rng.normal(0, 5, (n, 3)))
    )


def _pairs(tiny: Tiny, n: int = 3, *, is_color: bool = False) -> list[Item]:
    return [
        (stream, _START_NS + k * _STEP_NS, tiny.texture(2 * k + stream, is_color=is_color))
        for k in range(n)
        for stream in (0, 1)
    ]


def _rgbd_items(tiny: Tiny, n: int = 3) -> list[Item]:
    items: list[Item] = []
    for k in range(n):
        stamp_ns = _START_NS + k * _STEP_NS
        items.append((0, stamp_ns, tiny.texture(k, is_color=True)))
        items.append((1, stamp_ns + 4_000_001, tiny.depth(k)))
    return items


def _write_euroc(tiny: Tiny, folder: Path, model: str) -> Path:
    """Write a raw pair on a body: each camera turned and distorted by its own numbers."""
    rng = np.random.default_rng(3)
    T_body_left = make_transform(
        np.asarray(Rotation.from_euler("xyz", [80, -10, 95], degrees=True).as_matrix()),
        np.array([-0.02, -0.06, 0.01]),
    )
    turn = np.asarray(Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix())
    T_left_right = make_transform(turn, np.array([0.11, 0.001, -0.002]))
    D, _ = _LENSES[model]
    sensors = [
        tiny.euroc_camera(
            T_body_cam,
            intrinsics=[30.1 + camera, 30.3, 23.7, 15.9 - camera],
            distortion_model=model,
            distortion_coefficients=(np.array(D) * rng.uniform(0.9, 1.1, len(D))).tolist(),
        )
        for camera, T_body_cam in enumerate((T_body_left, T_body_left @ T_left_right))
    ]
    tiny.write_euroc(folder, [_START_NS + k * _STEP_NS for k in range(3)], sensors)
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    write_euroc(truth, _truth(20, step_ns=10**7))
    return folder


def _assert_same_images(copy: Source, source: Source) -> None:
    for mine, theirs in zip(copy.images(), source.images(), strict=True):
        assert (mine.stream, mine.stamp_ns) == (theirs.stream, theirs.stamp_ns)
        np.testing.assert_array_equal(mine.load(), theirs.load())


def _T_body_cam(source: Source) -> FloatArray:  # noqa: N802 - the field's name
    assert source.info.T_body_cam is not None
    return source.info.T_body_cam


def _assert_same_truth(copy: Source, source: Source, *, atol: float) -> None:
    mine, theirs = copy.ground_truth(), source.ground_truth()
    assert mine is not None
    assert theirs is not None
    np.testing.assert_array_equal(mine.stamps_ns, theirs.stamps_ns)
    np.testing.assert_allclose(mine.T_world_frame, theirs.T_world_frame, rtol=0, atol=atol)


@pytest.mark.parametrize("cameras", [(0, 1), (2, 3)], ids=["grey", "colour"])
def test_kitti_comes_back_from_a_bag(tiny: Tiny, tmp_path: Path, cameras: tuple[int, int]) -> None:
    origin = tiny.write_kitti(tmp_path / "origin", n_frames=4, cameras=cameras)
    convert(open_recording(origin), tmp_path / "a.bag")
    written = write_folder(open_recording(tmp_path / "a.bag"), tmp_path / "copy")
    source, copy = open_recording(origin), open_recording(tmp_path / "copy")
    assert (written.n_images, written.n_poses, written.skipped) == (8, 4, ())
    _assert_same_images(copy, source)
    _assert_same_truth(copy, source, atol=1e-12)
    for mine, theirs in zip(copy.info.calibrations, source.info.calibrations, strict=True):
        np.testing.assert_array_equal(mine.P, theirs.P)
    # Of colour, too, the file holds the poses of the first grey camera.
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "copy" / "poses.txt").T_world_frame,
        read_trajectory(origin / "poses.txt").T_world_frame,
        rtol=0,
        atol=1e-12,
    )
    assert (tmp_path / "copy" / f"image_{cameras[0]}" / "000003.png").is_file()


@pytest.mark.parametrize("model", sorted(_LENSES))
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_euroc_comes_back_from_a_bag(tiny: Tiny, tmp_path: Path, model: str, name: str) -> None:
    source = open_recording(_write_euroc(tiny, tmp_path / "origin", model))
    convert(source, tmp_path / name)
    write_folder(open_recording(tmp_path / name), tmp_path / "copy")
    copy = open_recording(tmp_path / "copy")
    assert source.info.calibrations[0].model == _LENSES[model][1]
    _assert_same_images(copy, source)
    _assert_same_truth(copy, source, atol=1e-9)
    for mine, theirs in zip(copy.info.calibrations, source.info.calibrations, strict=True):
        assert mine.model == theirs.model
        np.testing.assert_array_equal(mine.K, theirs.K)
        np.testing.assert_array_equal(mine.D, theirs.D)
        my_maps, their_maps = rectification_maps(mine), rectification_maps(theirs)
        assert my_maps is not None
        assert their_maps is not None
        np.testing.assert_allclose(my_maps, their_maps, rtol=0, atol=1e-9)
    np.testing.assert_allclose(_T_body_cam(copy), _T_body_cam(source), rtol=0, atol=1e-9)
    for sensor in ("cam0", "cam1"):
        mine_T, their_T = (
            yaml.safe_load((tmp_path / folder / "mav0" / sensor / "sensor.yaml").read_text())
            for folder in ("copy", "origin")
        )
        np.testing.assert_allclose(mine_T["T_BS"]["data"], their_T["T_BS"]["data"], atol=1e-9)


def test_tum_comes_back_from_a_bag_as_it_was(tiny: Tiny, tmp_path: Path) -> None:
    stamps = [f"1305031102.{n}75304" for n in range(3)]
    depths = [f"1305031102.{n}60407" for n in range(3)]
    origin = tiny.write_tum(tmp_path / "origin", stamps, depths)
    write_tum(origin / "groundtruth.txt", _truth(4))
    camera = tiny.ros_camera(
        distortion_coefficients={"rows": 1, "cols": 5, "data": [0.26, -0.95, -0.005, 0.0026, 1.16]}
    )
    (origin / "calibration.yaml").write_text(yaml.safe_dump(camera))
    convert(open_recording(origin), tmp_path / "a.mcap")
    written = write_folder(open_recording(tmp_path / "a.mcap"), tmp_path / "copy")
    source, copy = open_recording(origin), open_recording(tmp_path / "copy")
    assert (written.n_images, written.n_poses, written.skipped) == (6, 4, ())
    _assert_same_images(copy, source)
    _assert_same_truth(copy, source, atol=1e-9)
    for name in "KDRP":
        np.testing.assert_array_equal(
            getattr(copy.info.calibrations[0], name), getattr(source.info.calibrations[0], name)
        )
    for number, stamp in enumerate(depths):
        path = tmp_path / "copy" / "depth" / f"{stamp}000.png"
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        expected = tiny.counts(number)
        expected[expected == 65535] = 0
        np.testing.assert_array_equal(counts, expected)
    assert (
        yaml.safe_load((tmp_path / "copy" / "calibration.yaml").read_text())["depth_scale"] == 5e3
    )


@settings(max_examples=6)
@given(seed=st.integers(0, 1000), is_first_empty=st.booleans())
def test_millimetres_stay_millimetres(
    tiny: Tiny, tmp_path_factory: pytest.TempPathFactory, seed: int, is_first_empty: bool
) -> None:
    counts = np.random.default_rng(seed).integers(1, 65535, (32, 48)).astype(np.float32)
    items: list[Item] = [(0, _START_NS, tiny.texture(1)), (1, _START_NS, counts / 1000)]
    if is_first_empty:
        items = [(1, _START_NS - 10, np.full((32, 48), np.nan, np.float32)), *items]
    path = tmp_path_factory.mktemp("tum") / "a"
    assert write_folder(tiny.rgbd(items), path).skipped == ()
    *_, last = (image.load() for image in open_recording(path).images() if image.stream == 1)
    np.testing.assert_array_equal(last, counts / np.float32(1000))


def test_depth_that_no_count_holds_becomes_unknown_and_told(tiny: Tiny, tmp_path: Path) -> None:
    depth = tiny.depth(0)
    depth[4, :3] = 70.0
    items: list[Item] = [(0, 5, tiny.texture(0)), (1, 5, tiny.depth(1)), (1, 6, depth)]
    written = write_folder(tiny.rgbd(items), tmp_path / "a")
    assert written.skipped == ("depth: 3 pixels beyond 13.1 m became unknown",)


def _with_depth_view(tiny: Tiny, *, is_raw: bool) -> Held:
    """Return a recording whose depth comes from a smaller camera beside the colour camera."""
    color = Calibration.from_camera(tiny.camera)
    if is_raw:
        color = replace(color, D=np.array([0.05, -0.02, 0.0, 0.0, 0.0]), is_rectified=False)
    small = replace(tiny.camera, width=40, height=28, fx=42.0, fy=42.0, cx=19.5, cy=13.5)
    T = make_transform(np.eye(3), np.array([0.03, 0.0, 0.0]))
    items: list[Item] = []
    for k in range(2):
        items.append((0, _START_NS + k, tiny.texture(k, is_color=True)))
        items.append((1, _START_NS + k, tiny.depth(k)[:28, :40]))
    source = tiny.rgbd(items, calibrations=(color,))
    view = DepthView(calibration=Calibration.from_camera(small), T_color_depth=T)
    source.info = replace(source.info, depth_view=view)
    return source


@pytest.mark.parametrize("is_raw", [True, False])
@pytest.mark.parametrize("target", ["a.mcap", "tum"])
def test_depth_of_another_camera_is_registered_on_writing(
    tiny: Tiny, tmp_path: Path, is_raw: bool, target: str
) -> None:
    source = _with_depth_view(tiny, is_raw=is_raw)
    write: Any = write_folder if target == "tum" else convert
    write(source, tmp_path / target)
    copy = open_recording(tmp_path / target)
    assert copy.info.depth_view is None
    for mine, theirs in zip(frames(copy, Config()), frames(source, Config()), strict=True):
        assert isinstance(mine, RgbdFrame)
        assert isinstance(theirs, RgbdFrame)
        np.testing.assert_array_equal(mine.image, theirs.image)
        # TUM's counts are 0.2 mm
        np.testing.assert_allclose(mine.depth, theirs.depth, atol=1.01e-4)
        assert np.isfinite(mine.depth).any()
    colors = [image.load().ndim for image in copy.images() if image.stream == 0]
    assert colors == ([2, 2] if is_raw else [3, 3])


_LAYOUTS: Sequence[Layout] = ("kitti", "euroc", "tum")


def _source_for(tiny: Tiny, layout: str, truth: Trajectory | None = None) -> Held:
    if layout == "tum":
        return tiny.rgbd(_rgbd_items(tiny), truth=truth)
    return tiny.stereo(_pairs(tiny), truth=truth)


@pytest.mark.parametrize("target", [*_LAYOUTS, "a.bag"])
def test_positions_without_rotations_are_told(tiny: Tiny, tmp_path: Path, target: str) -> None:
    truth = _truth(3)
    positions = Trajectory.of_positions(truth.stamps_ns, truth.positions)
    source = _source_for(tiny, target, positions)
    path = tmp_path / target
    written = convert(source, path) if target == "a.bag" else write_folder(source, path)
    assert written.n_poses == 0
    assert written.n_images == 6
    assert written.skipped == (
        "ground truth: 3 positions without rotations are no poses of the camera",
    )
    assert open_recording(path).ground_truth() is None


@pytest.mark.parametrize("target", [*_LAYOUTS, "a.bag", "a.mcap"])
def test_what_precedes_damage_is_kept_and_told(tiny: Tiny, tmp_path: Path, target: str) -> None:
    whole = _source_for(tiny, target, _truth(3))
    source = replace(whole, damage="a.bag: 40 % are missing at its end")
    path = tmp_path / target
    is_bag = target.startswith("a.")
    written = convert(source, path) if is_bag else write_folder(source, path)
    assert written.skipped == ("a.bag: 40 % are missing at its end",)
    assert (written.n_images, written.n_poses) == (6, 3)
    _assert_same_images(open_recording(path), whole)
    _assert_same_truth(open_recording(path), whole, atol=1e-9)


@pytest.mark.parametrize("target", ["kitti", "euroc", "a.bag"])
def test_without_an_image_nothing_is_left_behind(tiny: Tiny, tmp_path: Path, target: str) -> None:
    fault = RecordingError("a.png: empty")
    items: list[Item] = [(0, 1, tiny.texture(1)), (1, 1, fault), (0, 2, tiny.texture(2))]
    source = tiny.stereo([*items, (1, 2, fault)])
    path = tmp_path / target
    with pytest.raises(RecordingError, match=r"list: no right image can be written: .*empty"):
        convert(source, path) if target == "a.bag" else write_folder(source, path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("layout", ["euroc", "tum"])
def test_images_that_do_not_advance_are_out(tiny: Tiny, tmp_path: Path, layout: Layout) -> None:
    source = _source_for(tiny, layout)
    stamp_ns = _START_NS + _STEP_NS
    source.items.append(replace(source.items[0], stamp_ns=stamp_ns))
    written = write_folder(source, tmp_path / "a", layout=layout)
    (line,) = written.skipped
    assert f"images were left out; the first: at {stamp_ns} ns: the stamp does not advance" in line
    assert written.n_images == 6
    assert not any(
        isinstance(f, FaultyFrame) for f in frames(open_recording(tmp_path / "a"), Config())
    )


def test_poses_of_kitti_are_written_for_all_pairs_or_none(tiny: Tiny, tmp_path: Path) -> None:
    written = write_folder(tiny.stereo(_pairs(tiny), truth=_truth(2)), tmp_path / "a")
    assert written.skipped == ("poses.txt: 2 of 3 pairs lie between true poses, all are needed",)
    assert not (tmp_path / "a" / "poses.txt").exists()


def test_an_unreadable_image_of_kitti_leaves_its_number_free(tiny: Tiny, tmp_path: Path) -> None:
    items = _pairs(tiny)
    items[2] = (0, items[2][1], RecordingError("damaged"))
    assert write_folder(tiny.stereo(items), tmp_path / "a").n_images == 5
    names = sorted(path.name for path in (tmp_path / "a" / "image_0").iterdir())
    assert names == ["000000.png", "000002.png"]
    assert [i.stamp_ns for i in open_recording(tmp_path / "a").images() if i.stream == 0] == [
        items[0][1],
        items[4][1],
    ]


@pytest.mark.parametrize("target", ["euroc", "a.bag"])
def test_unreadable_truth_does_not_cost_the_images(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    def fail() -> None:
        raise TrajectoryError("data.csv:7: expected 8 numbers")

    source, path = tiny.stereo(_pairs(tiny)), tmp_path / target
    monkeypatch.setattr(source, "ground_truth", fail)
    written = convert(source, path) if target == "a.bag" else write_folder(source, path)
    assert "ground truth: data.csv:7: expected 8 numbers" in written.skipped
    assert (written.n_images, written.n_poses) == (6, 0)
