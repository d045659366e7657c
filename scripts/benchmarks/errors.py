"""Errors and NEES of trajectories, on recordings with ground truth or on rendered ones.

Recordings that are named are a row each: errors of the three trajectories, then the NEES of
relative poses. Rendered ones (`--kind K --seeds N`) are a row for each seed, then the median and
the worst of each column. A seed gives the same images on every machine; `--keep DIR` keeps them as
bags. With `--starts N` each recording is run N times, in turn from its first frame k = 0, 1, ...
on and with `ransac.seed` 100 + k, a row each, then the median and the worst.

t_err and r_err are those over KITTI's segments, where the path is long enough for them. The NEES,
e^T C^-1 e per degree of freedom, rotation / translation, is one on average where covariances C
fit the errors e; above one they promise too much. It is taken of the raw chain over 1 s and 5 s,
and of the window between its newest pose and the one about so much older, where it holds one. Named
recordings that are long enough have a second row: against the truth brought to where it fits best.

Example: python scripts/benchmark.py errors kitti_06_start euroc_mh01_start
Example: python scripts/benchmark.py errors --kind rest --seeds 10 --keep rendered
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

import gvo
from gvo.io.recording import Source
from gvo.runs.loop import edge_over, motions_of_window
from gvo.trajectory.consistency import (
    SPANS_S,
    Motions,
    consistency,
    fit_reference,
    motions_of_chain,
)
from gvo.types import Edge

from . import recordings
from .tables import Table, median_and_worst, number

NEES_HEADER = tuple(
    f"NEES {name} {span} s".rjust(15) for name in ("raw", "window") for span in SPANS_S
)
RECORDING_HEADER = (
    "recording",
    "frames",
    "ATE raw [m]",
    "ATE causal [m]",
    "ATE smoothed [m]",
    "t_err raw [%]",
    "t_err smoothed [%]",
    "r_err smoothed [deg/100 m]",
    "path ratio smoothed",
)
# Raw and smoothed of each.
DECIMALS = {"t_err [%]": 3, "r_err [deg/m]": 5, "ATE [m]": 4}
SEED_HEADER = (
    *(f"{error} {name}" for error in DECIMALS for name in ("raw", "smoothed")),
    *NEES_HEADER,
)


class Measured(NamedTuple):
    """Errors of raw, causal and smoothed; mean NEES of rotation and translation, n x 2.

    Those are against the truth as it is; fitted, if there are any, once its place and delay are.
    """

    evaluations: dict[str, gvo.Evaluation]
    nees: list[tuple[float, float]]
    fitted: list[tuple[float, float]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    recordings.add_options(parser)
    parser.add_argument(
        "--starts", type=recordings.at_least(1), default=0, metavar="N", help="runs of each one"
    )


def measure(arguments: argparse.Namespace) -> None:
    """Print the tables that are asked for."""
    sources = list(recordings.named(arguments))
    if sources and not arguments.starts:
        print_recordings(sources, arguments.set)
    elif sources:
        for source in sources:
            print(f"\n{source.info.name}, {arguments.starts} starts")
            runs = of_starts("", source, arguments)
            print_rows("start", runs)
    if arguments.seeds:
        kind = recordings.KINDS[arguments.kind]
        sensor, n_frames = arguments.sensor or kind.sensor, arguments.frames or kind.n_frames
        print(f"\n{arguments.kind}, {sensor}, {n_frames} frames, readout {arguments.readout:g} ms")
        print_rows("seed", of_seeds(arguments))


def of_seeds(arguments: argparse.Namespace) -> Iterator[tuple[str, Measured]]:
    """Yield what each seed gave, with its name."""
    for seed in arguments.seeds:
        source = recordings.of_seed(arguments, seed)
        if arguments.starts:
            yield from of_starts(f"{seed}, ", source, arguments)
        else:
            yield str(seed), errors_of(source, arguments.set)


def of_starts(
    prefix: str, source: Source, arguments: argparse.Namespace
) -> Iterator[tuple[str, Measured]]:
    """Yield what each start of a recording gave, with its name."""
    for start in range(arguments.starts):
        settings = [*arguments.set, f"ransac.seed={100 + start}"]
        yield f"{prefix}{start}", errors_of(source, settings, first=start)


def errors_of(source: Source, settings: Sequence[str], *, first: int = 0) -> Measured:
    """Run odometry over a recording and compare it with the truth."""
    truth = recordings.truth_of(source)
    run = recordings.Run(source, gvo.load_configuration(settings=settings), first=first)
    in_window: dict[int, list[tuple[int, Edge]]] = {span: [] for span in SPANS_S}
    for result in run.track():
        for span, edges in in_window.items():
            edge = edge_over(run.odometry.window, result.stamp_ns, span * 10**9)
            if edge is not None:
                edges.append((result.stamp_ns, edge))
    trajectories = run.trajectories()
    of_window = [motions_of_window(edges) for edges in in_window.values()]
    of_chain = [motions_of_chain(trajectories["raw"], span_s) for span_s in SPANS_S]
    motions, reference = [*of_chain, *of_window], fit_reference(truth, of_window[0])
    segments = {"segments": [20.0, 50.0], "segment_step": 1}
    return Measured(
        evaluations={
            name: gvo.evaluate(truth, t, name=name, **segments) for name, t in trajectories.items()
        },
        nees=[mean_nees(truth, each) for each in motions],
        fitted=[
            mean_nees(reference.corrected(truth), each) for each in motions if reference is not None
        ],
    )


def mean_nees(truth: gvo.Trajectory, motions: Motions) -> tuple[float, float]:
    """Return the mean NEES of rotation and of translation, NaN where there is none."""
    compared = consistency(truth, motions)
    return (np.nan, np.nan) if compared is None else compared.mean_nees()[:2]


def print_recordings(sources: Sequence[Source], settings: Sequence[str]) -> None:
    """Print a row of errors for each recording, then a row of NEES."""
    names = [source.info.name for source in sources]
    table, nees = Table(RECORDING_HEADER, names), dict[str, list[tuple[float, float]]]()
    for name, source in zip(names, sources, strict=True):
        measured = errors_of(source, settings)
        nees |= {name: measured.nees, f"{name}, fitted": measured.fitted}
        table.add([name, *error_cells(measured.evaluations)])
    table = Table(("recording", *NEES_HEADER), [*nees])
    for name, pairs in nees.items():
        if pairs:
            table.add([name, *nees_cells(pairs)])


def error_cells(evaluations: dict[str, gvo.Evaluation]) -> list[str]:
    """Return the cells of a recording's errors."""
    raw, causal, smoothed = evaluations.values()
    return [
        str(smoothed.n),
        number(raw.ate_m, 4),
        number(causal.ate_m, 4),
        number(smoothed.ate_m, 4),
        number(raw.t_pct, 2),
        number(smoothed.t_pct, 2),
        number(smoothed.r_deg_per_100m, 2),
        number(smoothed.path_ratio, 4),
    ]


