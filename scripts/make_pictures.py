"""Draw the pictures of docs/ that show what `gvo` shows, from a rendered drive.

The page of `gvo view` needs chromium and selenium, and is left out with a message without them.

Example: python scripts/make_pictures.py --out docs
"""

import argparse
import importlib.util
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

import gvo
from gvo.config import Config
from gvo.diagnostics.explain import explain_frame
from gvo.errors import GvoError, RecordingError
from gvo.io.run_folder.reader import read_run
from gvo.odometry.odometry import Odometry
from gvo.runs.outputs.options import RunOutputs
from gvo.types import Frame
from gvo.viz.explanation.pictures import draw_pictures
from gvo.viz.figures import style
from gvo.viz.overlay import compose_overlay
from gvo.viz.report import write_run_report
from gvo.viz.view import serve
from gvo.viz.view.player import Player

if TYPE_CHECKING:
    from selenium.webdriver import Chrome
    from selenium.webdriver.remote.webelement import WebElement

Picture = npt.NDArray[np.uint8]  # shape (height, width, 3), BGR

MAX_BYTES = 250_000
MAX_GREY_SPREAD = 24  # of red, green and blue, of a pixel that counts as grey
N_COLOURS = 120
WINDOW_PX = (1440, 1010)
FROM_CAM, TO_CAM = np.array([4.0, -4.5, -10.0]), np.array([-0.5, 0.5, 4.0])
"""From where and at what the page looks, metres, beside the camera and its heading."""
N_CORNERS = 60, 250, 1000
INLIER_BGR = (233, 180, 86)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a graphics card, of which the page would complain
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--hide-scrollbars",
)
HIDE_COMPLAINT = """
const style = document.createElement('style');
style.textContent = '[class*=Notification-root] { display: none !important; }';
document.head.append(style);
"""
SHOWN_FRAME = "return (document.querySelector('[data-gvo=frame]') || {}).textContent || ''"


class Task(NamedTuple):
    """What is drawn: a recording, a frame of it, a folder for what is needed on the way."""

    bag: Path
    frame: int
    folder: Path


def main() -> None:
    """Parse the arguments, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write")
    parser.add_argument("--only", choices=PICTURES, action="append", help="repeatable")
    parser.add_argument("--recording", type=Path, help="in place of the rendered drive")
    parser.add_argument("--frame", type=int, default=60, metavar="N", help="which one is shown")
    arguments = parser.parse_args()
    if arguments.frame < 1:
        parser.error("--frame must be at least 1: the first frame has no matches")
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        bag = arguments.recording or Path(name) / "drive.mcap"
        if arguments.recording is None:
            gvo.convert(gvo.SyntheticRecording("driving", "stereo"), bag)
        task = Task(bag, arguments.frame, Path(name))
        for kind in arguments.only or PICTURES:
            picture = PICTURES[kind](task)
            if picture is not None:
                write(picture, arguments.out / f"{kind}.png")


def explain(task: Task) -> Picture:
    """Return the stereo matches of a frame explained."""
    source = gvo.open_recording(task.bag)
    if source.info.sensor != "stereo":
        raise RecordingError(f"{task.bag}: expected a stereo recording, got {source.info.sensor}")
    with style():
        measured = draw_pictures(explain_frame(source, task.frame, config=Config()))[0]
        return scaled(decoded(measured.png()), 860)


def report(task: Task) -> Picture:
    """Return two plots of the report: drift by length, errors within their covariances."""
    run, plots = task.folder / "run", task.folder / "plots"
    gvo.run_recording(gvo.open_recording(task.bag), run, outputs=RunOutputs(report=False))
    write_run_report(run / "report.html", read_run(run), plots=plots)
    shown = [read(plots / f"{name}.png") for name in ("06_drift", "07_covariance")]
    return scaled(np.concatenate(shown), 1200)


def overlay(task: Task) -> Picture:
    """Return one picture of the film."""
    source, config = gvo.open_recording(task.bag), Config()
    odometry = Odometry(source.info.camera, config)
    for index, frame in enumerate(gvo.frames(source, config)):
        if isinstance(frame, gvo.FaultyFrame):
            continue
        result = odometry.track(frame)
        if index >= task.frame:
            return compose_overlay(frame, result, source.info.camera, index=index, max_width=940)
    raise RecordingError(f"{task.bag}: no usable frame from {task.frame} on")


def corners(task: Task) -> Picture:
    """Return the inliers of a frame, and the error up to it, at several numbers of corners."""
    rows = []
    for n_corners in N_CORNERS:
        config = gvo.load_configuration(settings=[f"klt.n_corners={n_corners}"])
        source = gvo.open_recording(task.bag, config=config)
        odometry, truth = Odometry(source.info.camera, config), source.ground_truth()
        frames = [
            frame
            for frame in islice(gvo.frames(source, config), task.frame + 1)
            if not isinstance(frame, gvo.FaultyFrame)
        ]
        if truth is None or not frames:
            raise RecordingError(f"{task.bag}: expected sound frames with a ground truth")
        results = [odometry.track(frame) for frame in frames]
        estimates = [estimate for result in results for estimate in result.finished]
        trajectory = gvo.Trajectory.of([*estimates, *odometry.finish()])
        ate_m = gvo.evaluate(truth, trajectory, name="smoothed").ate_m
        text = (
            f"klt.n_corners={n_corners}: {results[-1].n_inliers} inliers, ATE {1e3 * ate_m:.1f} mm"
        )
        rows.append(with_inliers(frames[-1], results[-1], text))
    return scaled(np.concatenate(rows), 860)


def with_inliers(frame: Frame, result: gvo.FrameResult, text: str) -> Picture:
    """Return the left or colour image with the points that its pose rests on, titled."""
    grey = frame.left if isinstance(frame, gvo.StereoFrame) else frame.image
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if result.registration is not None:
        found = result.registration
        for pixel in np.rint(found.pixels_current[found.inliers]).astype(int):
            cv2.circle(picture, (int(pixel[0]), int(pixel[1])), 4, INLIER_BGR, -1, cv2.LINE_AA)
    title = np.full((34, picture.shape[1], 3), 255, dtype=np.uint8)
    cv2.putText(title, text, (4, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 2, cv2.LINE_AA)
    return np.concatenate([title, picture])


def view(task: Task) -> Picture | None:
    """Return the page in the browser, paused at a frame, parameters unfolded."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    if importlib.util.find_spec("selenium") is None:
        missing.append("selenium")
    if missing:
        print(f"make_pictures: no view.png: {', '.join(missing)} missing", file=sys.stderr)
        return None
    truth = gvo.open_recording(task.bag).ground_truth()
    with (
        Player(lambda config: gvo.open_recording(task.bag, config=config), Config()) as player,
        serve(player, port=0, truth=truth) as page,
    ):
        for _ in range(task.frame):  # the page itself asks for the first one
            player.step()
        player.wait()
        driver = open_page(page.url)
        try:
            wait_until(lambda: str(driver.execute_script(SHOWN_FRAME)).startswith(f"{task.frame} "))
            driver.execute_script(HIDE_COMPLAINT)
            for title in ("Parameters", "klt"):
                unfold(driver, title)
            if player.newest.view() is None:
                raise RecordingError(f"{task.bag}: {player.fault}")
            for client in page.server.get_clients().values():
                client.camera.position, client.camera.look_at = FROM_CAM, TO_CAM
            time.sleep(3.0)  # the page draws on its own time
            return decoded(driver.get_screenshot_as_png())
        finally:
            driver.quit()


