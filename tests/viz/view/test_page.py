"""The page of a recording shows what the player does, and controls it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gvo.config import Config, load_configuration
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.scene import Path as PosePath
from gvo.viz.scene import Track
from gvo.viz.view import serve
from gvo.viz.view.page import Page, truth_positions
from tests.make.results import estimate_at, loop_of
from tests.viz.view.fakes import PERIOD_NS, FakePlayer, as_player, cells, pose_of


def show(page: Page, player: FakePlayer, index: int, **changes: Any) -> None:
    player.show(index, **changes)
    page.settle()


def nodes(page: Page, prefix: str) -> list[Any]:
    scene = page.server.scene
    found = [scene.get_handle_by_name(name) for name in [*scene._handle_from_node_name]]
    return [node for node in found if node is not None and node.name.startswith(prefix)]


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
    assert "the recording &lt;breaks&gt; off" in page.state.content
    numbers = cells(page.numbers.content)
    assert (numbers["status"], numbers["reason"]) == ("skipped", "truncated image")
    assert "matches" not in numbers


def test_paths_links_and_loops_are_drawn(page: Page, player: FakePlayer) -> None:
    for index in range(4):
        player.show(index)
    show(page, player, 4, loops=(loop_of(4 * PERIOD_NS, 0),))
    for name in ("raw", "causal"):
        (line,) = nodes(page, f"/world/paths/{name}/")
        np.testing.assert_allclose(line.points[:, 1, 2], [1.0, 2.0, 3.0, 4.0])
    (smoothed,) = nodes(page, "/world/paths/smoothed/")
    np.testing.assert_allclose(smoothed.points[:, 1, 0], 0.5)  # as the window has it
    for name, ends in (
        ("/world/links/step", [[0.5, 0.0, 3.0], [0.0, 0.0, 4.0]]),
        ("/world/links/refused", [[0.0, 0.0, 0.0], [0.0, 0.0, 4.0]]),
        ("/world/loops/loops", [[0.5, 0.0, 4.0], [0.5, 0.0, 0.0]]),
    ):
        (node,) = nodes(page, name)
        np.testing.assert_allclose(node.points, [ends])
    (camera,) = [node for node in nodes(page, "/world/camera") if node.name == "/world/camera"]
    np.testing.assert_allclose(camera.position, [0.0, 0.0, 4.0])
    assert (
        len(nodes(page, "/world/ellipsoids/meshes"))
        == len(nodes(page, "/world/keyframes/cameras"))
        == 1
    )


def test_the_recording_plays_when_the_first_browser_opens_the_page(
    page: Page, player: FakePlayer, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []
    monkeypatch.setattr(page.server, "on_client_connect", opened.append)
    page.play_when_opened()
    (tell,) = opened
    for is_playing, index in ((False, 0), (True, 0), (False, 5)):
        player.calls.clear()
        player.is_playing = is_playing
        player.show(index)
        tell(None)
        assert ("play" in str(player.calls)) == (not is_playing and index == 0)


def test_a_layer_that_is_hidden_stays_so(page: Page, player: FakePlayer) -> None:
    page.drawing.set_visible("raw", False)
    player.show(3)
    show(page, player, 4)
    layer, line = nodes(page, "/world/paths/raw")
    assert (layer.visible, line.visible) == (False, True)  # what hangs on it is hidden with it
    page.drawing.set_visible("raw", True)
    assert layer.visible


def test_buttons_take_the_parameters_first(page: Page, player: FakePlayer) -> None:
    player.calls.clear()
    page.controls.handle("klt", "n_corners").value = 300
    page.press("step")
    page.press("restart", 7)
    page.speed.value = "2 x"
    page.speed.value = "fastest"
    commands = ("step",), ("restart", 7), ("speed", 2.0), ("speed", None)
    assert player.calls == [("reconfigure",), *commands]
    assert player.config == load_configuration(settings=["klt.n_corners=300"])


def test_the_saved_yaml_is_the_configuration(page: Page, tmp_path: Path) -> None:
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


def test_the_truth_is_drawn_from_the_first_pose(player: FakePlayer) -> None:
    T_map_world = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, 6.0, 7.0]))
    T_map_cam = T_map_world @ np.array([pose_of(index) for index in range(40)])
    truth = Trajectory(stamps_ns=PERIOD_NS * np.arange(40), T_world_frame=T_map_cam)
    with serve(as_player(player), port=0, truth=truth) as page:
        player.show(0)
        show(page, player, 20)
        (line,) = nodes(page, "/world/paths/truth/")
        ends = line.points.reshape(-1, 3)
    np.testing.assert_allclose(ends[:, :2], 0.0, atol=1e-5)
    assert 18.9 < ends[:, 2].max() <= 20.0001


def test_a_page_opens_with_the_first_frame_or_where_its_player_is(player: FakePlayer) -> None:
    with serve(as_player(player), port=0):
        assert player.calls == [("step",)]
    player.show(0)
    player.calls.clear()
    with serve(as_player(player), port=0):
        assert player.calls == []


N = 20
STAMPS_NS: IntArray = PERIOD_NS * np.arange(N, dtype=np.int64)


def spiral() -> FloatArray:
    steps = np.array([0.02, 0.15, 0.0, 0.05, 0.01, 0.4]) * np.arange(float(N))[:, np.newaxis]
    return np.asarray(se3.exp(steps))


def path_of(n: int = N, scale: float = 1.0) -> PosePath:
    track = Track()
    for stamp_ns, T in zip(STAMPS_NS[:n].tolist(), spiral(), strict=False):
        track.add(estimate_at(stamp_ns, se3.make_transform(T[:3, :3], scale * T[:3, 3])))
    return track.path()


@given(arrays(np.float64, 6, elements=st.floats(-2.0, 2.0)), st.booleans(), st.integers(0, 4))
@settings(max_examples=15)
def test_the_truth_is_laid_onto_the_estimate_as_far_as_that_has_come(
    twist: FloatArray, has_rotations: bool, n_missing: int
) -> None:
    truth = Trajectory(stamps_ns=STAMPS_NS, T_world_frame=se3.exp(twist) @ spiral())
    truth = truth.select(slice(n_missing, None))  # it may begin later
    if not has_rotations:
        truth = Trajectory.of_positions(truth.stamps_ns, truth.positions)
    positions = truth_positions(truth, path_of(15))
    np.testing.assert_allclose(positions, spiral()[n_missing:15, :3, 3], atol=1e-6)
    elsewhere = Trajectory(stamps_ns=STAMPS_NS + 10**15, T_world_frame=spiral())
    assert truth_positions(elsewhere, path_of()).shape == (0, 3)
