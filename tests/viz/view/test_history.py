"""What is kept of frames: paths, clouds, pictures, in bounded memory."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from gvo.config import DepthConfig
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.types import Estimate, FloatArray, RelativePose, RgbdFrame, StereoFrame
from gvo.viz.view import clouds
from gvo.viz.view.clouds import Cloud, KeyframeClouds, accumulate, frame_cloud, thin
from gvo.viz.view.history import DiskList, FrameRecord, History
from tests.results import estimate_at, loop_of, result_of

CAMERA = PinholeCamera(fx=100.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
POINT: Cloud = (
    np.array([[0.0, 0.0, 2.0]], dtype=np.float32),
    np.array([[9, 9, 9]], dtype=np.uint8),
)


def at(x_m: float) -> FloatArray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def estimate(frame: int, x_m: float) -> Estimate:
    return estimate_at(frame * 10, at(x_m))


def record(
    frame: int, *, finished: tuple[int, ...] = (), window: tuple[int, ...] = ()
) -> FrameRecord:
    """Return a frame whose raw, causal, window and final x tell where they come from."""
    result = result_of(
        estimate(frame, frame + 0.1),
        causal=estimate(frame, frame + 0.2),
        finished=tuple(estimate(done, done + 0.4) for done in finished),
        keyframes_ns=(10 * (frame - frame % 3),),
    )
    return FrameRecord(
        stamp_ns=10 * frame,
        result=result,
        reason="",
        image=np.full((6, 8, 3), 20 * frame % 256, dtype=np.uint8),
        overlay=np.full((12, 16, 3), 30 * frame % 256, dtype=np.uint8),
        cloud=POINT,
        window_poses={10 * held: at(held + 0.3) for held in window},
        window_covariances={10 * held: np.eye(6) * held for held in window},
    )


def faulty(frame: int) -> FrameRecord:
    black = np.zeros((6, 8, 3), dtype=np.uint8)
    return FrameRecord(
        stamp_ns=10 * frame,
        result=None,
        reason="dark",
        image=black,
        overlay=black,
        cloud=clouds.empty_cloud(),
        window_poses={},
        window_covariances={},
    )


@pytest.fixture
def history() -> History:
    history = History(2)
    history.add(record(2, window=(2,)))
    history.add(record(3, window=(2, 3)))
    history.add(faulty(4))
    history.add(record(5, finished=(2,), window=(3, 5)))
    history.add(record(6, window=(5, 6)))
    history.finish([estimate(done, done + 0.4) for done in (3, 5, 6)])
    return history


def xs(path: tuple[np.ndarray, np.ndarray]) -> list[float]:
    return [round(float(x), 6) for x in path[1][:, 0]]


def test_paths_go_up_to_the_frame_shown_as_it_was_known_then(history: History) -> None:
    smoothed = {
        2: [2.3],
        3: [2.3, 3.3],
        4: [2.2, 3.2],  # nothing is known of the window: the causal poses
        5: [2.4, 3.3, 5.3],
        6: [2.4, 3.4, 5.4, 6.4],
    }
    for shown, expected in smoothed.items():
        history.show(shown)
        frames = [frame for frame in (2, 3, 5, 6) if frame <= shown]
        assert xs(history.path("smoothed")) == expected
        assert xs(history.path("raw")) == [frame + 0.1 for frame in frames]
        assert xs(history.path("causal")) == [frame + 0.2 for frame in frames]
        assert history.path("raw")[0].tolist() == [10 * frame for frame in frames]


def test_loops_join_the_best_poses_as_of_the_frame_shown() -> None:
    history, last = History(2), record(5, finished=(2,), window=(5,))
    for each in (record(2), record(3)):
        history.add(each)
    assert last.result is not None
    history.add(replace(last, result=replace(last.result, loops=(loop_of(50, 20),))))
    history.show(3)
    assert history.loop_lines().shape == (0, 2, 3)
    history.show(4)
    np.testing.assert_allclose(history.loop_lines()[:, :, 0], [[2.4, 5.3]])


def test_frames_come_back_from_disk_as_they_were(history: History) -> None:
    for frame in (5, 3, 6, 2):
        view = history.frame_view(frame)
        assert (view.index, view.stamp_ns) == (frame, 10 * frame)
        assert view.image.shape == (6, 8, 3)
        assert view.overlay.shape == (12, 16, 3)
        assert np.abs(view.image.astype(int) - 20 * frame).max() <= 2
        assert view.T_world_frame[0, 3] == frame + 0.2
        assert view.result is not None
        assert view.result.raw.T_world_frame[0, 3] == frame + 0.1
        np.testing.assert_array_equal(view.cloud[0], POINT[0])
        assert set(view.window_poses) == set(view.window_covariances)
        assert all(view.window_poses[ns][0, 3] == ns / 10 + 0.3 for ns in view.window_poses)
        assert all(c[0, 0] == ns / 10 for ns, c in view.window_covariances.items())
    fault = history.frame_view(4)
    assert (fault.result, fault.status, fault.reason) == (None, None, "dark")
    assert fault.keyframes == ()
    assert fault.links == ()
    assert fault.T_world_frame[0, 3] == 3.2


@pytest.mark.parametrize("index", [1, 7])
def test_frames_that_are_not_there_are_refused(history: History, index: int) -> None:
    for ask in (history.show, history.frame_view, history.stamp_ns):
        with pytest.raises(ValueError, match="2 to 6"):
            ask(index)


def test_nothing_done_gives_empty_paths_and_no_cloud() -> None:
    history = History()
    assert xs(history.path("smoothed")) == xs(history.path("raw")) == []
    assert [len(part) for part in history.accumulated_cloud()] == [0, 0]


def test_the_clouds_of_keyframes_stand_where_their_best_poses_put_them(history: History) -> None:
    """Frames 3 and 6 are keyframes."""
    expected = {2: [], 3: [3.3], 4: [3.2], 5: [3.3], 6: [3.4, 6.4]}
    for shown, found in expected.items():
        history.show(shown)
        points, colours = history.accumulated_cloud()
        assert points.dtype == np.float32
        assert colours.shape == points.shape
        assert sorted(round(float(x), 4) for x in points[:, 0]) == found


def test_many_frames_grow_the_arrays() -> None:
    history = History()
    for frame in range(200):
        history.add(record(frame))
    history.show(199)
    assert xs(history.path("raw")) == [round(frame + 0.1, 6) for frame in range(200)]


def test_a_grid_of_known_depth_is_projected_back() -> None:
    v, u = np.indices((CAMERA.height, CAMERA.width))
    depth = (1.0 + 0.01 * u + 0.005 * v).astype(np.float32)
    depth[:20] = np.nan
    depth[:, 100:] = 50.0
    frame = RgbdFrame(stamp_ns=0, image=(u + v).clip(0, 255).astype(np.uint8), depth=depth)
    points, colours = frame_cloud(frame, None, CAMERA, DepthConfig(max_depth_m=8.0))
    assert 500 < len(points) <= 5000
    pixels = CAMERA.project(points.astype(np.float64))
    columns, rows = np.rint(pixels).astype(int).T
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=1), atol=1e-3)
    np.testing.assert_array_equal(points[:, 2], depth[rows, columns])
    np.testing.assert_array_equal(colours, np.repeat((rows + columns)[:, None], 3, axis=1))
    assert rows.min() >= 20
    assert columns.max() < 100


def test_the_points_of_a_stereo_frame_are_its_inliers_in_the_grey_of_their_pixels() -> None:
    v, u = np.indices((CAMERA.height, CAMERA.width))
    left = (u + v).clip(0, 255).astype(np.uint8)
    registration = RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        matches=np.zeros((3, 2), dtype=np.int64),
        inliers=np.array([True, False, True]),
        pixels_reference=np.zeros((3, 2)),
        pixels_current=np.array([[10.2, 20.4], [5.0, 5.0], [159.4, 119.4]]),
        points_current=np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 1.0], [4.0, 5.0, 6.0]]),
    )
    frame = StereoFrame(stamp_ns=0, left=left, right=left)
    points, colours = frame_cloud(frame, registration, CAMERA, DepthConfig())
    assert points.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert colours[:, 0].tolist() == [30, 255]
    assert len(frame_cloud(frame, None, CAMERA, DepthConfig())[0]) == 0


coordinates = arrays(
    np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-1e3, 1e3)
)


@given(points=coordinates, voxel_m=st.floats(1e-6, 100.0), n_max=st.integers(1, 50))
@settings(max_examples=100)
def test_thinning_leaves_few_enough_points_one_to_a_voxel(
    points: FloatArray, voxel_m: float, n_max: int
) -> None:
    chosen = thin(points, voxel_m, n_max=n_max)
    assert len(chosen) <= n_max
    assert (len(chosen) == 0) == (len(points) == 0)
    assert len(set(chosen.tolist())) == len(chosen)
    if len(points):
        cells = np.floor((points[chosen] - points.min(axis=0)) / voxel_m)
        assert len(np.unique(cells, axis=0)) == len(chosen)


def test_points_far_apart_all_stay() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert thin(points, 0.5).tolist() == [0, 1, 2, 3]


def test_the_clouds_of_many_keyframes_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds, "_MAX_KEPT", 1000)
    rng = np.random.default_rng(0)
    kept = KeyframeClouds()
    for index in range(100):
        points = rng.uniform(1.0, 5.0, size=(100, 3)).astype(np.float32)
        kept.add(index, (points, np.zeros((100, 3), dtype=np.uint8)))
        assert len(kept) <= 1000
    placed = kept.select({index: se3.exp(np.zeros(6)) for index in range(100)})
    sizes = [len(points) for _, (points, _) in placed]
    assert min(sizes) >= 1
    assert sum(sizes) == len(kept)
    assert len(accumulate(placed)[0]) <= len(kept)


named_arrays = st.dictionaries(
    st.sampled_from(["image", "overlay", "poses"]),
    arrays(
        st.sampled_from(["<f8", "<f4", "<i8", "|u1", "|b1", ">i4"]).map(np.dtype),
        array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    ),
)


@given(st.lists(named_arrays, max_size=4))
def test_a_list_on_disk_gives_back_what_it_was_given(items: list[dict[str, np.ndarray]]) -> None:
    kept = DiskList()
    for item in items:
        kept.append(item)
    assert len(kept) == len(items)
    for index in reversed(range(len(items))):
        assert list(kept[index]) == list(items[index])
        for name, array in items[index].items():
            back = kept[index][name]
            assert (back.dtype, back.shape) == (array.dtype, array.shape)
            assert back.tobytes() == array.tobytes()
    with pytest.raises(IndexError, match=f"{len(items)} is not among {len(items)} items"):
        kept[len(items)]


def test_a_list_on_disk_takes_no_python_objects() -> None:
    kept = DiskList()
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        kept.append({"value": np.array([object()])})
    assert len(kept) == 0


def test_the_player_needs_no_browser_page() -> None:
    code = "import sys; sys.modules['viser'] = None; import gvo.viz.view.player"
    subprocess.run([sys.executable, "-c", code], check=True)
