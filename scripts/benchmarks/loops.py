"""Judge loop closure: global poses beside smoothed ones, and each loop, against the truth.

One row for each recording: ATE of smoothed and of global; how well a second visit knows where the
first one was; how many loops were registered, accepted and wrong. A visit is a pose whose nearest
one, by the truth, lies within 2 m and 20 degrees and was passed more than 10 s before; its error is
that of the relative pose of the two. A loop is wrong where it is off by more than 0.5 m or 5
degrees, and unlikely where it is off by more than 5 sigma of its covariance.

`--drift P` lets the focal length of the images breathe by 1.2 P % either way, once in 40 s, as that
of a lens in the sun, which no calibration tells: a lap of 40 s then does not close by some P % of
its length, and nothing in the covariances says so. `--dark A-B` blackens the images from A to B
seconds after the first. Errors are then those of the frames that are tracked in the dark
recording, beside the global ones of the unbroken one. Besides, of the frame half a second after the
light: how much of what the last frame before the dark saw is in its view, and how far it is off
relative to that frame, in the dark run and in the unbroken one.

Example: python scripts/benchmark.py loops --seeds 10 --kind block --drift 1 --keep rendered
Example: python scripts/benchmark.py loops --dark 1-2 rgbd_dataset_freiburg1_rpy_part
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

import gvo
from gvo.frontend.descriptor import as_stereo
from gvo.geometry import se3
from gvo.io.recording import Source
from gvo.odometry.keyframes import view_overlap
from gvo.runs.statistics import RunStatistics
from gvo.testing.faults import Black, FaultyImage, FaultySource, PixelFault, Pixels
from gvo.trajectory.alignment import associate
from gvo.types import FloatArray, IntArray, Loop, Status

from . import recordings
from .tables import Table, median_and_worst, number

VISIT_M, VISIT_RAD, VISIT_S = 2.0, np.radians(20.0), 10.0
WRONG_M, WRONG_RAD, UNLIKELY_SIGMAS = 0.5, np.radians(5.0), 5.0
BREATH_S = 40.0
# Poses that a trajectory is aligned by.
MIN_TRACKED = 3
HEADER = (
    "recording",
    "ATE smoothed [m]",
    "ATE global [m]",
    "global / smoothed",
    "visits",
    "visit smoothed [m, deg]",
    "visit global [m, deg]",
    "global / smoothed",
    "registered",
    "wrong",
    "accepted",
    "wrong",
    "> 5 sigma",
)
UNBROKEN_HEADER = (
    "segments",
    "ATE unbroken [m]",
    "global / unbroken",
    "in view again",
    "then causal [m]",
    "unbroken",
    "then smoothed [m]",
    "unbroken",
)
UNBROKEN_DIGITS = (0, 4, 2, 2, 4, 4, 4, 4)
AFTER_DARK_S = 0.5
N_FIGURES = len(HEADER) + 1  # two columns hold two, and the name is none


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    recordings.add_options(parser)
    parser.add_argument(
        "--drift", type=percent, default=0.0, metavar="P", help="0 to 5 %% of a lap"
    )
    parser.add_argument("--dark", type=span, metavar="A-B", help="seconds without light")


def percent(text: str) -> float:
    """Return how many percent a lap is not to close by."""
    if not 0.0 <= float(text) <= 5.0:
        raise ValueError(text)
    return float(text)


def span(text: str) -> tuple[float, float]:
    """Return from when to when, seconds."""
    first, end = map(float, text.split("-"))
    return first, end


def measure(arguments: argparse.Namespace) -> None:
    """Print one row for each recording, and what they say together."""
    config = gvo.load_configuration(settings=arguments.set)
    if not config.loops.enabled:
        raise gvo.GvoError("expected loops.enabled, got false")
    table = Table([*HEADER, *(UNBROKEN_HEADER if arguments.dark else ())])
    found: list[list[float]] = []
    for source in sources_of(arguments):
        found.append(judge(source, config, arguments))
        table.add(cells(source.info.name, found[-1]))
    for name, figures in median_and_worst(found).items():
        table.add(cells(name, figures))


def sources_of(arguments: argparse.Namespace) -> Iterator[Source]:
    """Yield the recordings that are named, then those of the seeds."""
    yield from recordings.named(arguments)
    for seed in arguments.seeds:
        yield recordings.of_seed(arguments, seed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Breathing(PixelFault):
    """A focal length that is longer and shorter than calibrated, in turn, by a share at most."""

    amount: float

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        """Return the image, magnified about its middle."""
        turns = 1e-9 * image.given.stamp_ns / BREATH_S
        scale = 1.0 + self.amount * np.sin(2.0 * np.pi * turns)
        height, width = pixels.shape[:2]
        M = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0.0, scale)
        return np.asarray(
            cv2.warpAffine(pixels, M, (width, height), borderMode=cv2.BORDER_REPLICATE)
        )


def drifting(source: Source, drift: float) -> Source:
    """Return the recording of a lens that breathes."""
    return FaultySource(source, Breathing(amount=0.012 * drift)) if drift else source


def darkened(source: Source, dark_s: tuple[float, float]) -> FaultySource:
    """Return the recording, black from when to when."""
    stamps_ns = [image.stamp_ns for image in source.images() if image.stream == 0]
    since_s = 1e-9 * (np.array(stamps_ns) - stamps_ns[0])
    first, end = np.searchsorted(since_s, dark_s).tolist()
    if not 0 < first < end < len(since_s):
        raise gvo.GvoError(
            f"--dark: expected a time within the {since_s[-1]:.1f} s of {source.info.name}, "
            f"got {dark_s[0]:g}-{dark_s[1]:g}"
        )
    return FaultySource(source, Black(first=first, end=end))


def judge(source: Source, config: gvo.Config, arguments: argparse.Namespace) -> list[float]:
    """Return the figures of a row, NaN where there is none."""
    truth, bright = recordings.truth_of(source), drifting(source, arguments.drift)
    run = track(darkened(bright, arguments.dark) if arguments.dark else bright, config)
    tied_ns = [r.stamp_ns for r in run.results if r.status in (Status.OK, Status.RESUMED)]
    optimum = run.odometry.optimize()
    found = run.trajectories() | {"global": gvo.Trajectory.of(optimum.estimates)}
    both = found["smoothed"], found["global"]
    estimates = [each.select(np.isin(each.stamps_ns, tied_ns)) for each in both]
    if min(map(len, estimates)) < MIN_TRACKED:
        return [np.nan] * (N_FIGURES + (len(UNBROKEN_HEADER) if arguments.dark else 0))
    ates = [gvo.evaluate(truth, estimate, name="").ate_m for estimate in estimates]
    figures = [*ates, ates[1] / ates[0], *of_visits(truth, estimates)]
    figures += of_loops(truth, optimum.loops)
    if arguments.dark:
        unbroken = track(bright, config)
        whole = unbroken.trajectories()
        whole["global"] = gvo.Trajectory.of(unbroken.odometry.optimize().estimates)
        estimate = whole["global"].select(np.isin(whole["global"].stamps_ns, tied_ns))
        ate = gvo.evaluate(truth, estimate, name="").ate_m
        figures += [n_segments(run.results), ate, ates[1] / ate]
        figures += after_dark(truth, source, unbroken, (found, whole), arguments.dark)
    return figures


def after_dark(
    truth: gvo.Trajectory,
    source: Source,
    unbroken: recordings.Run,
    runs: Sequence[dict[str, gvo.Trajectory]],
    dark_s: tuple[float, float],
) -> list[float]:
    """Return what is in view again after the dark, and how far causal and smoothed are off then."""
    stamps_ns = np.array([result.stamp_ns for result in unbroken.results])
    since_s = 1e-9 * (stamps_ns - stamps_ns[0])
    before, after = np.searchsorted(since_s, (dark_s[0], dark_s[1] + AFTER_DARK_S)) - (1, 0)
    if after >= len(stamps_ns):
        return [np.nan] * 5
    ends_ns = stamps_ns[[before, after]]
    known, seen = truth.interpolate(ends_ns), unbroken.results[before].registration
    if len(known) < 2 or seen is None:
        return [np.nan] * 5
    T = se3.invert(known.T_world_frame[1]) @ known.T_world_frame[0]
    camera = as_stereo(source.info.camera)
    figures = [float(view_overlap(seen.points_current[seen.inliers], T, camera))]
    for name in ("causal", "smoothed"):
        for trajectories in runs:
            ends = trajectories[name].select(np.isin(trajectories[name].stamps_ns, ends_ns))
            T_ends = se3.invert(ends.T_world_frame[0]) @ ends.T_world_frame[1]
            figures.append(float(lengths(T @ T_ends)))
    return figures


def track(source: Source, config: gvo.Config) -> recordings.Run:
    """Run odometry over a recording to its end."""
    run = recordings.Run(source, config)
    for _ in run.track():
        pass
    return run


def n_segments(results: Sequence[gvo.FrameResult]) -> int:
    """Return how many segments are not joined to an earlier one."""
    statistics = RunStatistics()
    for result in results:
        statistics.add_result(result)
    return sum(segment.joined_to is None for segment in statistics.segments.values())


def of_visits(truth: gvo.Trajectory, estimates: Sequence[gvo.Trajectory]) -> list[float]:
    """Return their number; the error of each estimate in metres and degrees; the metres' ratio."""
    errors = []
    for estimate in estimates:
        known, used = associate(truth, estimate)
        true, T = truth.select(known), estimate.T_world_frame[used]
        earlier, later = visits(true)
        if len(later) == 0:
            return [0, *[np.nan] * 5]
        off = se3.invert(relative(true.T_world_frame, earlier, later)) @ relative(T, earlier, later)
        errors.append((rms(lengths(off)), np.degrees(rms(se3.rotation_angle(off)))))
    return [len(later), *errors[0], *errors[1], errors[1][0] / errors[0][0]]


