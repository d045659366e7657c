"""Judge loop closure, which benchmark.py calls: global poses beside smoothed ones, and each loop.

One line for each recording with ground truth: ATE of smoothed and of global; how well a second
visit knows where the first one was; how many loops were registered, accepted and wrong. A visit is
a pose whose nearest one, by the truth, lies within 2 m and 20 degrees and was passed more than
10 s before; its error is that of the relative pose of the two. A loop is wrong where it is off by
more than 0.5 m or 5 degrees, and unlikely where it is off by more than 5 sigma of its covariance.

`--drift P` lets the focal length of the images breathe by 1.2 P % either way, once in 40 s, as that
of a lens in the sun, which no calibration tells: a lap of 40 s then does not close by some P % of
its length, and nothing in the covariances says so. `--dark A-B` blackens the images from A to B
seconds after the first. Errors are then those of the frames that are tracked in the dark
recording, beside the global ones of the unbroken one.

Example: python scripts/benchmark.py --loops --seeds 10 --kind block --drift 1 --keep rendered
Example: python scripts/benchmark.py --loops --dark 1-2 rgbd_dataset_freiburg1_rpy_part
"""

import csv
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import benchmark_seeds  # type: ignore[import-not-found]  # beside this one
import benchmark_tables as tables  # type: ignore[import-not-found]
import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import gvo
from gvo.geometry import se3
from gvo.io.recording import Source
from gvo.io.run_folder.reader import RunRecord, read_run
from gvo.testing.faults import Black, FaultyImage, FaultySource, PixelFault, Pixels
from gvo.trajectory.alignment import associate
from gvo.trajectory.g2o import Measurement, parse_line
from gvo.types import FloatArray, IntArray

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
UNBROKEN_HEADER = ("segments", "ATE unbroken [m]", "global / unbroken")


@dataclass(frozen=True, kw_only=True)
class Spoiling:
    """What is done to the images.

    Parameters
    ----------
    dark_s : (float, float), optional
        From when to when they are black, seconds since the first.
    drift : float
        Percent of a lap that it does not close by, about.
    """

    dark_s: tuple[float, float] | None = None
    drift: float = 0.0

    def drifting(self, source: Source) -> Source:
        """Return the recording with the drift alone."""
        return FaultySource(source, Breathing(amount=0.012 * self.drift)) if self.drift else source

    def darkened(self, source: Source) -> Source:
        """Return the recording with the drift, and black for a while."""
        source = self.drifting(source)
        if self.dark_s is None:
            return source
        stamps_s = 1e-9 * (stamps := stamps_of(source))
        first, end = np.searchsorted(stamps_s - stamps_s[0], self.dark_s).tolist()
        if not 0 < first < end < len(stamps):
            raise gvo.GvoError(
                f"--dark: expected a time within the {stamps_s[-1] - stamps_s[0]:.1f} s of "
                f"{source.info.name}, got {self.dark_s[0]:g}-{self.dark_s[1]:g}"
            )
        return FaultySource(source, Black(first=first, end=end))


