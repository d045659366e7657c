"""Passes over one recording, which benchmark.py calls: each in a process of its own.

What a process holds at most, and which threads it has started, can only be told of one that did
nothing else. In every round the whole run and the yardstick follow each other, so that what else
the machine does hits both.
"""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal, ParamSpec, TypeVar, get_args

import cv2
import numpy as np

import gvo
from gvo.config import FrontendConfig
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Sensor, Source
from gvo.runs.summary import peak_memory_mb
from gvo.types import FaultyFrame, Frame, Progress

Estimator = Literal["raw", "causal", "smoothed"]
Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")
# Frames that are tracked before the clock starts: libraries set themselves up on the first ones.
N_WARM_UP = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Stages:
    """What a recording gave, frame by frame.

    Parameters
    ----------
    name : str
        Of the recording.
    n_frames : int
        Usable ones.
    stage_ms : dict of str to list of float
        Milliseconds by stage, one of each frame; `total` leaves reading out.
    evaluations : dict of str to Evaluation
        Of the three trajectories; empty without ground truth.
    """

    name: str
    n_frames: int
    stage_ms: dict[str, list[float]]
    evaluations: dict[Estimator, gvo.Evaluation]


@dataclass(frozen=True, kw_only=True)
class Round:
    """A whole run and the yardstick right after it.

    Parameters
    ----------
    cpu_ms, wall_ms : float
        Of the whole run, per frame: process CPU time and elapsed time.
    yardstick_ms : float
        Process CPU time per frame of the yardstick.
    peak_mb, growth_mb : float
        Peak memory at the last frame, and by how much it is above that of the first third.
    """

    cpu_ms: float
    wall_ms: float
    yardstick_ms: float
    peak_mb: float
    growth_mb: float

    @property
    def cpu_ratio(self) -> float:
        """CPU time per frame as a multiple of the yardstick."""
        return self.cpu_ms / self.yardstick_ms

    @property
    def wall_ratio(self) -> float:
        """Elapsed time per frame as a multiple of the yardstick."""
        return self.wall_ms / self.yardstick_ms


@dataclass(frozen=True, kw_only=True)
class Row:
    """Settings whose errors are compared with others'.

    Parameters
    ----------
    name : str
    settings : tuple of str
        `section.key=value`, on top of those of the command line.
    sensors : tuple of str
        For which they mean something.
    """

    name: str
    settings: tuple[str, ...] = ()
    sensors: tuple[Sensor, ...] = get_args(Sensor)


PLAIN = ("registration.refine=none", "registration.weighting=none")
WEIGHTED = ("registration.refine=none", "registration.weighting=inverse_depth")
REFINED = ("registration.refine=gauss_newton", "registration.weighting=inverse_depth")
ABLATION = (
    Row(name="as set"),
    Row(name="plain Umeyama", settings=PLAIN),
    Row(name="weighted Umeyama", settings=WEIGHTED),
    Row(name="refined", settings=REFINED),
    Row(name="integer disparity", settings=("stereo.subpixel=none",), sensors=("stereo",)),
    Row(name="sub-pixel disparity", settings=("stereo.subpixel=parabola",), sensors=("stereo",)),
    Row(
        name="offset of disparities not estimated",
        settings=("stereo.estimate_offset=false",),
        sensors=("stereo",),
    ),
    Row(name="global shutter, none learnt", settings=("camera.readout_ms=0",)),
    Row(name="without links to keyframes", settings=("window.n_links=1",)),
)


