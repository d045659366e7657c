"""Plots of trajectories, seen through their pixels and their SVG text."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gvo.errors import ConfigurationError, TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.plots import plot_trajectories
from gvo.viz.report.paths import World

BLACK, RAW, CAUSAL, SMOOTHED, FREE = (
    (0, 0, 0),
    (0xE6, 0x9F, 0x00),
    (0x56, 0xB4, 0xE9),
    (0x00, 0x9E, 0x73),
    (0x00, 0x72, 0xB2),
)


# A camera that looks along x of a world with z up.
UPRIGHT = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0, 0, 0, 1]]
)


def curve(
    seed: int,
    *,
    extents: tuple[float, float, float] = (3.0, 0.2, 5.0),
    start: float = 0.0,
    is_upright: bool = False,
) -> Trajectory:
    angle = np.linspace(0.0, 6.0, 60)
    twists = np.zeros((60, 6))
    twists[:, 3:] = np.column_stack([np.sin(angle), angle / 6, 1 - np.cos(angle)]) * extents
    twists[1:, 3:] += np.random.default_rng(seed).normal(size=(59, 3)) * 0.05
    twists[:, 3:] += start
    T = se3.exp(twists) @ (UPRIGHT if is_upright else np.eye(4))
    return Trajectory(stamps_ns=np.arange(60) * 100_000_000, T_world_frame=T)


def svg_text(folder: Path, *arguments: object, **options: object) -> str:
    path = folder / "plot.svg"
    plot_trajectories(path, *arguments, **options)  # type: ignore[arg-type]
    return path.read_text()


def test_equal_input_gives_equal_files(tmp_path: Path) -> None:
    for suffix in ("png", "pdf", "svg"):
        paths = [tmp_path / f"{n}.{suffix}" for n in range(2)]
        for path in paths:
            plot_trajectories(path, curve(0), {"raw": curve(1), "mine": curve(2)})
        first, second = (path.read_bytes() for path in paths)
        assert first == second
        assert first[:5] in (b"\x89PNG\r", b"%PDF-", b"<?xml")


@pytest.mark.parametrize(
    ("extents", "start", "axes"),
    [
        # the world of a camera, whatever it did
        ((3.0, 9.0, 5.0), 1.0, "xz"),
        # any other has z up, whatever was done in it
        ((3.0, 5.0, 0.2), 1.0, "xy"),
        ((3.0, 0.2, 5.0), 1.0, "xy"),
    ],
)
def test_the_view_is_from_above_as_that_of_the_report(
    tmp_path: Path, extents: tuple[float, float, float], start: float, axes: str
) -> None:
    reference = curve(0, extents=extents, start=start, is_upright=axes == "xy")
    text = svg_text(tmp_path, reference, {"raw": curve(1, extents=extents)})
    assert "".join(axis for axis in "xyz" if f">{axis} [m]</text>" in text) == axes
    # Without a truth, too; the panels beside have the axes as labels once more.
    text = svg_text(tmp_path, None, {"raw": reference})
    assert "".join(axis for axis in "xyz" if text.count(f">{axis} [m]</text>") == 2) == axes
    world = World.of(reference)
    assert "".join("xyz"[axis] for axis in world.ground) == axes
    assert ("xyz"[world.up], world.is_up_negative) == (
        ("y", True) if axes == "xz" else ("z", False)
    )


def test_without_a_reference_the_positions_are_drawn(tmp_path: Path) -> None:
    text = svg_text(tmp_path, None, {"raw": curve(1), "smoothed": curve(2)})
    for label in ("x [m]", "y [m]", "z [m]", "elapsed [s]", "raw", "smoothed"):
        assert f">{label}</text>" in text
    assert "truth" not in text


def test_a_notebook_shows_the_figure_that_is_written(tmp_path: Path) -> None:
    estimates = {"raw": curve(1)}
    shown: Any = plot_trajectories(None, curve(0), estimates)
    written: Any = plot_trajectories(tmp_path / "plot.png", curve(0), estimates)
    pictures = [figure._repr_png_() for figure in (shown, written)]
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["plot.png"]


def test_a_file_of_another_kind_and_nothing_to_draw_are_refused(tmp_path: Path) -> None:
    for name in ("plot.bmp", "plot"):
        with pytest.raises(ConfigurationError, match=r"ending in \.png, \.pdf, \.svg"):
            plot_trajectories(tmp_path / name, None, {"raw": curve(0)})
    (tmp_path / "file").write_text("")
    with pytest.raises(TrajectoryError, match="cannot be written"):
        plot_trajectories(tmp_path / "file" / "plot.png", None, {"raw": curve(0)})
    for estimates in ({}, {"raw": curve(0).select([])}):
        with pytest.raises(ValueError, match="at least one estimate"):
            plot_trajectories(tmp_path / "plot.png", None, estimates)


def test_the_plane_of_positions_is_that_of_their_motion(tmp_path: Path) -> None:
    """They begin with an identity that means nothing: it makes no world of a camera."""
    path = curve(0, extents=(3.0, 5.0, 0.5))
    path = path.moved(se3.invert(path.T_world_frame[0]))
    points = Trajectory.of_positions(path.stamps_ns, path.positions)
    axes = {
        name: [letter for letter in "xyz" if f">{letter} [m]</text>" in text]
        for name, text in (
            ("camera", svg_text(tmp_path, path, {"raw": path})),
            ("points", svg_text(tmp_path, points, {"raw": path})),
        )
    }
    assert axes == {"camera": ["x", "z"], "points": ["x", "y"]}
    assert "raw (ATE" in svg_text(tmp_path, points, {"raw": path})


def test_small_errors_are_in_millimetres_and_loops_that_count_are_marked(tmp_path: Path) -> None:
    truth = curve(0)
    ends = truth.stamps_ns[[-1, -2, -3]], truth.stamps_ns[[0, 1, 2]]
    reasons = np.array(["", "", "too far"], dtype=object)
    loops = {"stamp_ns": ends[0], "reference_ns": ends[1], "reason": reasons}
    text = svg_text(tmp_path, truth, {"raw": truth.moved(np.eye(4))}, align="none", loops=loops)
    assert "loops (2)" in text
    assert "position error [mm]" in text
    far = np.eye(4)
    far[0, 3] = 3.0
    text = svg_text(tmp_path, truth, {"raw": truth.moved(far)}, align="none")
    assert "loops" not in text
    assert "raw (ATE 3 m)" in text
