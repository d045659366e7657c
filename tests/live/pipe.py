"""`gvo live -` in a process of its own, and what it reads."""

from __future__ import annotations

import json
import subprocess
import threading
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from gvo.io.recording import RecordingInfo, Source, StampedImage
from tests.conftest import GVO

LIMIT_S = 60.0


class LiveCommand:
    """The command, and what is said by it; it is ended where it says nothing for too long."""

    def __init__(self, info: RecordingInfo, folder: Path, *options: str) -> None:
        self.out = folder / "out"
        given = [f"--calibration={path}" for path in write_calibration(info, folder)]
        fixed = ["--rectified", "--no-report", "--queue=1000", f"--out={self.out}"]
        pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen([*GVO, "live", "-", *given, *fixed, *options], **pipes)
        self._timer = threading.Timer(LIMIT_S, self.process.kill)
        self._timer.start()

    def __enter__(self) -> LiveCommand:
        return self

    def __exit__(self, *exception: object) -> None:
        self._timer.cancel()
        self.process.kill()
        self.process.communicate()

    def said(self, ending: str) -> str:
        """Return what is before the end of the next line on stderr that ends so."""
        for line in _open(self.process.stderr):
            before, found, _ = line.decode().rstrip().rpartition(ending)
            if found:
                return before.strip()
        raise AssertionError(f"gvo live ended and did not say: {ending}")

    def send(self, images: bytes) -> None:
        stdin = _open(self.process.stdin)
        stdin.write(images)
        stdin.flush()

    def end(self) -> tuple[int, str, str]:
        """Close its standard input; return its exit code, and what else it says."""
        out, err = self.process.communicate()
        return self.process.returncode, out.decode(), err.decode()


def _open(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None
    return stream


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
