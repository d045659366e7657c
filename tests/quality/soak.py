"""Run odometry on an endless rendered drive, and look whether it ages.

A lap around a block is rendered once, at low resolution, and driven round and round: the whole
path of `gvo run` without its report. For each tenth of the frames it prints the resident memory at
its end, milliseconds per frame (median of the elapsed, mean of the CPU time), bytes of the run
folder per frame, and threads. It fails where memory or CPU time of the last tenth is more than a
tenth above that of the second. CPU time, because that says less of what else the machine does.

With `--live` the images go into the standard input of `gvo live -`, a process of its own that is
measured, stamped at 30 Hz and sent as fast as they are tracked. It fails where one is lost, too, or
threads become more.

Example: python tests/quality/soak.py --frames 20000
Example: python tests/quality/soak.py --live --frames 108000
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import psutil  # type: ignore[import-untyped]

import gvo
from gvo.config import load_configuration
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.geometry.se3 import invert, make_transform
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.io.synthetic.recording import SensorNoise, expose
from gvo.io.synthetic.rendering import render_image, to_uint8
from gvo.io.synthetic.worlds.motion import CAMERA_HEIGHT_M, LAP_M, heading, road_point
from gvo.io.synthetic.worlds.street import street
from gvo.runs.summary import peak_memory_mb
from gvo.types import FloatArray, ImageArray, Progress

# A length of lap that goes into a tenth of 10,000 or 2,000 frames: all tenths see the same road.
N_LAP = 500
STEP_NS = 100_000_000
LIVE_STEP_NS = 33_333_333
START_NS = 1_000_000_000
CAMERA = PinholeCamera(fx=141.4, fy=141.4, cx=120.0, cy=36.2, width=245, height=74)
BASELINE_M = 0.53715
MAX_GROWTH = 1.1
N_TENTHS = 10
N_AHEAD = 5
LIVE = [sys.executable, "-c", "from gvo.cli import main; main()", "live", "-"]


def lap_poses(n_lap: int) -> FloatArray:
    """Return T_map_cam, shape (n_lap, 4, 4), of a car at even speed; after the last the first.

    Parameters
    ----------
    n_lap : int
        Frames of a lap.
    """
    s = LAP_M * np.arange(n_lap) / n_lap
    psi, zeros = heading(s), np.zeros(n_lap)
    right = np.stack([np.cos(psi), np.sin(psi), zeros], axis=-1)
    forward = np.stack([-np.sin(psi), np.cos(psi), zeros], axis=-1)
    down = np.tile([0.0, 0.0, -1.0], (n_lap, 1))
    # The road is uneven: waves that close with the lap.
    turns = 2.0 * np.pi * np.arange(n_lap) / n_lap
    heights = CAMERA_HEIGHT_M + 0.012 * np.sin(63 * turns) + 0.008 * np.sin(97 * turns)
    position = np.column_stack([road_point(s), heights])
    return np.asarray(make_transform(np.stack([right, down, forward], axis=-1), position))


class EndlessDrive:
    """A stereo recording that goes round a rendered lap, its stamps always on.

    Parameters
    ----------
    n_frames : int
        How far.
    T_map_cam : ndarray of float64, shape (n, 4, 4), optional
        Poses of a lap, the first of which follows on the last.
    step_ns : int
        Between two frames.
    """

    def __init__(
        self, n_frames: int, *, T_map_cam: FloatArray | None = None, step_ns: int = STEP_NS
    ) -> None:
        self.n_frames, self._step_ns = n_frames, step_ns
        self._T_map_cam = lap_poses(N_LAP) if T_map_cam is None else T_map_cam
        self._pairs = list(render_lap(self._T_map_cam[:n_frames]))

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        right = Calibration.from_camera(CAMERA, baseline=BASELINE_M)
        return RecordingInfo(
            name="endless-drive",
            sensor="stereo",
            calibrations=(Calibration.from_camera(CAMERA), right),
            n_images=self.n_frames,
        )

    def images(self) -> Iterator[StampedImage]:
        for index in range(self.n_frames):
            pair = self._pairs[index % len(self._T_map_cam)]
            for stream, image in enumerate(pair):
                yield StampedImage(
                    stream=stream, stamp_ns=START_NS + index * self._step_ns, load=image.copy
                )

    def ground_truth(self) -> gvo.Trajectory:
        """Return the exact T_world_cam; each lap is on top of the one before."""
        T_lap = invert(self._T_map_cam[0]) @ self._T_map_cam
        T_lap[0] = np.eye(4)
        indices = np.arange(self.n_frames, dtype=np.int64)
        return gvo.Trajectory(
            stamps_ns=START_NS + indices * self._step_ns, T_world_frame=T_lap[indices % len(T_lap)]
        )


def render_lap(T_map_cam: FloatArray) -> Iterator[tuple[ImageArray, ImageArray]]:
    """Yield the left and the right image at each pose."""
    scene, noise = street(0), SensorNoise(exposure_drift=0.0)
    T_left_right = make_transform(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
    for index, T_map_left in enumerate(T_map_cam):
        grey = [render_image(scene, T, CAMERA) for T in (T_map_left, T_map_left @ T_left_right)]
        left, right = (
            to_uint8(
                expose(
                    image,
                    noise,
                    np.random.default_rng([index, stream]),
                    stream=stream,
                    elapsed_s=0.0,
                )
            )
            for stream, image in enumerate(grey)
        )
        yield left, right


@dataclass(frozen=True, slots=True, kw_only=True)
class Tenth:
    """What a tenth of the frames cost.

    Parameters
    ----------
    memory_mb : float
        Resident at its end, 2^20 bytes.
    elapsed_ms, cpu_ms : float
        Per frame: the median, and the mean over all threads.
    n_bytes : float
        Written into the run folder, per frame.
    n_threads : int
        At its end.
    """

    memory_mb: float
    elapsed_ms: float
    cpu_ms: float
    n_bytes: float
    n_threads: int


class Watch:
    """Measures tenth after tenth, called after each frame; what it keeps does not grow.

    Parameters
    ----------
    n_frames : int
        Frames to come.
    folder : Path
        What is written.
    show : callable
        Is given the number of each tenth and what it cost.
    pid : int, optional
        Of the process; this one where omitted.
    """

    def __init__(
        self,
        n_frames: int,
        folder: Path,
        show: Callable[[int, Tenth], None],
        pid: int | None = None,
    ) -> None:
        self.tenths: list[Tenth] = []
        self._n_tenth = n_frames // N_TENTHS
        self._folder, self._show = folder, show
        self._process = psutil.Process(pid)
        self._elapsed_s = np.zeros(self._n_tenth)
        self._last_s, self._cpu_s, self._n_bytes = time.perf_counter(), self._spent_s(), 0

    def __call__(self, progress: Progress) -> None:
        """Note that a frame is done."""
        self.note(progress.n_done)

    def note(self, n_done: int) -> None:
        now_s = time.perf_counter()
        self._elapsed_s[(n_done - 1) % self._n_tenth] = now_s - self._last_s
        if n_done % self._n_tenth == 0 and len(self.tenths) < N_TENTHS:
            self._end_tenth()
        self._last_s = time.perf_counter()

    def memory_mb(self) -> float:
        """Return what the process holds now."""
        return float(self._process.memory_info().rss / 2**20)

    def _spent_s(self) -> float:
        return float(sum(self._process.cpu_times()[:2]))

    def _end_tenth(self) -> None:
        cpu_s = self._spent_s()
        n_bytes = sum(path.stat().st_size for path in self._folder.rglob("*") if path.is_file())
        self.tenths.append(
            Tenth(
                memory_mb=self.memory_mb(),
                elapsed_ms=1e3 * float(np.median(self._elapsed_s)),
                cpu_ms=1e3 * (cpu_s - self._cpu_s) / self._n_tenth,
                n_bytes=(n_bytes - self._n_bytes) / self._n_tenth,
                n_threads=self._process.num_threads(),
            )
        )
        self._cpu_s, self._n_bytes = cpu_s, n_bytes
        self._show(len(self.tenths), self.tenths[-1])

    def faults(self) -> list[str]:
        """Return which bounds are broken, a line each."""
        second, last = self.tenths[1], self.tenths[-1]
        growths = {
            "resident memory": last.memory_mb / second.memory_mb,
            "CPU time per frame": last.cpu_ms / second.cpu_ms,
        }
        return [
            f"{name} grew to {growth:.3f} of the second tenth"
            for name, growth in growths.items()
            if growth > MAX_GROWTH
        ]


def show_tenth(number: int, tenth: Tenth) -> None:
    print(
        f"{number:>5} {tenth.memory_mb:>9.1f} {tenth.elapsed_ms:>12.2f} {tenth.cpu_ms:>10.2f} "
        f"{tenth.n_bytes:>10.0f} {tenth.n_threads:>8}",
        flush=True,
    )


HEADER = (
    f"tenth {'RSS [MB]':>9} {'median [ms]':>12} {'CPU [ms]':>10} {'files [B]':>10} {'threads':>8}"
)


def soak(n_frames: int, settings: list[str], folder: Path) -> list[str]:
    """Drive, print what each tenth cost, return which bounds are broken."""
    drive = EndlessDrive(n_frames)
    folder.mkdir(parents=True, exist_ok=True)
    watch = Watch(n_frames, folder, show_tenth)
    print(HEADER)
    result = gvo.run_recording(
        drive,
        folder,
        config=load_configuration(None, settings),
        outputs=gvo.RunOutputs(report=False),
        on_progress=watch,
    )
    summary = result.summary
    last_mb, end_mb = watch.tenths[-1].memory_mb, watch.memory_mb()
    print(
        f"{summary['tracked']} of {summary['frames']} frames tracked; reading, comparing and "
        f"sorting all poses at the end: {end_mb - last_mb:+.1f} MB resident, "
        f"{peak_memory_mb():.0f} MB (10^6 bytes) at the most"
    )
    return watch.faults()


def soak_live(n_frames: int, settings: list[str], folder: Path) -> list[str]:
    """Send the drive to `gvo live -`, likewise; say what was lost, too."""
    drive = EndlessDrive(n_frames, step_ns=LIVE_STEP_NS)
    sides = zip(("left", "right"), drive.info.calibrations, strict=True)
    cameras = {
        side: {key: getattr(each, key).ravel().tolist() for key in "KP"} | SIZE
        for side, each in sides
    }
    calibration = folder / "cameras.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    calibration.write_text(json.dumps(cameras))
    out = folder / "run"
    options = [f"--calibration={calibration}", "--rectified", "--no-report", f"--out={out}"]
    options += [f"--set={setting}" for setting in settings]
    print(HEADER)
    with subprocess.Popen([*LIVE, *options], stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        watch = Watch(n_frames, out, show_tenth, process.pid)
        done = Done(out / "frames.csv")
        for index, image in enumerate(drive.images()):
            n_sent, is_second = divmod(index, 2)
            while not is_second and n_sent - done.count() >= N_AHEAD and process.poll() is None:
                time.sleep(0.001)
            send(image, process.stdin)
            if is_second:
                watch.note(n_sent + 1)
        process.stdin.close()
    if process.returncode != 0:
        return [f"gvo live ended with {process.returncode}"]
    summary = json.loads((out / "summary.json").read_text())
    n_tracked, n_dropped = summary["tracked"], n_frames - summary["frames"]
    print(f"{n_tracked} of {n_frames} frames tracked")
    more = watch.tenths[-1].n_threads - watch.tenths[1].n_threads
    # One may be at work on the map.
    faults = [f"{more} threads more than after the second tenth"] if more > 1 else []
    faults += [f"{n_frames - n_tracked} frames lost"] if n_tracked < n_frames or n_dropped else []
    return [*watch.faults(), *faults]


SIZE = {"width": CAMERA.width, "height": CAMERA.height}


class Done:
    """Counts the frames of a table that grows."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._n_lines = path, 0, 0

    def count(self) -> int:
        if self._path.exists():
            with self._path.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
            self._offset += len(new)
            self._n_lines += new.count(b"\n")
        return max(self._n_lines - 1, 0)


def send(image: StampedImage, stream: IO[bytes]) -> None:
    """Write an image as `gvo live -` reads it."""
    names = {"stream": ("left", "right")[image.stream], "stamp_ns": image.stamp_ns}
    header = names | SIZE | {"encoding": "mono8"}
    stream.write(json.dumps(header).encode() + b"\n" + image.load().tobytes())
    stream.flush()


def main() -> None:
    """Parse the arguments, drive, and fail where a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000, metavar="N")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--live", action="store_true", help="through the input of gvo live -")
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep the run folder here")
    arguments = parser.parse_args()
    if arguments.frames < N_TENTHS:
        parser.error(f"--frames: expected at least {N_TENTHS}, got {arguments.frames}")
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder)
        faults = (soak_live if arguments.live else soak)(arguments.frames, arguments.set, out)
    if faults:
        sys.exit("soak: " + "; ".join(faults))


if __name__ == "__main__":
    main()
