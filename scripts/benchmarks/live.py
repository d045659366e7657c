"""Measure how late poses of a running camera are, and what is dropped where it is too fast.

The frames of a recording come at true times, in a thread of their own as from a driver, first at
10 Hz, then at the recorded rate; each waits until the one before has its pose, so that no queue is
measured. Printed is the time from the last image of a pair to the moment at which its pose in
`/gvo/odom/odometry` goes out, beside decoding and tracking the same frames at the same times one by
one, without anything else; both take turns for some rounds. CPU time, of all threads, says less of
what else the machine does. Somebody listens to every topic, so all clouds and pictures are made.

Then they come there and back at twice the rate of the frames alone: how old a frame is when it is
taken and when its pose goes out, what becomes of each one, and memory.

Example: python scripts/benchmark.py live kitti_06_start
"""

import argparse
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import gvo
from gvo.config import Parameters
from gvo.io.frames import one_opencv_thread, paired
from gvo.io.recording import Source, StampedImage
from gvo.io.sync import Pair
from gvo.live.odometry import LiveOdometry
from gvo.live.transport import Service
from gvo.runs.summary import peak_memory_mb
from gvo.types import FaultyFrame, FloatArray, Progress

from .cost import N_WARM_UP, in_child
from .recordings import at_least

N_MOST = 200  # frames of a recording
N_TOO_MANY = 300  # that come too fast
RATE_HZ = 10.0
MAX_LAG_S = 0.1
ODOMETRY = "/gvo/odom/odometry"
Times: TypeAlias = FloatArray
"""Milliseconds by the clock and of CPU, shape (n, 2)."""


class Instant(NamedTuple):
    """Seconds by the clock, and of CPU."""

    wall_s: float
    cpu_s: float

    @classmethod
    def now(cls) -> "Instant":
        """Read both."""
        return cls(time.monotonic(), time.process_time())


class Feed:
    """Pairs that come at a rate, there and back again, and are stamped by it; notes when."""

    def __init__(
        self,
        source: Source,
        pairs: Sequence[Pair],
        rate_hz: float,
        n_sent: int | None = None,
    ) -> None:
        self.info, self.rate_hz = source.info, rate_hz
        self._pairs = [*islice(cycle([*pairs, *pairs[-2:0:-1]]), n_sent or len(pairs))]
        self.came: dict[int, Instant] = {}
        self.taken: dict[int, Instant] = {}
        self.turn: threading.Semaphore | None = None

    def images(self) -> Iterator[StampedImage]:
        """Yield them when it is time, and their turn."""
        started_s = time.monotonic()
        for number, pair in enumerate(self._pairs):
            due_s, stamp_ns = number / self.rate_hz, round(1e9 * (number + 1) / self.rate_hz)
            time.sleep(max(started_s + due_s - time.monotonic(), 0.0))
            if self.turn is not None:
                self.turn.acquire()
            self.came[stamp_ns] = Instant.now()
            for image in pair:
                yield replace(image, stamp_ns=stamp_ns, load=self._noted(image, stamp_ns))

    def ground_truth(self) -> None:
        """Return None: nothing is compared."""

    def late_ms(self, then: Mapping[int, Instant]) -> Times:
        """Return how long after each pair came something happened, of those it happened to."""
        both = [(came, then[ns]) for ns, came in self.came.items() if ns in then]
        return 1e3 * np.array([np.subtract(end, came) for came, end in both])

    def _noted(self, image: StampedImage, stamp_ns: int) -> Callable[[], NDArray[Any]]:
        def load() -> NDArray[Any]:
            self.taken.setdefault(stamp_ns, Instant.now())
            return image.load()

        return load


class Outlet:
    """A topic that is heard."""

    is_heard = True

    def __init__(self) -> None:
        self.sent: dict[int, Instant] = {}
        self.n_dropped = 0

    def publish(self, data: bytes, stamp_ns: int) -> None:
        """Note when a message came, and whether it tells of a drop."""
        self.sent[stamp_ns] = Instant.now()
        self.n_dropped += b"dropped, tracking is behind" in data


