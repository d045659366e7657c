"""From a recording to frames: decode, check, rectify; repeated images refused."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config, SyncConfig
from gvo.errors import GvoError, RecordingError
from gvo.geometry.camera import Calibration, PinholeCamera, StereoCamera, rectification_maps
from gvo.io.calibration.files import read_cameras
from gvo.io.depth_registration import DepthRegistration
from gvo.io.excerpt import Excerpt, take_excerpt
from gvo.io.images import MILLIMETRES, depth_from_counts, depth_from_metres
from gvo.io.png import compiled_png
from gvo.io.recording import DepthView, RecordingInfo, Sensor, Source, StampedImage
from gvo.io.sync import Paired, StampFilter, pair_images
from gvo.types import DepthArray, FaultyFrame, Frame, ImageArray, RgbdFrame, StereoFrame

_ROW_STEP = 64
_MASK_MARGIN_PX = 5  # half the side of the patches around corners
# Frames that are decoded ahead: with one, the thread idles where tracking a frame takes long.
_N_AHEAD = 2
# What reading or decoding one image may raise besides, in a source of one's own as well.
_LOAD_ERRORS = (OSError, MemoryError, ValueError, cv2.error)
_Preparers: TypeAlias = tuple["ImagePreparer", "ImagePreparer"]
Through: TypeAlias = Callable[[Iterator[Paired]], Iterator[Paired]]
_Pair: TypeAlias = tuple[NDArray[Any], NDArray[Any]]
_Prepared: TypeAlias = NDArray[Any] | str
_Jobs: TypeAlias = Sequence[tuple[Callable[[], _Prepared], Future[_Prepared] | None]]
_Started: TypeAlias = tuple[Paired, _Jobs]


def frames(
    source: Source,
    config: Config | None = None,
    excerpt: Excerpt | None = None,
    *,
    with_unpaired: bool = True,
    through: Through | None = None,
) -> Iterator[Frame | FaultyFrame]:
    """Read a recording as frames.

    Parameters
    ----------
    source : Source
        The recording.
    config : Config, optional
        `sync` decides which images make one frame; with `runtime.threads` above one they are
        decoded two frames ahead. The result does not depend on the number of threads.
    excerpt : Excerpt, optional
        The part that is wanted; the whole where omitted.
    with_unpaired : bool
        False: leave out images that need not pair, see `is_lost`.
    through : callable, optional
        What pairs go through before they are decoded, as the queue of a running camera. Nothing
        is decoded ahead then.

    Yields
    ------
    StereoFrame, RgbdFrame or FaultyFrame
        One for each image of stream 0 in the excerpt, in its order.

    Raises
    ------
    RecordingError
        When the recording cannot be read on; the frames before are yielded first.
    """
    config = config or Config()
    is_live = through is not None
    pairs = paired(source.images(), source.info.sensor, config.sync, is_live=is_live)
    if excerpt is not None:
        pairs = take_excerpt(pairs, excerpt)
    preparers = make_preparers(source.info)
    if through is not None:
        pairs = through(pairs)
    n_ahead = 0 if is_live else _N_AHEAD
    made = _decoded(pairs, preparers, source.info, config.runtime.threads, n_ahead)
    if config.sync.repeated_images == "skip":
        made = refuse_repeats(made, source.info.stream_names)
    for item in made:
        if with_unpaired or not isinstance(item, FaultyFrame) or is_lost(item, source.info.sensor):
            yield item


def is_lost(frame: FaultyFrame, sensor: Sensor) -> bool:
    """Tell whether a faulty frame is a loss, and so a frame of a run without a pose.

    Colour and depth of a free-running RGB-D sensor need not pair; the images of a stereo camera
    are taken together, and one without the other is a loss.
    """
    return not frame.is_unpaired or sensor == "stereo"


def paired(
    images: Iterable[StampedImage],
    sensor: Sensor,
    sync: SyncConfig,
    *,
    limit_ms: float | None = None,
    is_live: bool = False,
) -> Iterator[Paired]:
    """Pair the images of a recording as configured, or within a given limit; see `pair_images`."""
    key = pair_limit_key(sensor)
    limit = float(getattr(sync, key)) if limit_ms is None else limit_ms
    stamps = StampFilter(_readable(images))
    pairs = pair_images(
        stamps.images(),
        limit_ns=round(limit * 1e6),
        partner=f"{'right' if sensor == 'stereo' else 'depth'} image within sync.{key}",
        is_live=is_live,
    )
    for item in pairs:
        yield from stamps.take_faulty()
        yield item
    yield from stamps.take_faulty()


def _readable(images: Iterable[StampedImage]) -> Iterator[StampedImage]:
    try:
        yield from images
    except (OSError, MemoryError) as error:
        raise RecordingError(f"it cannot be read on: {_error_text(error)}") from error


def pair_limit_key(sensor: Sensor) -> str:
    """Return the parameter of `sync` that says how far the stamps of a pair may differ, ms."""
    return "stereo_tolerance_ms" if sensor == "stereo" else "max_difference_ms"


def _decoded(
    items: Iterator[Paired], preparers: _Preparers, info: RecordingInfo, threads: int, n_ahead: int
) -> Iterator[Frame | FaultyFrame]:
    """Yield the frames of pairs, decoded ahead where there are other threads."""
    finish = partial(_finish, make_frame=partial(_frame_of, info.sensor, preparers))
    is_alone = threads == 1
    n_ahead = 0 if is_alone else n_ahead
    started: deque[_Started] = deque()
    with ThreadPoolExecutor(1 if threads <= 2 else 2, thread_name_prefix="decode") as pool:
        try:
            for item in items:
                pair = () if isinstance(item, FaultyFrame) else zip(item, preparers, strict=True)
                jobs = [partial(_prepare, *job, info) for job in pair]
                started.append(
                    (item, [(job, None if is_alone else pool.submit(job)) for job in jobs])
                )
                if len(started) > n_ahead:
                    yield finish(*started.popleft())
        except GvoError:
            # What was read before it counts.
            yield from (finish(*each) for each in started)
            raise
        yield from (finish(*each) for each in started)


def _finish(item: Paired, jobs: _Jobs, make_frame: Callable[..., Frame]) -> Frame | FaultyFrame:
    if isinstance(item, FaultyFrame):
        return item
    # What no other thread has begun is done on this one, which would wait.
    done = [job() if future is None or future.cancel() else future for job, future in jobs]
    first, second = (each.result() if isinstance(each, Future) else each for each in done)
    if isinstance(first, str) or isinstance(second, str):
        reasons = [each for each in (first, second) if isinstance(each, str)]
        return FaultyFrame(stamp_ns=item[0].stamp_ns, reason="; ".join(reasons))
    return make_frame((item[0].stamp_ns, item[1].stamp_ns), (first, second))


def _prepare(image: StampedImage, preparer: ImagePreparer, info: RecordingInfo) -> _Prepared:
    """Return the prepared image, or one line on what is wrong with it."""
    try:
        with compiled_png():
            pixels = image.load()
        return preparer(pixels)
    except (RecordingError, *_LOAD_ERRORS) as error:
        return f"{info.stream_names[image.stream]} image: {_error_text(error)}"


def _frame_of(
    sensor: Sensor, preparers: _Preparers, stamps_ns: tuple[int, int], images: _Pair
) -> Frame:
    (stamp_ns, depth_ns), (first, second) = stamps_ns, images
    mask, right = (prepare.mask for prepare in preparers)
    if sensor == "stereo":
        pair = {"left": first, "right": second}
        return StereoFrame(stamp_ns=stamp_ns, **pair, mask=mask, right_mask=right)
    pair = {"image": first, "depth": second}
    return RgbdFrame(stamp_ns=stamp_ns, **pair, depth_stamp_ns=depth_ns, mask=mask)


def refuse_repeats(
    items: Iterable[Frame | FaultyFrame], names: tuple[str, str]
) -> Iterator[Frame | FaultyFrame]:
    """Make frames faulty whose image is, pixel by pixel, that of the frame before.

    No sensor gives the same noise twice: such an image is old, and the camera would seem to stand
    still. Two in a row make a camera that hangs; a single one, which many drivers give now and
    then, is let through. Depth images are not compared: some sensors give depth at a lower rate
    than colour. Nor are images of one value, in which nothing is seen anyway.
    """
    last: Frame | None = None
    waiting: list[Frame | FaultyFrame] = []  # from the first repeat on
    is_hanging = False
    try:
        for item in items:
            if isinstance(item, FaultyFrame):
                waiting.append(item)
                if not _holds_frame(waiting):
                    yield waiting.pop()
                continue
            repeated = _repeated(last, item, names)
            waiting.append(item)
            if repeated and not is_hanging and not _holds_frame(waiting[:-1]):
                continue
            is_hanging = bool(repeated)
            for frame in waiting:
                yield _refused(frame, repeated) if repeated else frame
            waiting.clear()
            last = last if repeated else item
    except GvoError:
        yield from waiting
        raise
    yield from waiting


def _holds_frame(items: Iterable[Frame | FaultyFrame]) -> bool:
    return any(not isinstance(item, FaultyFrame) for item in items)


def _refused(item: Frame | FaultyFrame, name: str) -> FaultyFrame:
    if isinstance(item, FaultyFrame):
        return item
    reason = (
        f"the {name} image is that of the frame before, pixel by pixel: the camera hangs (one "
        "without noise that stands still: --set sync.repeated_images=keep)"
    )
    return FaultyFrame(stamp_ns=item.stamp_ns, reason=reason)


def _repeated(last: Frame | None, frame: Frame, names: tuple[str, str]) -> str:
    """Name the first stream that shows the same as before; empty where none does."""
    if last is None:
        return ""
    pairs = zip(names, _images(last), _images(frame), strict=False)
    return next((name for name, before, now in pairs if _is_same(before, now)), "")


def _images(frame: Frame) -> tuple[ImageArray, ...]:
    return (frame.left, frame.right) if isinstance(frame, StereoFrame) else (frame.image,)


def _is_same(first: ImageArray, second: ImageArray) -> bool:
    is_alike = np.array_equal(first[::_ROW_STEP], second[::_ROW_STEP])  # a few rows mostly tell
    return is_alike and np.array_equal(first, second) and bool(np.any(first != first[0, 0]))


def make_preparers(info: RecordingInfo) -> _Preparers:
    """Return the preparers of both streams; depth of another camera is registered to colour."""
    masks = info.masks or (None, None)
    first = ImagePreparer(info.calibrations[0], mask=masks[0])
    if info.sensor == "stereo":
        return first, ImagePreparer(info.calibrations[1], mask=masks[1])
    return first, ImagePreparer(info.calibrations[0], is_depth=True, depth_view=info.depth_view)


class Rig:
    """A calibrated camera of your own: makes frames of its raw images.

    Parameters
    ----------
    calibration : str or Path
        A file or a folder in any form that `--calibration` takes; for two files that of the left
        camera.
    right : str or Path, optional
        The file of the right camera, where it has one of its own.
    sensor : {"stereo", "rgbd"}
        What the camera is; of an RGB-D camera the files describe the colour images.
    is_rectified : bool
        The images are rectified already: of a pair with P only that counts.

    Attributes
    ----------
    info : RecordingInfo
        What a recording of this camera has; for a `Source` of your own.
    depth_scale : float
        Counts of depth per metre.

    Raises
    ------
    CalibrationError
        When a file is missing or malformed, or does not describe such a camera.
    """

    def __init__(
        self,
        calibration: str | Path,
        right: str | Path | None = None,
        *,
        sensor: Sensor = "stereo",
        is_rectified: bool = False,
    ) -> None:
        paths = [Path(path) for path in (calibration, right) if path is not None]
        cameras = read_cameras(paths, sensor=sensor, is_rectified=is_rectified)
        self.info = RecordingInfo(
            name=cameras.origin,
            sensor=sensor,
            calibrations=cameras.calibrations,
            n_images=0,
            T_body_cam=cameras.T_body_cam,
        )
        self.depth_scale = cameras.depth_scale or MILLIMETRES
        self._preparers = make_preparers(self.info)

    @property
    def camera(self) -> StereoCamera | PinholeCamera:
        """The camera of the frames, which `Odometry` takes."""
        return self.info.camera

    def frame(self, stamp_ns: int, first: NDArray[Any], second: NDArray[Any]) -> Frame:
        """Return the frame of two images taken together: grey and rectified.

        Parameters
        ----------
        stamp_ns : int
            When they were taken, nanoseconds.
        first : ndarray of uint8, shape (h, w) or (h, w, 3)
            Left or colour image, as the camera gives it; colours in the order of OpenCV (BGR).
        second : ndarray
            Right image likewise; or depth as seen by the colour camera, shape (h, w): uint16 in
            counts (of `depth_scale` in the calibration file, else millimetres) or float in metres.

        Returns
        -------
        StereoFrame or RgbdFrame

        Raises
        ------
        RecordingError
            When size or type are not what the calibration says, or no depth is known.
        """
        if self.info.sensor == "rgbd":
            second = self._metres(np.asarray(second))
        left, right = self._preparers
        stamps_ns, images = (stamp_ns, stamp_ns), (left(first), right(second))
        return _frame_of(self.info.sensor, self._preparers, stamps_ns, images)

    def _metres(self, depth: NDArray[Any]) -> DepthArray:
        if depth.dtype.kind == "f":
            return depth_from_metres(depth)
        return depth_from_counts(depth, self.depth_scale, "depth image")


class ImagePreparer:
    """Prepares the raw pixels of one stream for a frame: checks, makes grey, rectifies.

    Depth is rectified by the nearest pixel, so that no depth is made up.

    Parameters
    ----------
    calibration : Calibration
    is_depth : bool
    depth_view : DepthView, optional
        Of depth that is seen by another camera.
    mask : ndarray of uint8, shape (h, w), optional
        0 where raw pixels are not used; rectified likewise it is the attribute of that name. It is
        grown by the half size of a patch, which would see what is behind its edge.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        is_depth: bool = False,
        depth_view: DepthView | None = None,
        mask: ImageArray | None = None,
    ) -> None:
        recorded = calibration if depth_view is None else depth_view.calibration
        self._size = (recorded.height, recorded.width)
        self._is_depth = is_depth
        self._register = None if depth_view is None else DepthRegistration(calibration, depth_view)
        self._maps = None if depth_view is not None else rectification_maps(calibration)
        self._fixed_maps: tuple[NDArray[Any], NDArray[Any]] | None = None
        if self._maps is not None and not is_depth:
            # Linear interpolation is faster with fixed-point maps, the nearest pixel is not.
            fixed = cv2.convertMaps(*self._maps, cv2.CV_16SC2)
            self._fixed_maps = (np.asarray(fixed[0]), np.asarray(fixed[1]))
        self.mask = mask if mask is None else self._rectified_mask(mask)

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return grey uint8 (h, w) of grey or BGR pixels; of metres (h, w) float32 metres."""
        _check_pixels(pixels, is_depth=self._is_depth)
        if pixels.shape[:2] != self._size:
            raise RecordingError(
                f"expected {_size_text(self._size)} pixels by the calibration, got "
                f"{_size_text(pixels.shape)}; give the calibration of these images "
                "(--calibration FILE)"
            )
        return self._depth(pixels) if self._is_depth else self._grey(pixels)

    def _rectified_mask(self, mask: ImageArray) -> ImageArray:
        if self._maps is not None:  # what is outside of the image is not masked by this
            mask = np.asarray(cv2.remap(mask, *self._maps, cv2.INTER_NEAREST, borderValue=255))
        side = 2 * _MASK_MARGIN_PX + 1
        return np.asarray(cv2.erode(mask, np.ones((side, side), np.uint8)), dtype=np.uint8)

    def _depth(self, depth: NDArray[Any]) -> DepthArray:
        if self._register is not None:
            depth = self._register(depth)
        if self._maps is not None:
            depth = np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderValue=np.nan))
        # a few rows mostly tell, at a sixteenth of the cost
        if not (_is_known(depth[::16]) or _is_known(depth)):
            raise RecordingError("no pixel of the depth image is known")
        return np.asarray(depth, dtype=np.float32)

    def _grey(self, pixels: NDArray[Any]) -> ImageArray:
        if pixels.ndim == 3:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        if self._fixed_maps is not None:
            pixels = cv2.remap(pixels, *self._fixed_maps, cv2.INTER_LINEAR)
        return np.asarray(pixels, dtype=np.uint8)


def _check_pixels(pixels: object, *, is_depth: bool) -> None:
    """Refuse what would be taken for something else, such as 16 bits cut to 8."""
    if not isinstance(pixels, np.ndarray):
        raise RecordingError(f"expected an array of pixels, got {type(pixels).__name__}")
    if is_depth:
        expected, is_right = "float (h, w) in metres", pixels.dtype.kind == "f"
        is_right &= pixels.ndim == 2
    else:
        expected, is_right = "uint8 (h, w) or (h, w, 3)", pixels.dtype == np.uint8
        is_right &= pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if not is_right:
        raise RecordingError(f"expected pixels of {expected}, got {pixels.dtype} {pixels.shape}")


def _is_known(depth: NDArray[Any]) -> bool:
    return bool(np.any((depth > 0) & (depth < np.inf)))


def _size_text(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"


def _error_text(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, GvoError) else f"{type(error).__name__}: {text}"


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV, inside the context, from splitting single calls over threads.

    Images are worked on side by side already; splitting the small ones as well costs a tenth more
    CPU time and gains nothing.
    """
    n_before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(n_before)
