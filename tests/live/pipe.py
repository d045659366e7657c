"""Programs in processes of their own; `gvo live -`, and what it reads."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gvo.io.recording import RecordingInfo, Source, StampedImage
from tests.conftest import ENVIRONMENT, GVO

PATIENCE_S = 90.0  # longer than that of the programs, which then say what they wait for


class Program:
    """A process whose lines of standard output can be waited for; killed where none come."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(command, env=environment, text=True, **pipes)
        self.lines: list[str] = []
        self.errors: list[str] = []
        self._come = threading.Condition()
        self._threads = [
            threading.Thread(target=self._read, args=(self.process.stdout, self.lines)),
            threading.Thread(target=self._read, args=(self.process.stderr, self.errors)),
        ]
        for thread in self._threads:
            thread.start()

    def _read(self, stream: Any, lines: list[str]) -> None:
        with stream:
            for line in stream:
                with self._come:
                    lines.append(line)
                    self._come.notify_all()

    def wait_for(self, text: str, *, n: int = 1, is_output: bool = False) -> str:
        """Return the n-th line that holds a text, of either stream."""
        found: list[str] = []

        def has_come() -> bool:
            lines = self.lines if is_output else (*self.lines, *self.errors)
            found[:] = [line for line in lines if text in line]
            return len(found) >= n

        with self._come:
            is_come = self._come.wait_for(has_come, PATIENCE_S)
        assert is_come, (text, self.lines, self.errors)
        return found[n - 1]

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def interrupt(self, number: signal.Signals = signal.SIGINT) -> int:
        """Send a signal; return the exit code. Its standard input stays open and silent."""
        self.process.send_signal(number)
        self.process.wait(PATIENCE_S)
        return self.end()

    def end(self) -> int:
        """End its standard input, and return the exit code."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        code = self.process.wait(PATIENCE_S)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        return code


class LiveCommand(Program):
    """`gvo live -`, which reads images from its standard input."""

    def __init__(self, info: RecordingInfo, folder: Path, *options: str) -> None:
        self.out = folder / "out"
        given = [f"--calibration={path}" for path in write_calibration(info, folder)]
        fixed = ["--rectified", "--no-report", "--queue=1000", f"--out={self.out}"]
        super().__init__([*GVO, "live", "-", *given, *fixed, *options], ENVIRONMENT)

    def __enter__(self) -> LiveCommand:
        return self

    def __exit__(self, *exception: object) -> None:
        self.process.kill()
        self.end()

    def said(self, ending: str) -> str:
        """Return what is before the end of the first line that ends so."""
        return self.wait_for(f"{ending}\n").rpartition(ending)[0].strip()

    def feed(self, images: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.buffer.write(images)  # type: ignore[attr-defined]
        self.process.stdin.flush()


def names_of(source: Source) -> tuple[str, str]:
    return ("left", "right") if source.info.sensor == "stereo" else ("color", "depth")


def sent(source: Source, *, compressed: str = "") -> bytes:
    """Return the images of a recording as a program would write them into a pipe."""
    names = names_of(source)
    images = source.images()
    return b"".join(sent_image(image, names[image.stream], compressed) for image in images)


def sent_image(image: StampedImage, stream: str, compressed: str = "") -> bytes:
    """Return one image as a program would write it into a pipe."""
    pixels = image.load()
    header: dict[str, object] = {"stream": stream, "stamp_ns": image.stamp_ns}
    if pixels.dtype == np.float32:
        pixels = np.nan_to_num(pixels)
    if compressed and pixels.dtype == np.uint8:
        data = cv2.imencode(f".{compressed}", pixels)[1].tobytes()
        header |= {"format": compressed, "size": len(data)}
    else:
        encoding = {(2, "u"): "mono8", (3, "u"): "bgr8", (2, "f"): "32FC1"}
        height, width = pixels.shape[:2]
        header["encoding"] = encoding[pixels.ndim, pixels.dtype.kind]
        header |= {"width": width, "height": height}
        data = pixels.tobytes()
    return json.dumps(header).encode() + b"\n" + data


def write_calibration(info: RecordingInfo, folder: Path) -> list[Path]:
    paths = []
    for side, camera in zip("lr", info.calibrations, strict=True):
        content = {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_matrix": {"rows": 3, "cols": 3, "data": camera.P[:, :3].ravel().tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": camera.P.ravel().tolist()},
        }
        paths.append(folder / f"{side}.yaml")
        paths[-1].write_text(json.dumps(content))
    return paths
