"""Errors at the end of darkness, without and with an IMU.

One row for each recording and darkness: how far the causal pose of the last dark frame is off,
relative to the last frame before, without the IMU (constant velocity) and with it; and how its
covariance fits, e^T C^-1 e per degree of freedom of rotation / translation. Then the median and the
worst of each length. Rendered recordings (`--kind K --seeds N`) get an IMU by `--imu`; others have
their own.

Example: python scripts/benchmark.py dark --kind room --seeds 6 --gaps 1,5 --imu adis16448
Example: python scripts/benchmark.py dark euroc_mh01_imu --from 1.5,3,4,5 --gaps 1,2
"""

import argparse
from collections.abc import Sequence
from itertools import islice

import numpy as np

import gvo
from gvo.geometry import se3
from gvo.io.recording import Source
from gvo.types import FloatArray

from . import loops, recordings
from .tables import Table, median_and_worst, number

HEADER = (
    "recording",
    "dark from [s]",
    "for [s]",
    "without [m]",
    "[deg]",
    "with [m]",
    "[deg]",
    "NEES rotation",
    "translation",
)
DIGITS = 3, 2, 4, 3, 2, 2


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    recordings.add_options(parser)
    parser.add_argument("--from", dest="starts", type=numbers, default=[4.0], metavar="S,S")
    parser.add_argument("--gaps", type=numbers, default=[1.0, 2.0], metavar="S,S")


def numbers(text: str) -> list[float]:
    """Return numbers that commas separate."""
    return [float(part) for part in text.split(",")]


def measure(arguments: argparse.Namespace) -> None:
    """Print one row for each darkness, and what those of a length say together."""
    config = gvo.load_configuration(settings=arguments.set)
    sources = [*recordings.named(arguments)]
    sources += [recordings.of_seed(arguments, seed) for seed in arguments.seeds]
    table, found = Table(HEADER), dict[float, list[list[float]]]()
    for source in sources:
        for start_s in arguments.starts:
            for length_s in arguments.gaps:
                figures = judge(source, config, start_s, length_s)
                found.setdefault(length_s, []).append(figures)
                table.add(cells(source.info.name, f"{start_s:g}", length_s, figures))
    for length_s, rows in found.items():
        for name, figures in median_and_worst(rows).items():
            table.add(cells(name, "", length_s, figures))


def cells(name: str, start: str, length_s: float, figures: Sequence[float]) -> list[str]:
    """Return a row of the table."""
    values = map(number, figures, DIGITS)
    return [name, start, f"{length_s:g}", *values]


def judge(source: Source, config: gvo.Config, start_s: float, length_s: float) -> list[float]:
    """Return errors without and with the IMU, and the NEES with it."""
    if source.info.imu is None:
        raise gvo.GvoError(f"{source.info.name}: expected an IMU, found none")
    dark = loops.darkened(source, (start_s - 1e-6, start_s + length_s - 1e-6))
    black = dark.faults[0]
    truth = recordings.truth_of(source)
    figures: list[float] = []
    for has_imu in (False, True):
        run = recordings.Run(dark, config, has_imu=has_imu)
        results = [*islice(run.track(), black.end)]
        before, after = results[black.first - 1].causal, results[-1].causal
        T = se3.invert(before.T_world_frame) @ after.T_world_frame
        T_true = motion_of(truth, before.stamp_ns, after.stamp_ns)
        error = se3.log(se3.invert(T) @ T_true)
        figures.append(float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])))
        figures.append(float(np.degrees(np.linalg.norm(error[:3]))))
    # Of the covariance, what the dark added: drift until then cancels.
    before_it = se3.transport_covariance(before.covariance, se3.invert(T))
    grown = after.covariance - before_it
    parts = slice(3), slice(3, 6)
    return [*figures, *(float(se3.mahalanobis(error[k], grown[k, k])) / 3.0 for k in parts)]


def motion_of(truth: gvo.Trajectory, first_ns: int, last_ns: int) -> FloatArray:
    """Return the true pose at a stamp in that at another."""
    first, last = truth.interpolate(np.array([first_ns, last_ns])).T_world_frame
    return np.asarray(se3.invert(first) @ last)
