"""The recordings that are measured: those named, and rendered ones of many seeds."""

import argparse
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, get_args

import gvo
from gvo.io.recording import Sensor, Source
from gvo.io.synthetic import ImuKind, RigError, rendered_imu
from gvo.runs.loop import ImuFeed
from gvo.types import Frame

sys.path.append(str(Path(__file__).parents[2]))  # for the worlds of the tests
from tests.worlds import rendered


class Kind(NamedTuple):
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
    "traffic": Kind("traffic", "stereo", n_frames=120, scale=0.5),
    "wall": Kind("wall", "rgbd", scale=0.5),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name recordings."""
    parser.add_argument("recordings", type=Path, nargs="*", help="bags or data-set folders")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    group = parser.add_argument_group("rendered recordings")
    group.add_argument("--seeds", type=seeds, default=(), metavar="N", help="0 to N - 1; or A-B")
    group.add_argument("--kind", choices=KINDS, default="drive")
    group.add_argument("--sensor", choices=["stereo", "rgbd"], help="default: the kind's")
    group.add_argument("--frames", type=at_least(2), metavar="N", help="default: the kind's")
    group.add_argument("--scale", type=float, metavar="S", help="of the images")
    group.add_argument("--readout", type=float, default=0.0, metavar="MS", help="rolling shutter")
    group.add_argument("--bent", type=float, default=0.0, metavar="PX", help="error of the rig")
    group.add_argument("--others", action="store_true", help="also of what is not considered")
    group.add_argument("--imu", choices=get_args(ImuKind), help="beside the camera")
    group.add_argument("--keep", type=Path, metavar="DIR", help="of bags, written once, then read")


def at_least(least: int) -> Callable[[str], int]:
    """Return a parser of whole numbers that are so large at least."""

    def number(text: str) -> int:
        if int(text) < least:
            raise ValueError(text)
        return int(text)

    return number


def seeds(text: str) -> range:
    """Return so many seeds, or those from a first to a last one."""
    first, dash, last = text.partition("-")
    found = range(int(first), int(last) + 1) if dash else range(int(first))
    if not found:
        raise ValueError(text)
    return found


def named(arguments: argparse.Namespace) -> Iterator[Source]:
    """Yield the recordings that are named."""
    if not arguments.recordings and not arguments.seeds:
        raise gvo.GvoError("expected recordings or --seeds, got neither")
    config = gvo.load_configuration(settings=arguments.set)
    for path in arguments.recordings:
        yield gvo.open_recording(path, config=config)


def of_seed(arguments: argparse.Namespace, seed: int) -> Source:
    """Return the rendered recording of a seed, kept as a bag where that is asked for."""
    kind = KINDS[arguments.kind]
    sensor, options = arguments.sensor or kind.sensor, options_of(arguments, seed)

    def render() -> Source:
        try:
            return rendered(kind.world, sensor, **options)
        except ValueError as error:
            raise gvo.GvoError(f"{arguments.kind}: {error}") from error

    if arguments.keep is None:
        return render()
    name = f"{arguments.kind}-{sensor}-{options['n_frames']}-{options['scale']:g}x"
    name += f"-{arguments.readout:g}ms-{seed}" + f"-{arguments.imu}" * (arguments.imu is not None)
    if arguments.bent:
        name += f"-bent-{arguments.bent:g}px" + "-others" * arguments.others
    path: Path = arguments.keep / f"{name}.mcap"
    if not path.exists():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise gvo.GvoError(f"{path}: cannot be written: {error.strerror}") from error
        gvo.convert(render(), path)
    return gvo.open_recording(path)


def options_of(arguments: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Return how a seed is rendered."""
    kind = KINDS[arguments.kind]
    options: dict[str, Any] = {
        "n_frames": arguments.frames or kind.n_frames,
        "scale": arguments.scale or kind.scale,
        "readout_ms": arguments.readout,
        "seed": seed,
    }
    if size_px := arguments.bent:
        options["rig_error"] = RigError(size_px=size_px, seed=seed, others=arguments.others)
    if arguments.imu is not None:
        options["imu"] = rendered_imu(arguments.imu)
    return options


def truth_of(source: Source) -> gvo.Trajectory:
    """Return the ground truth of a recording."""
    truth = source.ground_truth()
    if truth is None:
        raise gvo.GvoError(f"{source.info.name}: expected a ground truth, found none")
    return truth


def usable_frames(source: Source, config: gvo.Config) -> Iterator[Frame]:
    """Yield the frames of a recording that are not faulty."""
    return (item for item in gvo.frames(source, config) if not isinstance(item, gvo.FaultyFrame))


class Run:
    """Odometry over a recording, from its first frame or a later one on."""

    def __init__(
        self, source: Source, config: gvo.Config, *, first: int = 0, has_imu: bool = False
    ) -> None:
        self.source, self.config, self.first = source, config, first
        stream = source.info.imu if has_imu else None
        imu = None if stream is None else stream.imu
        self.odometry = gvo.Odometry(source.info.camera, config, imu=imu)
        self.samples = ImuFeed((lambda _: iter(())) if stream is None else stream.samples)
        self.results: list[gvo.FrameResult] = []

    def track(self) -> Iterator[gvo.FrameResult]:
        """Track frame after frame; yield what each gave."""
        for frame in islice(usable_frames(self.source, self.config), self.first, None):
            for samples in self.samples.until(frame.stamp_ns):
                self.odometry.add_imu(samples.stamps_ns, samples.gyro, samples.acceleration)
            self.results.append(self.odometry.track(frame))
            yield self.results[-1]
        if not self.results:
            raise gvo.GvoError(f"{self.source.info.name}: no usable frame")

    def trajectories(self) -> dict[str, gvo.Trajectory]:
        """End the run; return raw, causal and smoothed."""
        smoothed = [each for result in self.results for each in result.finished]
        return {
            "raw": gvo.Trajectory.of(result.raw for result in self.results),
            "causal": gvo.Trajectory.of(result.causal for result in self.results),
            "smoothed": gvo.Trajectory.of([*smoothed, *self.odometry.finish()]),
        }
