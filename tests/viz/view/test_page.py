"""The page of a recording shows what the player does, and controls it."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gvo.config import Config, load_configuration
from gvo.geometry import se3
from gvo.io.synthetic import SyntheticRecording
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.scene import Path, Track
from gvo.viz.view import serve
from gvo.viz.view.page import Page, truth_positions
from gvo.viz.view.player import Player
from gvo.viz.view.server import ViewServer
from tests.make.results import estimate_at, loop_of
from tests.viz.view.fakes import (
    PERIOD_NS,
    FakePlayer,
    as_player,
    cells,
    pose_of,
    stamps_of,
)


@pytest.fixture
def player() -> FakePlayer:
    return FakePlayer()


@pytest.fixture
def page(view: ViewServer, player: FakePlayer) -> Iterator[Page]:
    opened = Page(view.viser, as_player(player), truth=None)
    yield opened
    opened.close()


def show(page: Page, player: FakePlayer, index: int, **changes: Any) -> None:
    player.show(index, **changes)
    page.settle()


def nodes(view: ViewServer, prefix: str) -> list[Any]:
    names = [*view.viser.scene._handle_from_node_name]
    found = [view.viser.scene.get_handle_by_name(name) for name in names if name.startswith(prefix)]
    return [node for node in found if node is not None]


def length(view: ViewServer, path: str) -> float:
    points = [node.points for node in nodes(view, f"/paths/{path}/")]
    return float(sum(np.linalg.norm(p[:, 1] - p[:, 0], axis=1).sum() for p in points))


def test_the_numbers_are_those_of_the_frame(page: Page, player: FakePlayer) -> None:
    for index in range(8):
        player.show(index)
    page.settle()
    numbers = cells(page.numbers.content)
    assert numbers["frame"] == "7 of 40"
    assert numbers["stamp"] == "0.700000000"
    assert (numbers["status"], numbers["matches"], numbers["inliers"]) == ("ok", "107", "97")
    assert numbers["links"] == "1 (1 refused)"
    assert numbers["position"] == "0.000, 0.000, 7.000"
    assert numbers["sigma"].split(", ") == ["0.0283", "0.0566", "0.0849"]
    assert numbers["ms"].startswith("5.5 ")


def test_a_faulty_frame_tells_its_reason_and_no_counts(page: Page, player: FakePlayer) -> None:
    player.fault = "the recording <breaks> off"
    show(page, player, 3, is_faulty=True)
    assert "the recording &lt;breaks&gt; off" in page.message.content
    numbers = cells(page.numbers.content)
    assert (numbers["status"], numbers["reason"]) == ("skipped", "truncated image")
    assert "matches" not in numbers


def test_paths_links_and_loops_are_drawn(page: Page, player: FakePlayer, view: ViewServer) -> None:
    for index in range(4):
        player.show(index)
    show(page, player, 4, loops=(loop_of(4 * PERIOD_NS, 0),))
    for name in ("raw", "causal"):
        assert length(view, name) == pytest.approx(4.0, abs=1e-4)
    (smoothed,) = nodes(view, "/paths/smoothed/")
    np.testing.assert_allclose(smoothed.points[:, 1, 0], 0.5)  # as the window has it
    (step,) = nodes(view, "/links/step")
    (refused,) = nodes(view, "/links/refused")
    np.testing.assert_allclose(step.points, [[[0.5, 0.0, 3.0], [0.0, 0.0, 4.0]]])
    np.testing.assert_allclose(refused.points, [[[0.0, 0.0, 0.0], [0.0, 0.0, 4.0]]])
    (loop,) = nodes(view, "/loops/loops")
    np.testing.assert_allclose(loop.points, [[[0.5, 0.0, 4.0], [0.5, 0.0, 0.0]]])
    (camera,) = [node for node in nodes(view, "/camera") if node.name == "/camera"]
    np.testing.assert_allclose(camera.position, [0.0, 0.0, 4.0])
    assert len(nodes(view, "/ellipsoids/meshes")) == len(nodes(view, "/keyframes/cameras")) == 1


def test_a_frame_of_no_points_sends_none_and_those_of_keyframes_stay(
    page: Page, player: FakePlayer, view: ViewServer
) -> None:
    for index, n_clouds in ((0, 1), (1, 0), (2, 1)):  # browsers complain of an empty one
        show(page, player, index, n_points=50 * n_clouds)
        assert len(nodes(view, "/camera/points/")) == n_clouds
        (cloud,) = nodes(view, "/cloud/")
        assert len(cloud.points) == 50


def test_a_layer_that_is_hidden_stays_so(page: Page, player: FakePlayer, view: ViewServer) -> None:
    page.drawing.set_visible("raw", False)
    player.show(3)
    show(page, player, 4)
    assert [node.visible for node in nodes(view, "/paths/raw")] == [False, True]  # and its line
    page.drawing.set_visible("raw", True)
    assert [node.visible for node in nodes(view, "/paths/raw")] == [True, True]


def test_buttons_take_the_parameters_first(page: Page, player: FakePlayer) -> None:
    page.controls.handle("klt", "n_corners").value = 300
    page.playback.press("step")
    page.playback.start.value = 7
    page.playback.restart()
    page.playback.toggle()
    page.playback.speed.value = "2 x"
    page.playback.speed.value = "fastest"
    commands = ("step",), ("restart", 7), ("play",), ("speed", 2.0), ("speed", None)
    assert player.calls == [("reconfigure",), *commands]
    assert player.config == load_configuration(settings=["klt.n_corners=300"])


def test_the_saved_yaml_is_the_configuration(page: Page, tmp_path: Any) -> None:
    page.controls.handle("ransac", "seed").value = 5
    page.controls.null_handle("window", "size").value = True
    sent: list[tuple[str, bytes]] = []
    client = SimpleNamespace(
        send_file_download=lambda name, content, save_immediately: sent.append((name, content))
    )
    page.save(cast(Any, client))
    ((name, content),) = sent
    (tmp_path / name).write_bytes(content)
    saved = load_configuration(tmp_path / name)
    assert saved == page.controls.config
    assert saved != Config()


def test_the_truth_is_laid_onto_the_first_pose(view: ViewServer, player: FakePlayer) -> None:
    T_map_world = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, 6.0, 7.0]))
    T_map_cam = T_map_world @ np.array([pose_of(index) for index in range(40)])
    truth = Trajectory(stamps_ns=stamps_of(40), T_world_frame=T_map_cam)
    page = Page(view.viser, as_player(player), truth=truth)
    player.show(0)
    show(page, player, 20)
    ends = np.concatenate([node.points.reshape(-1, 3) for node in nodes(view, "/paths/truth/")])
    np.testing.assert_allclose(ends[:, :2], 0.0, atol=1e-5)
    assert 18.9 < ends[:, 2].max() <= 20.0001
    page.close()


def test_a_page_opens_with_the_first_frame_or_where_its_player_is() -> None:
    recording = SyntheticRecording("handheld", "rgbd", n_frames=3, scale=0.25)
    with Player(lambda config: recording, Config()) as player:
        for n_done in (1, 2):
            with serve(player, port=0):
                assert player.wait(30.0)
                assert player.newest.n_done == n_done
            player.step()
            assert player.wait(30.0)


STEP_NS = 100_000_000
N = 20
STAMPS_NS: IntArray = STEP_NS * np.arange(N, dtype=np.int64)
TWISTS = arrays(np.float64, 6, elements=st.floats(-2.0, 2.0))


def spiral() -> FloatArray:
    steps = np.array([0.02, 0.15, 0.0, 0.05, 0.01, 0.4]) * np.arange(float(N))[:, np.newaxis]
    return np.asarray(se3.exp(steps))


def truth_at(T: FloatArray, stamps_ns: IntArray = STAMPS_NS) -> Trajectory:
    return Trajectory(stamps_ns=stamps_ns, T_world_frame=T @ spiral())


def path_of(n: int = N, scale: float = 1.0) -> Path:
    track = Track()
    for stamp_ns, T in zip(STAMPS_NS[:n].tolist(), spiral(), strict=False):
        track.add(estimate_at(stamp_ns, se3.make_transform(T[:3, :3], scale * T[:3, 3])))
    return track.path()


@given(TWISTS, st.booleans())
@settings(max_examples=20)
def test_the_truth_is_laid_onto_the_estimate(twist: FloatArray, has_rotations: bool) -> None:
    truth = truth_at(se3.exp(twist))
    if not has_rotations:
        truth = Trajectory.of_positions(truth.stamps_ns, truth.positions)
    positions = truth_positions(truth, path_of())
    np.testing.assert_allclose(positions, spiral()[:, :3, 3], atol=1e-6)


def test_a_drift_shows_where_the_first_pose_is_known_and_is_shared_out_where_not() -> None:
    truth, path = truth_at(np.eye(4)), path_of(scale=1.2)
    bare = Trajectory.of_positions(STAMPS_NS, truth.positions)
    laid, fitted = truth_positions(truth, path), truth_positions(bare, path)
    errors = [np.linalg.norm(path[1][:, :3] - found, axis=1) for found in (laid, fitted)]
    assert errors[0][0] < 1e-9
    assert errors[0][-1] > errors[1][-1]
    assert errors[1][0] > 1e-3


def test_a_truth_is_drawn_as_far_as_the_estimate_has_come_and_may_begin_later() -> None:
    found = truth_positions(truth_at(np.eye(4)), path_of(5))
    np.testing.assert_allclose(found, spiral()[:5, :3, 3], atol=1e-9)
    T = se3.exp(np.array([0.1, -0.4, 0.2, 3.0, 1.0, -2.0]))
    later = truth_at(T).select(slice(4, None))
    np.testing.assert_allclose(truth_positions(later, path_of()), spiral()[4:, :3, 3], atol=1e-6)
    elsewhere = truth_at(T, STAMPS_NS + 10**15)
    assert truth_positions(elsewhere, path_of()).shape == (0, 3)