def nees_cells(pairs: Iterable[Sequence[float]]) -> list[str]:
    """Return the cells of NEES, rotation / translation."""
    return [f"{number(rotation, 2)} / {number(translation, 2)}" for rotation, translation in pairs]


def print_rows(column: str, runs: Iterable[tuple[str, Measured]]) -> None:
    """Print a row for each run, then what they say together."""
    table, found = Table((column, *SEED_HEADER), ["median"]), []
    for name, measured in runs:
        found.append([*raw_and_smoothed(measured.evaluations), *np.ravel(measured.nees)])
        table.add([name, *cells(found[-1])])
    for name, figures in median_and_worst(found).items():
        table.add([name, *cells(figures)])
    n_better = sum(smoothed <= raw for *_, raw, smoothed in (row[:6] for row in found))
    print(f"\nsmoothed ATE <= raw ATE on {n_better} of {len(found)}")


def raw_and_smoothed(evaluations: dict[str, gvo.Evaluation]) -> list[float]:
    """Return t_err in %, r_err in deg/m and ATE in m, raw and smoothed in turn."""
    rows = []
    for each in (evaluations["raw"], evaluations["smoothed"]):
        r_err = None if each.r_deg_per_100m is None else 0.01 * each.r_deg_per_100m
        rows.append([each.t_pct, r_err, each.ate_m])
    found: list[float] = np.array(rows, dtype=np.float64).T.ravel().tolist()
    return found


def cells(figures: Sequence[float]) -> list[str]:
    """Return the cells of a row, behind its name."""
    decimals = np.repeat([*DECIMALS.values()], 2).tolist()
    written = [number(value, n) for value, n in zip(figures, decimals, strict=False)]
    pairs = np.reshape(figures[len(decimals) :], (-1, 2)).tolist()
    return [*written, *nees_cells(pairs)]