def visits(true: gvo.Trajectory) -> tuple[IntArray, IntArray]:
    """Return the indices of first and second visits."""
    tree = cKDTree(true.positions)
    pairs = []
    for later, position in enumerate(true.positions):
        candidates = tree.query_ball_point(position, VISIT_M)
        limit = true.stamps_ns[later] - round(1e9 * VISIT_S)
        earlier = np.array([k for k in candidates if true.stamps_ns[k] < limit], dtype=np.int64)
        T = relative(true.T_world_frame, earlier, np.full(len(earlier), later))
        distances = np.where(se3.rotation_angle(T) < VISIT_RAD, lengths(T), np.inf)
        if np.isfinite(distances).any():
            pairs.append((earlier[distances.argmin()], later))
    found = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def relative(T: FloatArray, earlier: IntArray, later: IntArray) -> FloatArray:
    """Return the poses of the later ones in the earlier ones."""
    return np.asarray(se3.invert(T[earlier]) @ T[later])


def lengths(T: FloatArray) -> FloatArray:
    """Return how far transforms shift."""
    return np.asarray(np.linalg.norm(T[..., :3, 3], axis=-1))


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def of_loops(truth: gvo.Trajectory, loops: Sequence[Loop]) -> list[float]:
    """Count the loops whose truth is known: registered, wrong; accepted, wrong, unlikely."""
    rows: list[list[bool]] = []
    for loop in loops:
        known = truth.interpolate(np.array([loop.reference_ns, loop.stamp_ns]))
        if len(known) < 2:
            continue
        T_reference, T_frame = known.T_world_frame
        off = se3.invert(se3.invert(T_reference) @ T_frame) @ loop.T_reference_frame
        is_wrong = bool(lengths(off) > WRONG_M or se3.rotation_angle(off) > WRONG_RAD)
        sigmas = float(np.sqrt(se3.mahalanobis(se3.log(off), loop.covariance)))
        is_accepted = not loop.reason
        is_unlikely = is_accepted and sigmas > UNLIKELY_SIGMAS
        rows.append([True, is_wrong, is_accepted, is_accepted and is_wrong, is_unlikely])
    counts: list[float] = np.array(rows).reshape(-1, 5).sum(axis=0).tolist()
    return counts


def cells(name: str, figures: Sequence[float]) -> list[str]:
    """Return the cells of a row of the table."""
    smoothed_m, smoothed_deg, global_m, global_deg = figures[4:8]
    return [
        name,
        *(number(value, 4) for value in figures[:2]),
        number(figures[2], 2),
        number(figures[3], 0),
        f"{number(smoothed_m, 4)}, {number(smoothed_deg, 3)}",
        f"{number(global_m, 4)}, {number(global_deg, 3)}",
        number(figures[8], 2),
        *(number(value, 0) for value in figures[9:14]),
        *(number(value, n) for value, n in zip(figures[14:], UNBROKEN_DIGITS, strict=False)),
    ]
