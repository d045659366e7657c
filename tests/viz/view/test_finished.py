"""The page of a finished run, and what plays it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gvo.errors import GvoError
from gvo.geometry import se3
from gvo.io.run_folder.reader import LoopTable, RunRecord, read_run
from gvo.io.run_folder.writer import RunFolder
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame
from gvo.viz.view import serve
from gvo.viz.view.finished import FinishedPage, aligned_truth, start_sigmas, world_up
from gvo.viz.view.player import RunPlayer
from gvo.viz.view.server import ViewServer
from tests.viz.view.fakes import cells, pose_of, result_of, stamps_of

N_FRAMES = 12
SKIPPED = 7


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run straight ahead with a frame that was skipped, its truth in a world of its own."""
    out = tmp_path_factory.mktemp("run") / "out"
    with RunFolder(out) as written:
        for index in range(N_FRAMES):
            if index == SKIPPED:
                fault = FaultyFrame(stamp_ns=int(stamps_of(N_FRAMES)[index]), reason="no image")
                written.add_faulty(fault)
                continue
            result = result_of(index)
            written.add_frame(None, result)
            written.add_smoothed([result.causal])
        poses = np.array([pose_of(index) for index in range(N_FRAMES)])
        T_map_world = se3.exp(np.array([0.3, 0.1, -2.0, 5.0, 6.0, 7.0]))
        written.write_truth(
            Trajectory(stamps_ns=stamps_of(N_FRAMES), T_world_frame=T_map_world @ poses)
        )
        written.write_summary({"recording": "drive", "base_frame": "camera"})
    return out


@pytest.fixture
def record(folder: Path) -> RunRecord:
    return read_run(folder)


@pytest.fixture
def page(view: ViewServer, record: RunRecord) -> Iterator[FinishedPage]:
    opened = FinishedPage(view.viser, record)
    yield opened
    opened.close()


def drawn(view: ViewServer, path: str) -> float:
    nodes: list[Any] = [
        view.viser.scene.get_handle_by_name(f"/paths/{path}/{number}") for number in range(3)
    ]
    points = [np.asarray(node.points) for node in nodes if node is not None]
    return float(sum(np.linalg.norm(p[:, 1] - p[:, 0], axis=1).sum() for p in points))


def test_every_frame_shows_its_row_of_the_table(page: FinishedPage, folder: Path) -> None:
    header, *lines = (folder / "frames.csv").read_text(encoding="utf-8").splitlines()
    for index in (0, SKIPPED, N_FRAMES - 1):
        row = dict(zip(header.split(","), lines[index].split(","), strict=True))
        page.player.seek(index)
        page.settle()
        numbers = cells(page.numbers.content)
        assert numbers["frame"] == f"{index} of {N_FRAMES}"
        assert numbers["status"] == row["status"]
        assert numbers["matches"] == row["n_matches"]
        assert numbers["links"] == row["n_links"]
        assert numbers.get("reason", "") == row["reason"]
        assert ("position" in numbers) == (index != SKIPPED)
        assert ("ms" in numbers) == (index != SKIPPED)


def test_the_paths_end_at_the_frame(page: FinishedPage, view: ViewServer, folder: Path) -> None:
    poses = np.loadtxt(folder / "causal.txt")[:, 1:4]
    for index in (N_FRAMES - 1, 4):
        page.player.seek(index)
        page.settle()
        steps = np.diff(poses[: index + 1], axis=0)
        assert drawn(view, "causal") == pytest.approx(np.linalg.norm(steps, axis=1).sum(), rel=1e-4)


def test_global_poses_and_loops_are_drawn_to_the_frame(view: ViewServer, record: RunRecord) -> None:
    assert "global" not in record.trajectories
    ends = np.array([[8, 2], [10, 2]]) * int(stamps_of(2)[1])
    loops = LoopTable(
        stamps_ns=ends[:, 0],
        reference_ns=ends[:, 1],
        n_inliers=np.array([9, 9]),
        residuals=np.ones(2),
        reasons=("", "odd"),
    )
    trajectories = {**record.trajectories, "global": record.trajectories["causal"]}
    page = FinishedPage(view.viser, replace(record, loops=loops, trajectories=trajectories))
    find = view.viser.scene.get_handle_by_name
    page.settle()
    for name, last_m in (("loops", 8.0), ("refused_loops", 10.0)):
        node: Any = find(f"/loops/{name}")
        np.testing.assert_allclose(node.points[0, :, 2], [2.0, last_m])
    page.player.seek(9)
    page.settle()
    assert drawn(view, "global") == pytest.approx(9.0, rel=1e-4)
    assert find("/loops/loops") is not None
    assert find("/loops/refused_loops") is None
    page.close()


