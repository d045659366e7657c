"""Odometry over images as they arrive: a receiving thread, a queue, and the tracking."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from gvo._text import cut
from gvo.config import Config, Parameters
from gvo.errors import GvoError, OutputError, RecordingError
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.io.bag.messages import transform_of
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import ChosenImages, Source, StampedImage
from gvo.io.run_folder.writer import free_path
from gvo.io.sync import MAX_WAITING_BYTES, Pair, Paired
from gvo.live.imu import ImuQueue
from gvo.live.publishing import Arrivals, LiveMessages
from gvo.live.transport import SET_POSE, TRIGGER, NetworkWriter, Service, Sink
from gvo.odometry.odometry import Odometry
from gvo.runs.loop import RunLoop
from gvo.runs.outputs.bag import TOPICS
from gvo.runs.outputs.options import RunOutputs, name_frames
from gvo.runs.result import RunResult
from gvo.runs.run import drawn, run_recording
from gvo.types import Failure, FaultyFrame, Progress, RgbdFrame, StereoFrame

if TYPE_CHECKING:
    from gvo.viz.view.live import LivePlayer

_OnProgress: TypeAlias = Callable[[Progress], None]
# Frames that must be tracked before any pair is dropped, and how many pairs may wait until then.
_N_TIED = 2
_MAX_BEFORE_TIED = 300
# The lag is predicted by the slowest of the last twenty frames.
_N_TIMED = 20
_N_WARMING = 3
# Where the stamps of both streams go back by more, in so many images of each, a new run begins: a
# clock was set, or a bag is played again. Their time so far is the median of the last stamps.
_BACK_NS = 1_000_000_000
_N_TO_RESTART = 3
_N_STAMPS = 5
# Images of a stream that may wait for the other one to go back too.
_MAX_HELD = 100
_PATIENCE_S = 60.0


class LiveRun(NamedTuple):
    """One run of a live session: its folder and its result."""

    folder: Path
    result: RunResult


class LiveOdometry:
    """Track images as they arrive, send the poses, and write what a run writes.

    A thread receives images and pairs them; the pairs wait in a queue until they are tracked. If
    no pair is dropped, the poses are bit for bit those of `run_recording` over the same images. A
    new run begins when the stamps go back and after a reset.

    Parameters
    ----------
    source : Source
        Yields images as they are taken: `TopicSource`, `StandardInput` or `Device`.
    config : Config, optional
    sinks : sequence of Sink
        Networks and viewers to send poses to. They can change the parameters and call the
        services `/gvo/reset`, `/gvo/save` (Trigger) and `/gvo/set_pose` (SetPose).
    base_frame : BaseFrame, optional
        The frame whose poses are written; the camera's if omitted. If tf connects a named frame
        with the camera, the frames sent are `WORLD -> odom -> NAME` as of REP 105.
    world : str
        Name of the fixed frame of what is sent.
    with_tf : bool
        Send transforms.
    max_waiting : int
        Pairs that may wait; when one more comes, the oldest is dropped.
    max_lag_s : float, optional
        Drop pairs whose poses would be later than this, seconds; never the newest pair.
    say : callable
        Gets a line of text when something happens to the images.

    Attributes
    ----------
    arrivals : Arrivals
        Rates of the images, and how long their poses take.
    parameters : Parameters
        Sinks and viewers change them.
    viewer : LivePlayer or None
        Gets each frame; see `gvo.viz.view.serve`.
    """

    def __init__(
        self,
        source: Source,
        config: Config | None = None,
        *,
        sinks: Sequence[Sink] = (),
        base_frame: BaseFrame | None = None,
        world: str = "map",
        with_tf: bool = True,
        max_waiting: int = 10,
        max_lag_s: float | None = None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._source, self._say = source, say
        self._base_frame = base_frame or BaseFrame(source.info.frame_id)
        self._world = world
        self._make_queue = partial(WaitingPairs, max_waiting=max_waiting, max_lag_s=max_lag_s)
        self._waiting = self._make_queue()
        self._n_dropped = 0
        self._is_stopped = False
        self.parameters = Parameters(config or Config())
        self.parameters.follow(self._reconfigure)
        left_out = () if with_tf else ("/tf", "/tf_static")
        self._writers = [NetworkWriter(sink, source.info.name, left_out) for sink in sinks]
        self._imu: ImuQueue | None = getattr(source, "imu_queue", None)
        places = getattr(source, "image_topics", source.info.stream_names)
        self.arrivals = Arrivals(
            *(source.info, places, self._writers, say), n_dropped=lambda: self.n_dropped
        )
        self._stretches = Stretches(self.arrivals.watch(source.images()))
        self._loop: RunLoop | None = None
        self._save: Callable[[], Future[int]] | None = None
        self._messages: LiveMessages | None = None
        self.viewer: LivePlayer | None = None
        for sink in sinks:
            sink.offer(self.parameters)
            for service in self._services():
                sink.serve(service)

    @property
    def n_dropped(self) -> int:
        """Frames that were dropped so far."""
        return self._n_dropped + self._waiting.n_dropped

    def run(
        self,
        out: str | Path,
        *,
        outputs: RunOutputs | None = None,
        force: bool = False,
        on_progress: _OnProgress = lambda _: None,
    ) -> list[LiveRun]:
        """Track until the images end or `stop` is called, then complete the run's files.

        Parameters and errors are those of `run_recording`. A second run goes into `OUT-2`, or the
        first free one of `OUT-3`, ...; so does its bag.

        Returns
        -------
        list of LiveRun
        """
        outputs = outputs or RunOutputs()
        _warm(self._source.info.camera, self.parameters.config)
        for writer in self._writers:
            writer.announce(TOPICS)
        runs: list[LiveRun] = []
        with self.arrivals:
            for number in count(1):
                try:
                    runs.append(self._run_stretch(Path(out), outputs, number, force, on_progress))
                except RecordingError as error:
                    if isinstance(error, OutputError) or (self._is_over and not runs):
                        raise
                    self._say(str(error))
                if self._is_over:
                    break
        if not outputs.report:
            return runs
        return [LiveRun(folder, drawn(result, folder)) for folder, result in runs]

    def stop(self) -> None:
        """Take no more images, but track the pairs that wait. Any thread may call it."""
        self._is_stopped = True
        # A source with `close` ends its images, so that the last pair is completed and tracked.
        getattr(self._source, "close", self._waiting.close)()

    @property
    def _is_over(self) -> bool:
        return self._is_stopped or self._stretches.is_ended

    def _run_stretch(
        self, folder: Path, outputs: RunOutputs, number: int, force: bool, on_progress: _OnProgress
    ) -> LiveRun:
        if number > 1:
            folder = free_path(folder)
            outputs = replace(outputs, bag=outputs.bag and free_path(outputs.bag))
            self._say(f"a new run begins in {folder}: {self._stretches.reason}")
            self._base_frame = self._base_frame.restarted()
            if self._imu is not None:
                self._imu.restart()
        self._n_dropped += self._waiting.n_dropped
        self._waiting = waiting = self._make_queue()
        if self._is_stopped:
            waiting.close()
        waiting.on_pair = self.arrivals.note_pair

        def progress(state: Progress) -> None:
            waiting.note(state)
            on_progress(state)

        result = run_recording(
            ChosenImages(
                info=self._source.info,
                images=self._stretches.next_stretch,
                camera_info_changes=getattr(self._source, "camera_info_changes", None),
            ),
            folder,
            config=self.parameters.config,
            base_frame=self._base_frame,
            outputs=replace(outputs, report=False, world=self._world),
            force=force and number == 1,
            through=waiting.through,
            on_start=self._start,
            on_progress=progress,
        )
        return LiveRun(folder, result)

    def _start(self, loop: RunLoop, save: Callable[[], Future[int]]) -> list[LiveMessages]:
        """Note the loop of a run that begins; return the output that sends its poses."""
        base_frame = self._base_frame
        frames = name_frames(
            *(loop.source, base_frame),
            is_placed=base_frame.is_placed,
            world=self._world,
            is_robot=not base_frame.is_camera and not base_frame.origin,
        )
        self._loop, self._save = loop, save
        if (imu := self._imu) is not None and loop.imu_until is not None:
            loop.imu_until = lambda stamp_ns: imu.until(stamp_ns - loop.imu_delay_ns)
        loop.reconfigure(self.parameters.config)  # it may have changed since the run was begun
        waiting = self._waiting
        loop.waited_s = lambda: waiting.waited_s
        if self.viewer is not None:
            self.viewer.waited_s = loop.waited_s
            self.viewer.begin(loop.window)
            loop.on_tracked = self.viewer.add
        self._messages = LiveMessages(self._writers, frames, self.arrivals.note_sent, self._say)
        return [self._messages]

    def _reconfigure(self, config: Config) -> None:
        if self._loop is not None:
            self._waiting.do(partial(self._loop.reconfigure, config))

    def _services(self) -> list[Service]:
        return [
            Service(name="/gvo/reset", type=TRIGGER, answer=self._answer_reset),
            Service(name="/gvo/save", type=TRIGGER, answer=self._answer_save),
            Service(name="/gvo/set_pose", type=SET_POSE, answer=self._answer_set_pose),
        ]

    def _answer_reset(self, _: object) -> dict[str, object]:
        self._stretches.cut()
        return {"success": True, "message": "a new run begins with the next image"}

    def _answer_save(self, _: object) -> dict[str, object]:
        begun: Future[Future[int]] = Future()

        def save() -> None:
            try:
                if self._save is None:
                    raise RecordingError("no frame was tracked yet")
                begun.set_result(self._save())
            except GvoError as error:
                begun.set_exception(error)

        self._waiting.do(save)
        try:
            message = f"{begun.result(_PATIENCE_S).result()} frames are written"
        except TimeoutError:
            return {"success": False, "message": "the run is ending"}
        except GvoError as error:
            return {"success": False, "message": str(error)}
        return {"success": True, "message": message}

    def _answer_set_pose(self, request: Any) -> dict[str, object]:  # noqa: ANN401 - made at run time
        stamped = request.pose
        pose, frame = stamped.pose.pose, stamped.header.frame_id.strip("/")
        T = transform_of(pose.position, pose.orientation)
        if isinstance(T, Failure) or frame not in ("", self._world):
            reason = T.reason if isinstance(T, Failure) else f"it is of {cut(frame, 60)}"
            self._say(f"the pose is not set: {reason}; expected one in {self._world}")
        elif self._messages is not None:
            self._waiting.do(partial(self._messages.set_pose, T))
        return {}


class Stretches:
    """Splits a stream of images into runs: where stamps go back, and after `cut`.

    Each stream is compared with itself, so that one may come later than the other. Three images of
    each in a row must be more than a second behind; fewer have a wrong stamp, and pairing skips
    them.

    Attributes
    ----------
    is_ended : bool
        No more images come.
    reason : str
        Why the last stretch ended.
    """

    def __init__(self, images: Iterator[StampedImage]) -> None:
        self._images = images
        self._next_images: deque[StampedImage] = deque()  # of the next stretch
        self._is_cut = False
        self.is_ended = False
        self.reason = ""

    def cut(self) -> None:
        """End the stretch before the next image. Any thread may call it."""
        self._is_cut = True

    def next_stretch(self) -> Iterator[StampedImage]:
        """Yield images until the stretch ends."""
        streams = _StreamTime(), _StreamTime()
        self._is_cut = False
        while (image := self._next()) is not None:
            if self._is_cut:
                self._next_images.append(image)
                self.reason = "it was reset"
                break
            yield from streams[image.stream].take(image)
            if all(stream.is_back for stream in streams):
                held = chain.from_iterable(stream.held for stream in streams)
                self._next_images.extend(sorted(held, key=lambda each: each.stamp_ns))
                self.reason = f"the stamps go back to {self._next_images[0].stamp_ns} ns"
                return
        else:
            self.is_ended = True
        for stream in streams:
            yield from stream.held

    def _next(self) -> StampedImage | None:
        if self._next_images:
            return self._next_images.popleft()
        try:
            return next(self._images, None)
        except GvoError:
            self.is_ended = True
            raise


class _StreamTime:
    """The time of one stream, and the images in a row that are behind it."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_N_STAMPS)
        self.held: deque[StampedImage] = deque()

    @property
    def is_back(self) -> bool:
        """Whether enough images in a row are behind."""
        return len(self.held) >= _N_TO_RESTART

    def take(self, image: StampedImage) -> Iterator[StampedImage]:
        """Hold an image that is behind; else yield it, after those that were."""
        if not self._is_behind(image.stamp_ns):
            yield from self.held
            self.held.clear()
            self._stamps_ns.append(image.stamp_ns)
            yield image
            return
        if self.held and image.stamp_ns <= self.held[-1].stamp_ns:
            yield from self.held  # no time goes on from there
            self.held.clear()
        self.held.append(image)
        n_bytes = sum(each.n_bytes for each in self.held)
        if len(self.held) > _MAX_HELD or n_bytes > MAX_WAITING_BYTES // 2:
            yield self.held.popleft()

    def _is_behind(self, stamp_ns: int) -> bool:
        n = len(self._stamps_ns)
        return n > 0 and stamp_ns < sorted(self._stamps_ns)[(n - 1) // 2] - _BACK_NS


def _warm(camera: StereoCamera | PinholeCamera, config: Config) -> None:
    """Track random images, so that loading and first allocations do not delay real ones."""
    odometry, rng = Odometry(camera, config), np.random.default_rng(0)
    for stamp_ns in range(_N_WARMING):
        shape = 2, camera.height, camera.width
        first, second = rng.integers(0, 256, shape, dtype=np.uint8)
        odometry.track(
            StereoFrame(stamp_ns=stamp_ns, left=first, right=second)
            if isinstance(camera, StereoCamera)
            else RgbdFrame(stamp_ns=stamp_ns, image=first, depth=1.0 + second.astype(np.float32))
        )


class WaitingPairs:
    """A queue of image pairs that drops the oldest when tracking falls behind.

    In place of a dropped pair the queue gives a faulty frame with the reason. It drops nothing
    until two frames are tracked, since no later frame could measure the motion before.

    Parameters
    ----------
    max_waiting : int
        Pairs that may wait, of 512 MB at most; when one more comes, the oldest is dropped.
    max_lag_s : float or None
        Drop a pair whose pose would be later than this, seconds, if tracking took as long as the
        slowest of the last twenty; never the newest pair. None: no limit.

    Attributes
    ----------
    n_dropped : int
    waited_s : float
        How long `take` has waited, seconds.
    on_pair : callable
        Called with the stamp of each pair that is put.
    """

    def __init__(self, *, max_waiting: int = 10, max_lag_s: float | None = None) -> None:
        if max_waiting < 1 or (max_lag_s is not None and not max_lag_s > 0.0):
            raise ValueError(
                f"expected max_waiting >= 1 and max_lag_s > 0, got {max_waiting} and {max_lag_s}"
            )
        self._max_waiting, self._max_lag_s = max_waiting, max_lag_s
        self._items: deque[Paired] = deque()
        self._newest_ns, self._newest_s = 0, 0.0  # its stamp, and when it came
        self._taken_s: float | None = None
        self._tracking_s: deque[float] = deque([0.0], maxlen=_N_TIMED)  # of the last pairs
        self._is_tied = self._is_closed = False
        self._fault: GvoError | None = None
        self._changed = threading.Condition()
        self._actions: deque[Callable[[], object]] = deque()
        self.waited_s = 0.0
        self.n_dropped = 0
        self.on_pair: Callable[[int], None] = lambda _: None

    def put(self, item: Paired) -> None:
        """Add a pair or a faulty frame; the receiving thread calls it."""
        with self._changed:
            self._items.append(item)
            if not isinstance(item, FaultyFrame):
                self.on_pair(item[0].stamp_ns)
                self._newest_ns, self._newest_s = item[0].stamp_ns, time.perf_counter()
                self._drop_oldest()
            self._changed.notify()

    def _drop_oldest(self) -> None:
        """Replace the oldest pair by a faulty frame where too many wait."""
        limit = self._max_waiting if self._is_tied else _MAX_BEFORE_TIED
        pairs = [
            (index, item)
            for index, item in enumerate(self._items)
            if not isinstance(item, FaultyFrame)
        ]
        n_bytes = sum(image.n_bytes for _, pair in pairs for image in pair)
        is_full = n_bytes > MAX_WAITING_BYTES and len(pairs) > 1
        if len(pairs) > limit or is_full:
            index, oldest = pairs[0]
            reason = "512 MB of pairs wait" if is_full else f"{limit} pairs wait (--queue)"
            self._items[index] = self._dropped(oldest, reason)

    def do(self, action: Callable[[], object]) -> None:
        """Have the tracking thread call `action` before it takes the next pair."""
        with self._changed:
            self._actions.append(action)
            self._changed.notify()

    def close(self, fault: GvoError | None = None) -> None:
        """Accept no more pairs; `take` gives those that wait, then raises `fault`, if any."""
        with self._changed:
            self._is_closed = True
            self._fault = self._fault or fault
            self._changed.notify()

    def note(self, progress: Progress) -> None:
        """Note how many frames are tracked, and how long the last one took."""
        self._is_tied = progress.n_tracked >= _N_TIED
        if self._taken_s is not None:
            self._tracking_s.append(time.perf_counter() - self._taken_s)

    def take(self) -> Paired | None:
        """Wait for the oldest pair or faulty frame and return it; None after the end.

        Raises
        ------
        GvoError
            The fault given to `close`.
        """
        while True:
            start_s = time.perf_counter()
            with self._changed:
                self._changed.wait_for(lambda: self._actions or self._items or self._is_closed)
                self.waited_s += time.perf_counter() - start_s
                if not self._actions:
                    return self._take()
                action = self._actions.popleft()
            action()

    def _take(self) -> Paired | None:
        if not self._items:
            if self._fault is not None:
                raise self._fault
            return None
        item = self._items.popleft()
        if isinstance(item, FaultyFrame):
            return item
        now_s = time.perf_counter()
        waited_s = now_s - self._newest_s + 1e-9 * (self._newest_ns - item[0].stamp_ns)
        lag_s = waited_s + max(self._tracking_s)
        is_newest = all(isinstance(each, FaultyFrame) for each in self._items)
        is_late = self._max_lag_s is not None and lag_s > self._max_lag_s
        if is_late and self._is_tied and not is_newest:
            self._taken_s = None
            return self._dropped(item, f"its pose would be {lag_s:.2f} s late (--max-lag)")
        self._taken_s = now_s
        return item

    def through(self, items: Iterable[Paired]) -> Iterator[Paired]:
        """Receive items in another thread, and yield what `take` returns."""
        receiver = threading.Thread(target=self._receive, args=(items,), daemon=True)
        receiver.start()
        while (item := self.take()) is not None:
            yield item

    def _receive(self, items: Iterable[Paired]) -> None:
        try:
            for item in items:
                if self._is_closed:
                    return
                self.put(item)
        except GvoError as error:
            self.close(error)
        finally:
            self.close()  # whatever happened, nobody waits for more

    def _dropped(self, pair: Pair, reason: str) -> FaultyFrame:
        self.n_dropped += 1
        reason = f"dropped, tracking is behind: {reason}"
        return FaultyFrame(stamp_ns=pair[0].stamp_ns, reason=reason)