def in_child(
    function: Callable[Arguments, Answer], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Answer:
    """Call a function in a new process and return what it answers."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(function, *arguments, **options).result()


def run_by_stages(path: Path, settings: Sequence[str]) -> Stages:
    """Read and track one frame after the other, timing each stage alone."""
    config = gvo.load_configuration(settings=settings)
    source = gvo.open_recording(path, config=config)
    # Read on this thread, so that decoding does not run beside the stages that are timed.
    alone = gvo.load_configuration(settings=[*settings, "runtime.threads=1"])
    track = Track(source, config)
    stage_ms: dict[str, list[float]] = {"read": []}
    items = gvo.frames(source, alone)
    while True:
        start = time.perf_counter()
        item = next(items, None)
        if item is None:
            break
        if isinstance(item, FaultyFrame):
            continue
        stage_ms["read"].append(1e3 * (time.perf_counter() - start))
        for stage, elapsed in track.add(item).items():
            stage_ms.setdefault(stage, []).append(elapsed)
    evaluations = track.evaluate()
    stage_ms["total"] = track.totals_ms
    return Stages(
        name=source.info.name,
        n_frames=len(track.totals_ms),
        stage_ms=stage_ms,
        evaluations=evaluations,
    )


@dataclass(kw_only=True)
class _Instants:
    """What was read off after each frame of a run."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    peaks_mb: list[float] = field(default_factory=list)

    def note(self, _: Progress | None = None) -> None:
        self.wall_s.append(time.perf_counter())
        self.cpu_s.append(time.process_time())
        self.peaks_mb.append(peak_memory_mb())


def run_whole(path: Path, settings: Sequence[str]) -> Round:
    """Run as `gvo run` does, until the last frame is written; then the yardstick.

    Drawing and comparing with the ground truth come after the last frame, and are not timed.
    """
    config = gvo.load_configuration(settings=settings)
    source = gvo.open_recording(path, config=config)
    warm_up = gvo.Odometry(source.info.camera, config)
    for frame in islice(usable_frames(source, config), N_WARM_UP):
        warm_up.track(frame)
    run_recording = gvo.run_recording  # imports what it needs, as does the command at its start
    instants = _Instants()
    instants.note()
    with tempfile.TemporaryDirectory() as folder:
        run_recording(source, folder, config=config, on_progress=instants.note)
    n_frames = len(instants.wall_s) - 1
    peaks_mb = instants.peaks_mb
    return Round(
        wall_ms=1e3 * (instants.wall_s[-1] - instants.wall_s[0]) / n_frames,
        cpu_ms=1e3 * (instants.cpu_s[-1] - instants.cpu_s[0]) / n_frames,
        yardstick_ms=yardstick_ms(source, settings),
        peak_mb=peaks_mb[-1],
        growth_mb=peaks_mb[-1] - peaks_mb[-(-n_frames // 3)],
    )


def yardstick_ms(source: Source, settings: Sequence[str]) -> float:
    """Return the CPU milliseconds per frame of reading it and of ORB, on one thread.

    ORB has 8 octaves and 2000 features, and is given both images of a pair, or the colour image.
    """
    alone = gvo.load_configuration(settings=[*settings, "runtime.threads=1"])
    orb = cv2.ORB_create(nfeatures=2000, nlevels=8)  # type: ignore[attr-defined]
    n_frames = 0
    with one_opencv_thread():
        for frame in islice(usable_frames(source, alone), N_WARM_UP):
            _detect(orb, frame)
        start = time.process_time()
        for frame in usable_frames(source, alone):
            _detect(orb, frame)
            n_frames += 1
        return 1e3 * (time.process_time() - start) / n_frames


def _detect(orb: cv2.Feature2D, frame: Frame) -> None:
    images = [frame.left, frame.right] if isinstance(frame, gvo.StereoFrame) else [frame.image]
    for image in images:
        orb.detectAndCompute(image, None)


def usable_frames(source: Source, config: gvo.Config) -> Iterator[Frame]:
    """Yield the frames of a recording that are not faulty."""
    return (item for item in gvo.frames(source, config) if not isinstance(item, FaultyFrame))


class Track:
    """Odometry over a recording, keeping all that is needed to tell its errors.

    Parameters
    ----------
    source : Source
    config : Config

    Attributes
    ----------
    odometry : Odometry
    estimates : dict of str to list of Estimate
        Of the three trajectories so far.
    totals_ms : list of float
        Milliseconds of each frame, reading apart.
    """

    def __init__(self, source: Source, config: gvo.Config) -> None:
        self._source = source
        self.odometry = gvo.Odometry(source.info.camera, config)
        self.estimates: dict[Estimator, list[gvo.Estimate]]
        self.estimates = {name: [] for name in get_args(Estimator)}
        self.totals_ms: list[float] = []

    def add(self, frame: Frame) -> dict[str, float]:
        """Take a frame; return its milliseconds by stage."""
        result = self.odometry.track(frame)
        self.estimates["raw"].append(result.raw)
        self.estimates["causal"].append(result.causal)
        self.estimates["smoothed"] += result.finished
        self.totals_ms.append(sum(result.stage_ms.values()))
        return result.stage_ms

    def evaluate(self) -> dict[Estimator, gvo.Evaluation]:
        """End the run; return the errors where the recording holds its truth."""
        if not self.totals_ms:
            raise gvo.GvoError(f"{self._source.info.name}: no usable frame")
        smoothed = [*self.estimates["smoothed"], *self.odometry.finish()]
        self.estimates["smoothed"] = sorted(smoothed, key=lambda estimate: estimate.stamp_ns)
        truth = self._source.ground_truth()
        if truth is None:
            return {}
        return {
            name: gvo.evaluate(truth, gvo.Trajectory.of(estimates), name=name)
            for name, estimates in self.estimates.items()
        }


def ablate(
    path: Path, settings: Sequence[str]
) -> list[tuple[str, dict[Estimator, gvo.Evaluation]]]:
    """Return the errors under each row of settings that suits the sensor, by name."""
    sensor = gvo.open_recording(path, config=gvo.load_configuration(settings=settings)).info.sensor
    found: dict[str, dict[Estimator, gvo.Evaluation]] = {}
    known: dict[str, dict[Estimator, gvo.Evaluation]] = {}
    for row in [*ABLATION, *other_frontends(settings)]:
        if sensor not in row.sensors:
            continue
        config = gvo.load_configuration(settings=[*settings, *row.settings])
        key = config.model_dump_json()  # rows that name the defaults need no second run
        name = row.name
        if key not in known:
            known[key] = _errors(path, config)
            if found and _are_same(known[key], found["as set"]):
                name += " (no effect)"
        found[name] = known[key]
    return list(found.items())


def other_frontends(settings: Sequence[str]) -> list[Row]:
    """Return a row for each front-end but the one that is set."""
    chosen = gvo.load_configuration(settings=settings).frontend.kind
    kinds = get_args(FrontendConfig.model_fields["kind"].annotation)
    return [
        Row(name=f"frontend.kind={kind}", settings=(f"frontend.kind={kind}",))
        for kind in kinds
        if kind != chosen
    ]


def _errors(path: Path, config: gvo.Config) -> dict[Estimator, gvo.Evaluation]:
    source = gvo.open_recording(path, config=config)
    track = Track(source, config)
    for frame in usable_frames(source, config):
        track.add(frame)
    evaluations = track.evaluate()
    if not evaluations:
        raise gvo.GvoError(f"{path}: expected a ground truth for the ablation, found none")
    return evaluations


def _are_same(one: dict[Estimator, gvo.Evaluation], other: dict[Estimator, gvo.Evaluation]) -> bool:
    return all(np.array_equal(one[name].errors_m, other[name].errors_m) for name in one)
