"""The picture of a round trip: what is in it, not how it looks."""

from pathlib import Path

import numpy as np
import pytest

from gvo.errors import TrajectoryError
from gvo.trajectory.round_trip import RoundTripError, round_trip_error
from gvo.trajectory.trajectory import Trajectory
from gvo.viz import plots
from gvo.viz.plots import plot_round_trip

_N = 9000


def round_trip(gap_m: float, n: int = _N) -> RoundTripError:
    poses = np.tile(np.eye(4), (2 * n - 1, 1, 1))
    poses[:, 2, 3] = [*range(n), *range(n - 2, -1, -1)]
    poses[n:, 0, 3] = gap_m
    stamps_ns = 100_000_000 * np.arange(1 - n, n)
    found = round_trip_error(Trajectory(stamps_ns=stamps_ns, T_world_frame=poses), 0)
    assert isinstance(found, RoundTripError)
    return found


@pytest.fixture
def errors() -> dict[str, RoundTripError]:
    return {"raw": round_trip(0.5), "causal": round_trip(0.25), "smoothed": round_trip(0.25)}


def test_the_picture_holds_both_ways_and_the_gap(errors: dict[str, RoundTripError]) -> None:
    figure = plots._draw_round_trip(errors)
    view, end, metres, degrees = figure.axes
    solid = [line for line in view.lines if line.get_linestyle() == "-"]
    dashed = [line for line in view.lines if line.get_linestyle() == "--"]
    assert [line.get_color() for line in solid] == ["#E69F00", "#56B4E9", "#009E73"]
    assert [line.get_color() for line in dashed] == ["#E69F00", "#56B4E9", "#009E73"]
    assert view.get_aspect() == end.get_aspect() == 1.0
    assert solid[0].get_xydata()[-1] == pytest.approx([0.0, _N - 1.0])  # type: ignore[index]
    marks = [line for line in end.lines if line.get_marker() == "s"]
    assert [float(line.get_xdata()[0]) for line in marks] == [0.5, 0.25, 0.25]  # type: ignore[index, arg-type]
    # drawn with fewer points than there are, the ends among them
    drawn = metres.lines[0].get_xydata()
    assert len(drawn) < _N  # type: ignore[arg-type]
    assert drawn[0] == pytest.approx([-0.1 * (_N - 1), 0.5])  # type: ignore[index]
    assert drawn[-1] == pytest.approx([0.0, 0.0])  # type: ignore[index]
    assert degrees.get_ylim()[0] == 0.0
    for axes in figure.axes:
        assert axes is metres or axes.get_xlabel().endswith("]")
        assert axes.get_ylabel().endswith("]")


def test_equal_input_gives_equal_files(errors: dict[str, RoundTripError], tmp_path: Path) -> None:
    for name in "ab":
        plot_round_trip(tmp_path / f"{name}.png", errors)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_drive_that_goes_nowhere_can_be_drawn(tmp_path: Path) -> None:
    plot_round_trip(tmp_path / "still.png", {"of another name": round_trip(0.0, n=2)})
    assert (tmp_path / "still.png").stat().st_size > 0


def test_an_unwritable_file_is_named(errors: dict[str, RoundTripError], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TrajectoryError, match=r"file/a\.png: cannot be written"):
        plot_round_trip(tmp_path / "file/a.png", errors)
    with pytest.raises(ValueError, match="at least one trajectory"):
        plot_round_trip(tmp_path / "a.png", {})
