"""From images to frames; images that repeat."""

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gvo.config import Config, RuntimeConfig, SyncConfig
from gvo.errors import CalibrationError, RecordingError
from gvo.geometry.camera import Calibration, StereoCamera
from gvo.io.frames import Rig, frames, make_preparers, refuse_repeats
from gvo.types import FaultyFrame, Frame, RgbdFrame, StereoFrame

_THREADS = pytest.mark.parametrize("threads", [1, 2, 4])


def _read(source: Any, threads: int = 2, **sync: float) -> list[Any]:
    config = Config(runtime=RuntimeConfig(threads=threads), sync=SyncConfig(**sync))
    return list(frames(source, config))


@_THREADS
def test_colour_becomes_grey_and_depth_stays(tiny: Any, threads: int) -> None:
    color = tiny.texture(1, is_color=True)
    (frame,) = _read(tiny.rgbd([(0, 5, color), (1, 7, tiny.depth(1))]), threads)
    assert isinstance(frame, RgbdFrame)
    weights = np.array([0.114, 0.587, 0.299])  # ITU-R BT.601, in BGR order
    assert np.abs(frame.image - color @ weights).max() <= 1.0
    np.testing.assert_array_equal(frame.depth, tiny.depth(1))
    assert frame.stamp_ns == 5


@_THREADS
def test_each_fault_is_one_faulty_frame_and_the_others_are_read(tiny: Any, threads: int) -> None:
    good, small = tiny.texture(1), tiny.texture(1)[:-1]
    items = [
        (0, 10, good), (1, 10, good),
        (0, 20, RecordingError("a.png: damaged")), (1, 20, good),
        (0, 30, good), (1, 30, small),
        (0, 40, good),
        (0, 50, RecordingError("b")), (1, 50, RecordingError("c")),
        (0, 45, good), (1, 60, tiny.texture(2)), (0, 60, tiny.texture(3)),
        (0, 60, good), (1, 70, tiny.texture(4)), (0, 70, tiny.texture(5)),
    ]  # fmt: skip
    read = _read(tiny.stereo(items), threads)
    faults = [(item.stamp_ns, item.reason) for item in read if isinstance(item, FaultyFrame)]
    assert faults == [
        (20, "left image: a.png: damaged"),
        (
            30,
            "right image: expected 48x32 pixels by the calibration, got 48x31; give the "
            "calibration of these images (--calibration FILE)",
        ),
        (40, "no right image within sync.stereo_tolerance_ms=0: the nearest is 1e-05 ms away"),
        (50, "left image: b; right image: c"),
        (45, "the stamp goes back from 50 to 45 ns"),
        (60, "the stamp 60 ns repeats"),
    ]
    assert [item.stamp_ns for item in read if isinstance(item, StereoFrame)] == [10, 60, 70]


def _written(path: Path, tiny: Any, **changes: Any) -> Path:
    D = {"distortion_coefficients": {"data": [-0.2, 0.05, 0.001, -0.001, 0.0]}}
    path.write_text(json.dumps(tiny.ros_camera(**(D | changes))))
    return path


def test_a_rig_makes_the_frames_that_a_recording_of_it_has(tiny: Any, tmp_path: Path) -> None:
    for name, baseline in (("left", 0.0), ("right", 0.5)):
        P = Calibration.from_camera(tiny.camera, baseline=baseline).P
        matrix = {"data": P.ravel().tolist()}
        _written(tmp_path / f"{name}.yaml", tiny, projection_matrix=matrix)
    rig = Rig(tmp_path / "left.yaml", str(tmp_path / "right.yaml"))
    assert isinstance(rig.camera, StereoCamera)
    assert rig.camera.baseline == pytest.approx(0.5)
    images = [tiny.texture(n, is_color=True) for n in range(2)]
    source = tiny.stereo(
        [(n, 7, image) for n, image in enumerate(images)], calibrations=rig.info.calibrations
    )
    (expected,) = _read(source)
    frame = rig.frame(7, *images)
    assert isinstance(frame, StereoFrame)
    assert frame.stamp_ns == 7
    assert not np.array_equal(frame.left, cv2.cvtColor(images[0], cv2.COLOR_BGR2GRAY))
    np.testing.assert_array_equal(frame.left, expected.left)
    np.testing.assert_array_equal(frame.right, expected.right)