PICTURES: dict[str, Callable[[Task], Picture | None]] = {
    "explain": explain,
    "report": report,
    "overlay": overlay,
    "corners": corners,
    "view": view,
}


def open_page(url: str) -> "Chrome":
    """Return a browser without a window, at an address."""
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in FLAGS:
        options.add_argument(flag)
    driver = Chrome(options=options, service=Service(shutil.which("chromedriver") or ""))
    driver.set_window_size(*WINDOW_PX)
    driver.get(url)
    return driver


def unfold(driver: "Chrome", title: str) -> None:
    """Open a folder of controls."""
    path = f"//*[normalize-space(text())='{title}']"

    def shown() -> list["WebElement"]:
        return [found for found in driver.find_elements("xpath", path) if found.is_displayed()]

    wait_until(lambda: len(shown()) > 0)
    driver.execute_script("arguments[0].click()", shown()[-1])
    time.sleep(1.0)


def wait_until(condition: Callable[[], bool], *, seconds: float = 60.0) -> None:
    """Wait for what the page shows."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise GvoError("the page did not show the frame")
        time.sleep(0.1)


def read(path: Path) -> Picture:
    """Return the pixels of a file."""
    return decoded(path.read_bytes())


def decoded(content: bytes) -> Picture:
    """Return the pixels of a PNG."""
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise GvoError("a picture cannot be decoded")
    return pixels.astype(np.uint8)


def scaled(picture: Picture, width: int) -> Picture:
    """Return a picture so many pixels wide."""
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def write(picture: Picture, path: Path) -> None:
    """Write a PNG with as many greys as keep it small; lines and marks keep their colours."""
    for n_greys in (128, 64, 32, 24, 16):
        buffer = io.BytesIO()
        with_palette(picture[:, :, ::-1], n_greys).save(buffer, format="png", optimize=True)
        if buffer.tell() < MAX_BYTES:
            break
    path.write_bytes(buffer.getvalue())
    size = f"{picture.shape[1]}x{picture.shape[0]}"
    print(f"wrote {path}: {size}, {n_greys} greys, {buffer.tell()} bytes")


def with_palette(rgb: Picture, n_greys: int) -> Image.Image:
    """Return a picture of n_greys greys and some colours."""
    are_coloured = np.ptp(rgb, axis=2) > MAX_GREY_SPREAD
    grey = rgb.mean(axis=2)
    indices = np.rint(grey * (n_greys - 1) / 255.0).astype(np.uint8)
    palette = np.repeat(np.linspace(0.0, 255.0, n_greys), 3)
    if are_coloured.any():
        coloured = rgb[are_coloured]
        rare_too = np.unique(coloured // 16 * 16 + 8, axis=0)  # each once, however few its pixels
        few = Image.fromarray(rare_too[np.newaxis]).quantize(N_COLOURS)
        nearest = Image.fromarray(coloured[np.newaxis]).quantize(
            palette=few, dither=Image.Dither.NONE
        )
        indices[are_coloured] = n_greys + np.asarray(nearest)[0]
        palette = np.concatenate([palette, few.getpalette() or []])
    image = Image.fromarray(indices).convert("P")
    image.putpalette(np.rint(palette).astype(int).tolist())
    return image


if __name__ == "__main__":
    try:
        main()
    except GvoError as error:
        print(f"make_pictures: error: {error}", file=sys.stderr)
        sys.exit(2)
