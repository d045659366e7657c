"""Errors and NEES over rendered recordings of many seeds, which benchmark.py calls.

One line for each seed, then the median and the worst of each column: errors of the raw and of the
smoothed trajectory (t_err and r_err over KITTI's segments, where the path is long enough for
them), and the NEES of relative poses per degree of freedom, rotation / translation (see
consistency.py): of the raw chain over 1 s and 10 s, and between poses of the window so far apart,
where it holds them. A seed gives the same images on every machine; kept as bags they can be read
by other versions of the package.
"""

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # for the worlds of the tests
import benchmark_passes as passes  # type: ignore[import-not-found]  # beside this one
import benchmark_tables as tables  # type: ignore[import-not-found]
import numpy as np
from consistency import chain_of  # type: ignore[import-not-found]

import gvo
from gvo.io.recording import Sensor, Source
from gvo.runs.loop import edge_over, motions_of_window
from gvo.trajectory.evaluation import Motions, consistency, motions_of_chain
from gvo.types import Edge, FloatArray
from tests.worlds import rendered


@dataclass(frozen=True)
class Kind:
    """A world, and what is rendered of it where nothing else is asked for."""

    world: str
    sensor: Sensor
    n_frames: int = 300
    scale: float = 1.0


KINDS = {
    "drive": Kind("driving", "stereo"),
    "hand": Kind("turning", "rgbd"),
    "rest": Kind("hovering", "stereo"),
    "lap": Kind("driving", "stereo", n_frames=560, scale=0.5),
    "room": Kind("handheld", "rgbd", n_frames=600, scale=0.5),
    "block": Kind("block", "stereo", n_frames=600, scale=0.5),
    "facade": Kind("facade", "stereo", scale=0.5),
    "mirror": Kind("mirror", "rgbd", scale=0.5),
    "rooms": Kind("rooms", "rgbd", n_frames=1080, scale=0.5),
}
SPANS_S = (1, 10)
# Raw and smoothed of each.
DECIMALS = {"t_err [%]": 3, "r_err [deg/m]": 5, "ATE [m]": 4}
HEADER = (
    "seed  ",
    *(f"{error} {name}" for error in DECIMALS for name in ("raw", "smoothed")),
    *(f"NEES {name} {span} s".rjust(15) for name in ("raw", "window") for span in SPANS_S),
)


@dataclass(frozen=True, kw_only=True)
class Recordings:
    """What is rendered, but for the seed.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    sensor : {"stereo", "rgbd"}
    n_frames : int
    readout_ms : float
        Of a rolling shutter.
    folder : Path, optional
        Where they are kept as bags, and looked for.
    """

    kind: str
    sensor: Sensor
    n_frames: int
    readout_ms: float
    folder: Path | None

    def of(self, seed: int) -> Source:
        """Return the recording of a seed."""
        if self.folder is None:
            return self.rendered(seed)
        name = f"{self.kind}-{self.sensor}-{self.n_frames}-{self.readout_ms:g}ms-{seed}.mcap"
        path, unfinished = self.folder / name, self.folder / f"unfinished-{name}"
        if not path.exists():
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                unfinished.unlink(missing_ok=True)
                gvo.convert(self.rendered(seed), unfinished)
                unfinished.rename(path)
            except OSError as error:
                raise gvo.GvoError(f"{path}: cannot be written: {error.strerror}") from error
        return gvo.open_recording(path)

    def rendered(self, seed: int) -> Source:
        """Return the recording of a seed, rendered while it is read."""
        try:
            return rendered(
                KINDS[self.kind].world,
                self.sensor,
                n_frames=self.n_frames,
                seed=seed,
                scale=KINDS[self.kind].scale,
                readout_ms=self.readout_ms,
            )
        except ValueError as error:
            raise gvo.GvoError(f"{self.kind}: {error}") from error


def measure(recordings: Recordings, seeds: Sequence[int], settings: Sequence[str]) -> None:
    """Print one line for each seed, and what they say together."""
    widths = [len(name) for name in HEADER]
    print(f"\n{recordings.kind}, {recordings.sensor}, {recordings.n_frames} frames, ", end="")
    print(f"readout {recordings.readout_ms:g} ms\n\n{tables.markdown_table(HEADER, [])}", end="")
    found = []
    for seed in seeds:
        found.append(figures(recordings.of(seed), settings))
        print(tables.markdown_row(cells(str(seed), found[-1]), widths), end="", flush=True)
    together = np.array(found)
    for name, summary in (("median", np.median), ("worst", np.max)):
        print(tables.markdown_row(cells(name, known(summary, together)), widths), end="")
    raw, smoothed = together[:, 4], together[:, 5]
    print(f"\nsmoothed ATE <= raw ATE on {np.sum(smoothed <= raw)} of {len(found)}")


def figures(source: Source, settings: Sequence[str]) -> FloatArray:
    """Run odometry; return the errors, raw and smoothed in turn, then pairs of NEES.

    NaN where there is none.
    """
    config = gvo.load_configuration(settings=settings)
    track = passes.Track(source, config)
    in_window: dict[int, list[tuple[int, Edge]]] = {span: [] for span in SPANS_S}
    for frame in passes.usable_frames(source, config):
        track.add(frame)
        for span, edges in in_window.items():
            edge = edge_over(track.odometry.window, frame.stamp_ns, span * 10**9)
            if edge is not None:
                edges.append((frame.stamp_ns, edge))
    evaluations = track.evaluate()
    raw = motions_of_chain(chain_of(track.estimates["raw"]))[: len(SPANS_S)]
    windowed = [motions_of_window(edges, name="window") for edges in in_window.values()]
    truth = source.ground_truth()
    return np.array(
        [
            *errors(evaluations["raw"], evaluations["smoothed"]),
            *nees([*raw, *windowed], truth),
        ]
    )


def errors(raw: gvo.Evaluation, smoothed: gvo.Evaluation) -> list[float]:
    """Return t_err in %, r_err in deg/m and ATE in m, raw and smoothed in turn."""
    rows = []
    for each in (raw, smoothed):
        r_err = None if each.r_deg_per_100m is None else 0.01 * each.r_deg_per_100m
        rows.append([each.t_pct, r_err, each.ate_m])
    return np.array(rows, dtype=np.float64).T.ravel().tolist()


def nees(kinds: Iterable[Motions], truth: gvo.Trajectory | None) -> list[float]:
    """Return the mean NEES of rotation and translation of each kind of relative poses."""
    means: list[float] = []
    for motions in kinds:
        compared = None if truth is None else consistency(truth, motions)
        means += (np.nan, np.nan) if compared is None else compared.mean_nees()
    return means


def known(summary: Callable[[FloatArray], float], rows: FloatArray) -> FloatArray:
    """Summarize each column by those of its figures that are known."""
    columns = [column[np.isfinite(column)] for column in rows.T]
    return np.array([summary(column) if column.size else np.nan for column in columns])


def cells(name: str, row: FloatArray) -> list[str]:
    """Return the cells of a line of the table."""

    def text(value: float, n_decimals: int) -> str:
        return "-" if np.isnan(value) else f"{value:.{n_decimals}f}"

    decimals = [n for n in DECIMALS.values() for _ in ("raw", "smoothed")]
    written = [text(value, n) for value, n in zip(row, decimals, strict=False)]
    pairs = row[len(decimals) :].reshape(-1, 2)
    return [name, *written, *(f"{text(r, 2)} / {text(t, 2)}" for r, t in pairs)]