class Listener:
    """A sink that hears every topic."""

    is_ros1 = False

    def __init__(self) -> None:
        self.outlets: dict[str, Outlet] = {}

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> Outlet:
        """Open a topic."""
        return self.outlets.setdefault(topic, Outlet())

    def serve(self, service: Service) -> None:
        """Nobody calls."""

    def offer(self, parameters: Parameters) -> None:
        """Nobody changes them."""

    def close(self) -> None:
        """Nothing is open."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    parser.add_argument("recordings", type=Path, nargs="+", help="bags or data-set folders")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--rounds", type=at_least(1), default=3, metavar="N")


def measure(arguments: argparse.Namespace) -> None:
    """Measure each recording in a process of its own."""
    for path in arguments.recordings:
        in_child(of_recording, path, arguments.set, n_rounds=arguments.rounds)


def of_recording(path: Path, settings: Sequence[str], *, n_rounds: int) -> None:
    """Print latencies of a recording, and what is dropped of it."""
    config = gvo.load_configuration(settings=settings)
    source = gvo.open_recording(path, config=config)
    found = paired(source.images(), source.info.sensor, config.sync)
    pairs = [*islice((each for each in found if not isinstance(each, FaultyFrame)), N_MOST)]
    period_s = 1e-9 * float(np.median(np.diff([first.stamp_ns for first, _ in pairs])))
    print(f"\n{source.info.name}: {len(pairs)} frames")
    print(f"{'':<12} {'median ms':>10} {'95 % ms':>10} {'CPU ms':>10}")
    for rate_hz in dict.fromkeys((RATE_HZ, round(1.0 / period_s))):
        rounds = [
            (
                track_alone(Feed(source, pairs, rate_hz), config),
                track_live(Feed(source, pairs, rate_hz), config),
            )
            for _ in range(n_rounds)
        ]
        alone, live = (np.concatenate(each) for each in zip(*rounds, strict=True))
        print_row("alone", alone)
        print_row(f"at {rate_hz:g} Hz", live)
        wall, cpu = np.median(live, axis=0) / np.median(alone, axis=0)
        print(f"ratio of the medians: {wall:.2f}, of CPU {cpu:.2f}", flush=True)
    rate_hz = 2e3 / float(np.median(alone[:, 0]))
    overload(Feed(source, pairs, rate_hz, N_TOO_MANY), config)


def print_row(name: str, times_ms: Times) -> None:
    """Print median and 95th percentile, and the median of CPU time."""
    wall, cpu = times_ms.T
    print(f"{name:<12} {np.median(wall):>10.1f} {np.percentile(wall, 95):>10.1f} ", end="")
    print(f"{np.median(cpu):>10.1f}")


def track_alone(feed: Feed, config: gvo.Config) -> Times:
    """Return the milliseconds from the last image of each pair until it is tracked, no more."""
    odometry, tracked = gvo.Odometry(feed.info.camera, config), dict[int, Instant]()
    with one_opencv_thread():
        for frame in gvo.frames(feed, config, through=iter):
            odometry.track(frame)
            tracked[frame.stamp_ns] = Instant.now()
    return feed.late_ms(tracked)[N_WARM_UP:]


def track_live(feed: Feed, config: gvo.Config) -> Times:
    """Return the milliseconds from the last image of each pair to its pose."""
    listener, feed.turn = Listener(), threading.Semaphore()
    turn = feed.turn
    with tempfile.TemporaryDirectory() as folder:
        live = LiveOdometry(feed, config, sinks=[listener])
        outputs = gvo.RunOutputs(report=False)
        live.run(folder, outputs=outputs, on_progress=lambda _: turn.release())
    return feed.late_ms(listener.outlets[ODOMETRY].sent)[N_WARM_UP:]


def overload(feed: Feed, config: gvo.Config) -> None:
    """Print what becomes of frames that come too fast; fail where one is not accounted for."""
    listener, peaks_mb, limit = Listener(), list[float](), f"{1e3 * MAX_LAG_S:.0f}"

    def note(_: Progress) -> None:
        peaks_mb.append(peak_memory_mb())

    with tempfile.TemporaryDirectory() as folder:
        live = LiveOdometry(
            *(feed, config), sinks=[listener], max_waiting=N_TOO_MANY, max_lag_s=MAX_LAG_S
        )
        ((_, result),) = live.run(folder, outputs=gvo.RunOutputs(report=False), on_progress=note)
    counts = result.summary["status_counts"]
    n_poses, n_faulty = sum(counts.values()) - counts["skipped"], counts["skipped"]
    n_faulty -= live.n_dropped
    print(f"{len(feed.came)} frames at {feed.rate_hz:.0f} Hz, --max-lag {limit} ms:")
    print_row("taken", feed.late_ms(feed.taken))
    print_row("sent", feed.late_ms(listener.outlets[ODOMETRY].sent))
    print(f"{n_poses} poses, {live.n_dropped} dropped, {n_faulty} faulty")
    growth_mb = peaks_mb[-1] - peaks_mb[len(peaks_mb) // 3]
    print(f"memory: peak {peaks_mb[-1]:.0f} MB, {growth_mb:.1f} MB more than after a third")
    n_told = listener.outlets["/diagnostics"].n_dropped
    if n_told != live.n_dropped or n_poses + live.n_dropped + n_faulty != len(feed.came):
        raise gvo.GvoError(f"{n_told} drops are told; not all frames are accounted for")
