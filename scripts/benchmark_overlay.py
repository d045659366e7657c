"""Time a run with the film of its matches against one without, in turns.

What counts is how much longer a frame takes; the film is drawn and encoded by a thread of its own
beside the run. Drawing and encoding are also timed alone, on one thread, as CPU time.

Example: python scripts/benchmark_overlay.py drive.mcap
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import gvo
from gvo.io.excerpt import Excerpt
from gvo.io.frames import one_opencv_thread
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.runs.loop import RunLoop
from gvo.runs.outputs.video import RunOverlay, film_width
from gvo.types import FaultyFrame, Frame, FrameResult
from gvo.viz.overlay import compose_overlay
from gvo.viz.video import open_sink

Spent = tuple[float, float]  # milliseconds per frame: wall, CPU


def main() -> None:
    """Parse the arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each, in turns")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds of each")
    parser.add_argument("--suffix", choices=[".webm", ".mp4"], default=".webm")
    arguments = parser.parse_args()
    if arguments.rounds < 1 or arguments.duration <= 0.0:
        parser.error("--rounds must be at least 1 and --duration positive")
    excerpt = Excerpt(duration_s=arguments.duration)
    print("| recording | frames | film | draw ms | encode ms | without ms | with ms | slower ms |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for n, recording in enumerate(arguments.recordings):
            film = Path(folder) / f"{n}{arguments.suffix}"
            print(measure(recording, excerpt, arguments.rounds, film))


def measure(recording: Path, excerpt: Excerpt, n_rounds: int, film: Path) -> str:
    """Return one line of the table, milliseconds per frame: CPU alone, wall of the runs."""
    source = gvo.open_recording(recording)
    pairs = track(source, excerpt)
    draw_ms, encode_ms, size = time_alone(source, pairs, film)
    without, with_film = [], []
    for _ in range(n_rounds):
        without.append(time_run(source, excerpt, None))
        with_film.append(time_run(source, excerpt, film))
    slower = statistics.median(b - a for a, b in zip(without, with_film, strict=True))
    runs = f"{statistics.median(without):.1f} | {statistics.median(with_film):.1f}"
    name = f"{source.info.name} | {len(pairs)} | {size[0]}x{size[1]}"
    return f"| {name} | {draw_ms:.1f} | {encode_ms:.1f} | {runs} | {slower:.1f} |"


def track(source: Source, excerpt: Excerpt) -> list[tuple[Frame, FrameResult]]:
    """Return the frames and what they give."""
    config = gvo.load_configuration()
    odometry = Odometry(source.info.camera, config)
    with one_opencv_thread():
        found = gvo.frames(source, config, excerpt)
        return [(f, odometry.track(f)) for f in found if not isinstance(f, FaultyFrame)]


def time_alone(
    source: Source, pairs: list[tuple[Frame, FrameResult]], film: Path
) -> tuple[float, float, tuple[int, int]]:
    """Return milliseconds of CPU per frame to draw and to encode, and width and height."""
    drawing = encoding = 0.0
    sink = open_sink(film)
    camera = source.info.camera
    width = film_width(camera)
    with one_opencv_thread():
        for frame, result in pairs:
            start = time.process_time()
            picture = compose_overlay(frame, result, camera, max_width=width)
            drawn = time.process_time()
            sink.add(picture, frame.stamp_ns)
            drawing += drawn - start
            encoding += time.process_time() - drawn
        start = time.process_time()
        sink.close()
        encoding += time.process_time() - start
    film.unlink()
    per_frame = 1e3 / len(pairs)
    return per_frame * drawing, per_frame * encoding, (picture.shape[1], picture.shape[0])


def time_run(source: Source, excerpt: Excerpt, film: Path | None) -> float:
    """Return wall milliseconds per frame of a whole run."""
    loop = RunLoop(
        source, gvo.load_configuration(), BaseFrame(source.info.frame_id), excerpt=excerpt
    )
    start = time.perf_counter()
    if film is None:
        loop.run([], None)
    else:
        with RunOverlay(film, source.info.camera) as output:
            loop.run([output], None)
    elapsed_ms = 1e3 * (time.perf_counter() - start)
    if film is not None:
        film.unlink()
    return elapsed_ms / loop.statistics.n_frames


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"benchmark_overlay: error: {error}", file=sys.stderr)
        sys.exit(2)