def test_the_truth_lies_on_the_estimate(record: RunRecord) -> None:
    truth = aligned_truth(record)
    assert truth is not None
    ahead = np.array([pose_of(index)[:3, 3] for index in range(N_FRAMES)])
    np.testing.assert_allclose(truth.positions, ahead, atol=1e-6)


def test_the_world_of_the_first_camera_has_its_up_against_y(record: RunRecord) -> None:
    assert world_up(record) == "-y"
    record.summary["base_frame"] = "base_link"
    assert world_up(record) == "+z"
    for frame, up in (("left", "-y"), ("base_link", "+z")):
        record.summary["run"] = {"output": {"frame": frame}, "recording": {"frame_id": "left"}}
        assert world_up(record) == up


def test_what_a_run_does_not_hold_is_not_named(
    view: ViewServer, record: RunRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the run of a graph that was optimized at once."""
    gui, added = view.viser.gui, list[str]()

    def add(original: Any, text: str, *given: Any, **options: Any) -> Any:
        added.append(text)
        return original(text, *given, **options)

    for name in ("add_html", "add_checkbox"):
        monkeypatch.setattr(gui, name, partial(add, getattr(gui, name)))
    held = dict(record.trajectories)
    held["causal"] = held["causal"].select(slice(0))
    held["smoothed"] = replace(held["smoothed"], covariances=None)
    FinishedPage(view.viser, replace(record, trajectories=held)).close()
    assert not [text for text in added if "causal" in text or "ellipsoid" in text]
    assert all([text for text in added if name in text] for name in ("raw", "smoothed", "truth"))


def test_a_folder_is_served(folder: Path) -> None:
    with serve(folder, port=0) as view:
        assert view.url.startswith("http://127.0.0.1:")


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GvoError, match="is no run folder"):
        serve(tmp_path, port=0)


@pytest.mark.parametrize(
    ("factor", "n_sigmas"),
    # 0.07 of 11 m by the largest sigma: that of the last frame, 0.03 m times the root of 12
    [(1.0, 7), (1e-4, 10), (1e4, 1), (4.0, 3)],
)
def test_ellipsoids_hide_no_path_at_first(record: RunRecord, factor: float, n_sigmas: int) -> None:
    smoothed = record.trajectories["smoothed"]
    assert smoothed.covariances is not None
    wider = replace(smoothed, covariances=factor * smoothed.covariances)
    trajectories = {**record.trajectories, "smoothed": wider}
    assert start_sigmas(replace(record, trajectories=trajectories)) == n_sigmas


STAMPS = np.array([0, 100, 200, 500, 600], dtype=np.int64) * 1_000_000


@pytest.fixture
def shown() -> list[int]:
    return []


@pytest.fixture
def player(shown: list[int]) -> Iterator[RunPlayer]:
    """At the first frame, its own clock too slow to matter."""
    opened = RunPlayer(STAMPS, shown.append, period_s=3600.0)
    yield opened
    opened.close()


def test_frames_follow_by_their_stamps(player: RunPlayer, shown: list[int]) -> None:
    player.play()
    for _ in range(12):
        player.advance(0.05)
    assert list(dict.fromkeys(shown)) == [1, 2, 3, 4]
    assert not player.is_playing


def test_a_gap_lasts_as_long_as_it_did(player: RunPlayer) -> None:
    player.seek(2)
    player.play()
    player.advance(0.29)
    assert player.index == 2
    player.advance(0.011)
    assert player.index == 3


def test_twice_as_fast_takes_half_the_time(player: RunPlayer) -> None:
    player.set_speed(2.0)
    player.play()
    player.advance(0.11)
    assert player.index == 2


def test_the_fastest_shows_every_frame(player: RunPlayer, shown: list[int]) -> None:
    player.set_speed(None)
    player.play()
    for _ in range(4):
        player.advance(1e-6)
    assert shown == [1, 2, 3, 4]


def test_playing_at_the_end_begins_again(player: RunPlayer, shown: list[int]) -> None:
    player.seek(4)
    player.play()
    assert shown == [4, 0]
    assert player.is_playing


def test_a_step_pauses(player: RunPlayer) -> None:
    player.play()
    player.step()
    assert (player.index, player.is_playing) == (1, False)
    player.advance(10.0)
    assert player.index == 1


@pytest.mark.parametrize(("index", "reached"), [(-3, 0), (99, 4), (2, 2)])
def test_seeking_stays_within_the_run(player: RunPlayer, index: int, reached: int) -> None:
    player.seek(index)
    assert player.index == reached
