"""Run odometry on an endless rendered drive, and look whether it ages.

A small lap is rendered once and driven round and round through `gvo run`, or with `--live` through
the standard input of `gvo live -`. It fails where memory or CPU time of the last tenth is more than
a tenth above that of the second; with `--live` also where frames are lost or threads become more.

Example: python tests/quality/soak.py --frames 20000
Example: python tests/quality/soak.py --live --frames 108000
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil  # type: ignore[import-untyped]

import gvo
from gvo.io.recording import StampedImage
from gvo.io.synthetic import SensorNoise, SyntheticRecording
from gvo.io.synthetic.world import WORLDS
from gvo.io.synthetic.worlds.motion import LAP_M, drive_along
from gvo.types import FloatArray

# All tenths of 10,000 frames see the same road.
N_LAP = 500
STEP_NS = 33_333_333
START_NS = 1_000_000_000
N_TENTHS = 10
N_AHEAD = 5
MAX_GROWTH = 1.1
HEADER = "tenth  RSS [MB]  threads  CPU [ms]"


def lap(seconds: FloatArray) -> FloatArray:
    """Return T_map_cam of a car that drives a lap of N_LAP frames at even speed."""
    return drive_along(seconds, LAP_M / N_LAP * 10.0 * seconds, shake=0.0)


class EndlessDrive:
    """A stereo recording that goes round a rendered lap, its stamps always on.

    `order`: the frames of the lap that are shown in turn.
    """

    def __init__(self, n_frames: int, order: Sequence[int] = range(N_LAP)) -> None:
        world = replace(WORLDS["driving"], name="endless", motion=lambda _: lap)
        noise = SensorNoise(exposure_drift=0.0)
        lap_once = SyntheticRecording(world, n_frames=N_LAP, scale=0.2, noise=noise)
        self._order, self.n_frames = list(order)[:n_frames], n_frames
        images = list(lap_once.images())
        self._pairs = {k: [i.load() for i in images[2 * k : 2 * k + 2]] for k in {*self._order}}
        self.info = replace(lap_once.info, n_images=n_frames)

    def images(self) -> Iterator[StampedImage]:
        for index in range(self.n_frames):
            stamp_ns = START_NS + index * STEP_NS
            for stream, pixels in enumerate(self._pairs[self._order[index % len(self._order)]]):
                yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=pixels.copy)

    def ground_truth(self) -> None:
        return None


class Watch:
    """Prints and keeps a row of figures for each tenth."""

    def __init__(self, n_frames: int, pid: int | None = None) -> None:
        self.rows: list[list[float]] = []
        self._n_tenth = n_frames // N_TENTHS
        self._process = psutil.Process(pid)
        self._spent_s = 0.0
        print(HEADER)

    def note(self, n_done: int) -> None:
        if n_done % self._n_tenth or len(self.rows) == N_TENTHS:
            return
        spent_s = sum(self._process.cpu_times()[:2])
        cpu_ms = 1e3 * (spent_s - self._spent_s) / self._n_tenth
        self._spent_s = spent_s
        memory_mb, n_threads = self._process.memory_info().rss / 2**20, self._process.num_threads()
        self.rows.append([memory_mb, n_threads, cpu_ms])
        print(f"{len(self.rows):5}", *(f"{each:9.1f}" for each in self.rows[-1]), flush=True)

    def faults(self) -> list[str]:
        growths = np.divide(self.rows[-1], self.rows[1])
        named = {"memory": growths[0], "CPU time": growths[2]}
        return [f"{name} x {each:.3f}" for name, each in named.items() if each > MAX_GROWTH]


def soak(n_frames: int, folder: Path) -> list[str]:
    """Drive through `gvo run`; return which bounds are broken."""
    watch = Watch(n_frames)
    drive, outputs = EndlessDrive(n_frames), gvo.RunOutputs(report=False)
    gvo.run_recording(drive, folder, outputs=outputs, on_progress=lambda p: watch.note(p.n_done))
    return watch.faults()


def soak_live(n_frames: int, folder: Path) -> list[str]:
    """Send the drive to `gvo live -`, as fast as frames are tracked."""
    drive, out = EndlessDrive(n_frames), folder / "run"
    sides = dict(zip(("left", "right"), drive.info.calibrations, strict=True))
    size = {key: getattr(sides["left"], key) for key in ("width", "height")}
    cameras = {
        side: size | {key: getattr(each, key).ravel().tolist() for key in "KP"}
        for side, each in sides.items()
    }
    (path := folder / "cameras.yaml").write_text(json.dumps(cameras))
    options = [f"--calibration={path}", "--rectified", "--no-report", f"--out={out}"]
    command = [sys.executable, "-c", "from gvo.cli import main; main()", "live", "-", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        watch, n_rows = Watch(n_frames, process.pid), follow(out / "frames.csv")
        for index, image in enumerate(drive.images()):
            side, header = list(sides)[image.stream], {"stamp_ns": image.stamp_ns, **size}
            line = json.dumps({"stream": side, "encoding": "mono8", **header})
            process.stdin.write(line.encode() + b"\n" + image.load().tobytes())
            process.stdin.flush()
            if image.stream == 1:
                watch.note(index // 2 + 1)
                while process.poll() is None and next(n_rows) < index // 2 - N_AHEAD:
                    time.sleep(0.001)
        process.stdin.close()
    n_tracked = json.loads((out / "summary.json").read_text())["tracked"]
    lost = [f"{n_frames - n_tracked} frames lost"] if n_tracked < n_frames else []
    more = watch.rows[-1][1] - watch.rows[1][1]
    # One may be at work on the map.
    return [*watch.faults(), *lost, *([f"{more} threads more"] if more > 1 else [])]


def follow(path: Path) -> Iterator[int]:
    """Yield, without end, how many lines a growing file has by now."""
    while not path.exists():
        yield 0
    n_lines = 0
    with path.open("rb") as file:
        while True:
            n_lines += file.read().count(b"\n")
            yield n_lines


def main() -> None:
    """Parse the arguments, drive, and fail where a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000, metavar="N")
    parser.add_argument("--live", action="store_true", help="through the input of gvo live -")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        faults = (soak_live if arguments.live else soak)(arguments.frames, Path(folder))
    if faults:
        sys.exit("soak: " + "; ".join(faults))


if __name__ == "__main__":
    main()