@pytest.mark.parametrize("threads", [1, 2])
def test_masks_are_rectified_with_the_images(tiny: Any, tmp_path: Path, threads: int) -> None:
    mask = np.full((32, 48), 255, dtype=np.uint8)
    mask[:, :10] = 0
    source = tiny.rgbd([(0, 7, tiny.texture(1)), (1, 7, tiny.depth(2))])
    (bare,) = _read(source, threads)
    assert bare.mask is None
    held = replace(source, info=replace(source.info, masks=(mask,)))
    (frame,) = _read(held, threads)
    # Patches of corners reach five pixels beyond their middle.
    np.testing.assert_array_equal(frame.mask[:, 14:16] > 0, [[False, True]] * 32)
    assert np.isnan(frame.depth[:, :15]).all()
    np.testing.assert_array_equal(frame.depth[:, 15:], bare.depth[:, 15:])
    D = {"data": [0.5, 0.0, 0.0, 0.0, 0.0]}  # corners of the rectified image are outside of it
    bent = Rig(_written(tmp_path / "rgb.yaml", tiny, distortion_coefficients=D), sensor="rgbd")
    first, second = make_preparers(replace(bent.info, masks=(mask,)))
    assert second.mask is None
    assert first.mask is not None
    assert not np.array_equal(first.mask, frame.mask)
    assert first.mask[0, -1] == 255
    assert first(np.full((32, 48), 200, np.uint8))[0, -1] == 0


@pytest.mark.parametrize(("changes", "scale"), [({}, 1000.0), ({"depth_scale": 5000.0}, 5000.0)])
def test_a_rig_takes_depth_in_counts_or_metres(
    tiny: Any, tmp_path: Path, changes: Any, scale: float
) -> None:
    rig = Rig(
        _written(tmp_path / "rgb.yaml", tiny, distortion_coefficients=None, **changes),
        sensor="rgbd",
    )
    counts = np.full((32, 48), 2500, dtype=np.uint16)
    counts[0] = 0
    metres = counts / scale  # where 0 m is as little known as 0 counts
    for depth in (counts, metres, metres.astype(np.float32)):
        frame = rig.frame(7, tiny.texture(1), depth)
        assert isinstance(frame, RgbdFrame)
        assert np.isnan(frame.depth[0]).all()
        np.testing.assert_allclose(frame.depth[1:], metres[1:], rtol=1e-6)


def test_a_rig_refuses_images_of_another_camera(tiny: Any, tmp_path: Path) -> None:
    rig = Rig(_written(tmp_path / "rgb.yaml", tiny), sensor="rgbd")
    with pytest.raises(RecordingError, match=r"expected 48x32 pixels .* got 48x31"):
        rig.frame(7, tiny.texture(1)[:-1], tiny.depth(1))
    with pytest.raises(RecordingError, match="expected depth as 16-bit grey, got uint8"):
        rig.frame(7, tiny.texture(1), tiny.texture(1))
    with pytest.raises(RecordingError, match="expected an array of pixels, got NoneType"):
        rig.frame(7, None, tiny.depth(1))  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="holds one camera, expected two"):
        Rig(tmp_path / "rgb.yaml")


def test_only_images_of_a_free_running_sensor_may_be_left_out(tiny: Any) -> None:
    good, depth = tiny.texture(1), tiny.depth(1)
    stereo = tiny.stereo([(0, 0, good), (1, 0, good), (0, 9_000_000_000, good)])
    rgbd = tiny.rgbd([(0, 0, good), (1, 0, depth), (0, 9_000_000_000, good)])
    broken = tiny.rgbd([(0, 0, good), (1, 0, RecordingError("damaged"))])
    for source, n_kept in ((stereo, 2), (rgbd, 1), (broken, 1)):
        read = list(frames(source, Config()))
        kept = list(frames(source, Config(), with_unpaired=False))
        assert len(kept) == n_kept
        assert [item.stamp_ns for item in kept] == [item.stamp_ns for item in read[:n_kept]]