@dataclass(frozen=True, slots=True, kw_only=True)
class Breathing(PixelFault):
    """A focal length that is longer and shorter than the calibration says, in turn.

    Parameters
    ----------
    amount : float
        By how much at most.
    """

    amount: float = 0.012

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        """Return the image, magnified about its middle."""
        turns = 1e-9 * image.given.stamp_ns / BREATH_S
        scale = 1.0 + self.amount * np.sin(2.0 * np.pi * turns)
        height, width = pixels.shape[:2]
        M = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0.0, scale)
        is_depth = np.issubdtype(pixels.dtype, np.floating)
        return np.asarray(
            cv2.warpAffine(
                pixels,
                M,
                (width, height),
                flags=cv2.INTER_NEAREST if is_depth else cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
        )


def stamps_of(source: Source) -> IntArray:
    """Return the stamps of the left or colour images."""
    return np.array([image.stamp_ns for image in source.images() if image.stream == 0])


def measure(sources: Iterable[Source], settings: Sequence[str], spoiling: Spoiling) -> None:
    """Print one line for each recording, and what they say together."""
    config = gvo.load_configuration(settings=settings)
    if not config.loops.enabled:
        raise gvo.GvoError("--loops: expected loops.enabled, got false")
    header = [*HEADER, *(UNBROKEN_HEADER if spoiling.dark_s else ())]
    widths = [len(name) for name in header]
    print(f"\n{tables.markdown_table(header, [])}", end="")
    found = []
    for source in sources:
        found.append(judge(source, config, spoiling))
        row = tables.markdown_row(cells(source.info.name, found[-1]), widths)
        print(row, end="", flush=True)
    together = np.array(found)
    for name, summary in (("median", np.median), ("worst", np.max)):
        row = tables.markdown_row(cells(name, benchmark_seeds.known(summary, together)), widths)
        print(row, end="")


def judge(source: Source, config: gvo.Config, spoiling: Spoiling) -> list[float]:
    """Return the figures of a line, NaN where there is none."""
    run = partial(gvo.run_recording, config=config, outputs=gvo.RunOutputs(report=False))
    with tempfile.TemporaryDirectory() as folder:
        run(spoiling.darkened(source), Path(folder) / "run")
        record = read_run(Path(folder) / "run")
        truth = source.ground_truth()
        if truth is None:
            raise gvo.GvoError(f"{source.info.name}: expected a ground truth, found none")
        estimates = [tracked(record, each) for each in record.comparable().values()]
        n_tracked = min(map(len, estimates))
        if "global" not in record.trajectories or n_tracked < MIN_TRACKED:
            print(f"{source.info.name}, {n_tracked} frames tracked:", *record.summary["warnings"])
            return [np.nan] * (len(HEADER) + 1 + (len(UNBROKEN_HEADER) if spoiling.dark_s else 0))
        estimates = [tracked(record, record.comparable()[name]) for name in ("smoothed", "global")]
        ates = [gvo.evaluate(truth, estimate, name="").ate_m for estimate in estimates]
        figures = [
            *(*ates, ates[1] / ates[0]),
            *of_visits(truth, estimates),
            *of_loops(truth, record.folder),
        ]
        if spoiling.dark_s is not None:
            run(spoiling.drifting(source), Path(folder) / "unbroken")
            unbroken = read_run(Path(folder) / "unbroken")
            estimate = tracked(record, unbroken.comparable()["global"])
            ate = gvo.evaluate(truth, estimate, name="").ate_m
            n_apart = sum(each["joined_to"] is None for each in record.summary["segments"])
            figures += [n_apart, ate, ates[1] / ate]
    return figures


def tracked(record: RunRecord, trajectory: gvo.Trajectory) -> gvo.Trajectory:
    """Return the poses of frames that were registered."""
    is_tracked = np.isin(record.frames["status"].astype(str), ("ok", "resumed"))
    return trajectory.select(np.isin(trajectory.stamps_ns, record.frames["stamp_ns"][is_tracked]))


def of_visits(truth: gvo.Trajectory, estimates: Sequence[gvo.Trajectory]) -> list[float]:
    """Return their number; the error of each estimate in metres and degrees; the metres' ratio."""
    errors = []
    for estimate in estimates:
        known, used = associate(truth, estimate)
        true, T = truth.select(known), estimate.T_world_frame[used]
        earlier, later = visits(true)
        if len(later) == 0:
            return [0, *[np.nan] * 5]
        seen = relative(true.T_world_frame, earlier, later)
        off = se3.invert(seen) @ relative(T, earlier, later)
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


def of_loops(truth: gvo.Trajectory, folder: Path) -> list[float]:
    """Count the loops whose truth is known: registered, wrong; accepted, wrong, unlikely."""
    with (folder / "loops.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if len(truth.interpolate(ends_of(row))) == 2]
    off = np.array([error_of(row, truth) for row in rows]).reshape(-1, 4, 4)
    is_wrong = (lengths(off) > WRONG_M) | (se3.rotation_angle(off) > WRONG_RAD)
    is_accepted = np.array([not row["reason"] for row in rows], dtype=np.bool_)
    covariances = covariances_of(folder / "graph.g2o", rows)
    sigmas = [
        np.sqrt(se3.mahalanobis(se3.log(T), covariances[k]))
        for k, T in enumerate(off)
        if is_accepted[k]
    ]
    return [
        len(rows),
        int(is_wrong.sum()),
        int(is_accepted.sum()),
        int((is_wrong & is_accepted).sum()),
        int(np.sum(np.array(sigmas) > UNLIKELY_SIGMAS)),
    ]


def error_of(row: dict[str, str], truth: gvo.Trajectory) -> FloatArray:
    """Return the error of a loop, in its frame."""
    T = measured(row)
    T_reference, T_frame = truth.interpolate(ends_of(row)).T_world_frame
    return np.asarray(se3.invert(se3.invert(T_reference) @ T_frame) @ T)


def ends_of(row: dict[str, str]) -> IntArray:
    """Return the stamps of a loop, those of the reference first."""
    return np.array([int(row["reference_ns"]), int(row["stamp_ns"])])


def measured(row: dict[str, str]) -> FloatArray:
    """Return the pose of a loop's frame in its reference."""
    position = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
    quaternion_xyzw = [float(row[name]) for name in ("qx", "qy", "qz", "qw")]
    return se3.make_transform(Rotation.from_quat(quaternion_xyzw).as_matrix(), np.array(position))


def covariances_of(path: Path, rows: Sequence[dict[str, str]]) -> dict[int, FloatArray]:
    """Return the covariances of the accepted loops, by their rows."""
    lines = [parse_line(text.partition("#")[0]) for text in path.read_text().splitlines()]
    edges = [line for line in lines if isinstance(line, Measurement)]
    poses = np.array([edge.T_reference_frame for edge in edges])
    found = {}
    for k, row in enumerate(rows):
        if not row["reason"]:
            distances = np.abs(poses - measured(row)).max(axis=(1, 2))
            found[k] = edges[int(distances.argmin())].covariance
    return found


def cells(name: str, figures: Sequence[float]) -> list[str]:
    """Return the cells of a line of the table."""
    values = [float(value) for value in figures]

    def text(value: float, n_decimals: int) -> str:
        return str(tables.number(None if np.isnan(value) else value, n_decimals))

    smoothed_m, smoothed_deg, global_m, global_deg = values[4:8]
    return [
        name,
        *(text(value, 4) for value in values[:2]),
        text(values[2], 2),
        text(values[3], 0),
        f"{text(smoothed_m, 4)}, {text(smoothed_deg, 3)}",
        f"{text(global_m, 4)}, {text(global_deg, 3)}",
        text(values[8], 2),
        *(text(value, 0) for value in values[9:14]),
        *(text(value, n) for value, n in zip(values[14:], (0, 4, 2), strict=False)),
    ]