@_THREADS
def test_what_was_read_before_a_recording_breaks_is_delivered(tiny: Any, threads: int) -> None:
    source = tiny.stereo([(s, n, tiny.texture(n)) for n in range(3) for s in (0, 1)])
    source.damage = "the bag is truncated"
    iterator = frames(source, Config(runtime=RuntimeConfig(threads=threads)))
    assert [next(iterator).stamp_ns for _ in range(3)] == [0, 1, 2]
    with pytest.raises(RecordingError, match="truncated"):
        next(iterator)


@pytest.mark.parametrize("is_closed", [True, False])
def test_a_reading_that_is_given_up_leaves_no_thread_behind(tiny: Any, is_closed: bool) -> None:
    source = tiny.stereo([(s, n, tiny.texture(n)) for n in range(50) for s in (0, 1)])
    iterator = frames(source, Config(runtime=RuntimeConfig(threads=2)))
    next(iterator)
    assert _decoding_threads()
    if is_closed:
        iterator.close()  # type: ignore[attr-defined]
    del iterator
    assert not _decoding_threads()


def _decoding_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("decode")]


_RNG = np.random.default_rng(0)
_A, _B, _C, _D = (_RNG.integers(0, 255, (32, 48)).astype(np.uint8) for _ in range(4))
_DEPTH = np.ones((32, 48), dtype=np.float32)


def _kept(frames: list[Frame | FaultyFrame]) -> list[bool]:
    found = list(refuse_repeats(frames, ("left", "right")))
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in frames]
    return [not isinstance(frame, FaultyFrame) for frame in found]


def _pairs(*images: Any) -> list[Frame | FaultyFrame]:
    return [
        StereoFrame(stamp_ns=n, left=left.copy(), right=right.copy())
        for n, (left, right) in enumerate(images)
    ]


def test_two_repeats_in_a_row_are_refused_and_all_after_them() -> None:
    assert _kept(_pairs((_A, _B), (_A, _B), (_A, _B), (_C, _D))) == [True, False, False, True]
    assert _kept(_pairs((_A, _B), (_A, _D), (_C, _B), (_A, _B))) == [True, False, False, False]
    hanging = _pairs((_A, _B), *[(_A, _B)] * 4, (_C, _D), (_C, _D), (_A, _B))
    assert _kept(hanging) == [True, False, False, False, False, True, True, True]


def test_a_single_repeat_is_let_through_as_drivers_give_it_now_and_then() -> None:
    assert _kept(_pairs((_A, _B), (_A, _B), (_C, _D))) == [True, True, True]
    assert _kept(_pairs((_A, _B), (_A, _B))) == [True, True]
    assert _kept(_pairs((_A, _B), (_C, _D), (_A, _B), (_C, _D))) == [True] * 4


def test_faulty_frames_in_between_do_not_hide_a_repeat() -> None:
    first, second, third, fourth = _pairs((_A, _B), (_A, _B), (_A, _B), (_C, _D))
    faulty = FaultyFrame(stamp_ns=9, reason="damaged")
    read = [faulty, first, faulty, second, faulty, third, faulty, fourth]
    assert _kept(read) == [False, True, False, False, False, False, False, True]


def test_depth_may_repeat_and_so_may_images_of_one_value() -> None:
    rgbd: list[Frame | FaultyFrame] = [
        RgbdFrame(stamp_ns=n, image=image, depth=_DEPTH) for n, image in enumerate((_A, _B, _B, _B))
    ]
    assert _kept(rgbd) == [True, True, False, False]
    black = np.zeros_like(_A)
    assert _kept(_pairs(*[(black, black)] * 4)) == [True] * 4
