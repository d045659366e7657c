"""Round trips: a recording run forward, then backward, shows drift without a ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, pair_limit_key
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import ChosenImages, Source, StampedImage
from gvo.io.run_folder.writer import ROUND_TRIP_PICTURE, TRAJECTORIES, RunFolder, written_alone
from gvo.runs.loop import RunLoop
from gvo.runs.summary import RunningSummary, summarize
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.round_trip import RoundTripError, round_trip_error
from gvo.types import Failure, FaultyFrame, Frame, Progress, StereoFrame
from gvo.viz.plots import plot_round_trip

MAX_PIECE_BYTES = 256_000_000


class RoundTripFrames:
    """Yields the frames of a recording forward, then backward with mirrored stamps.

    The frame at the turn, the last sound one, comes once. Faulty frames are faulty both ways.

    Parameters
    ----------
    source : Source
        The recording; a long one is read again, piece by piece from its end.
    config : Config
        As of `frames`.
    excerpt : Excerpt, optional
        Which frames are read; all where omitted.
    max_bytes : int
        Of images in memory; at least one frame is held.

    Attributes
    ----------
    turn_ns : int or None
        Stamp of the frame at the turn, once it is passed; None where no frame is sound.

    Notes
    -----
    The last piece is kept while the recording is read, so a short recording is read once. Each
    of the others is one more reading from the start to the end of the piece, in which images
    outside of the piece are paired but not decoded.
    """

    def __init__(
        self,
        source: Source,
        config: Config,
        excerpt: Excerpt | None = None,
        *,
        max_bytes: int = MAX_PIECE_BYTES,
    ) -> None:
        self._source, self._config, self._excerpt = source, config, excerpt
        self._max_bytes = max_bytes
        self.turn_ns: int | None = None

    def __iter__(self) -> Iterator[Frame | FaultyFrame]:
        """Yield the frames.

        Yields
        ------
        StereoFrame, RgbdFrame or FaultyFrame
            On the way back with stamp' = 2 * turn - stamp, nanoseconds.

        Raises
        ------
        RecordingError
            When the recording cannot be read on; what was read before is yielded first, both ways.
        """
        log = _Log(self._max_bytes)
        fault: RecordingError | None = None
        try:
            for item in frames(self._source, self._config, self._excerpt):
                log.add(item)
                yield item
        except RecordingError as error:
            fault = error  # what was read before it counts
        self.turn_ns = log.turn_ns
        if log.turn_ns is not None:
            for item in self._backwards(log):
                yield replace(item, stamp_ns=2 * log.turn_ns - item.stamp_ns)
        if fault is not None:
            raise fault

    def _backwards(self, log: _Log) -> Iterator[Frame | FaultyFrame]:
        """Yield what lies before the turn, from there to the start."""
        while log.pieces:
            piece = log.pieces.pop()
            n_wanted = log.n_to_turn - 1 - piece.first
            if n_wanted <= 0:
                log.held.clear()
                continue
            held = log.held or self._read(piece)
            log.held = []
            del held[n_wanted:]
            while held:
                yield held.pop()

    def _read(self, piece: _Piece) -> list[Frame | FaultyFrame]:
        key = pair_limit_key(self._source.info.sensor)
        margin_ns = round(float(getattr(self._config.sync, key)) * 1e6)
        least_ns, greatest_ns = piece.stamps_ns
        images = partial(_loadable, self._source, least_ns - margin_ns, greatest_ns + margin_ns)
        source = ChosenImages(info=self._source.info, images=images)
        return list(islice(frames(source, self._config, self._excerpt), piece.first, piece.end))


@dataclass(slots=True, kw_only=True)
class _Piece:
    """Frames that follow one another: those of the indices [first, end)."""

    first: int
    end: int
    n_bytes: int = 0
    stamps_ns: tuple[int, int] = (0, 0)  # least and greatest


@dataclass(slots=True)
class _Log:
    """What was read forward, in pieces; the frames of the last one are held."""

    max_bytes: int
    pieces: list[_Piece] = field(default_factory=lambda: [_Piece(first=0, end=0)])
    held: list[Frame | FaultyFrame] = field(default_factory=list)
    turn_ns: int | None = None
    n_to_turn: int = 0  # items up to the frame at the turn

    def add(self, item: Frame | FaultyFrame) -> None:
        piece, n_bytes = self.pieces[-1], _size(item)
        if piece.n_bytes and piece.n_bytes + n_bytes > self.max_bytes:
            piece = _Piece(first=piece.end, end=piece.end)
            self.pieces.append(piece)
            self.held = []
        self.held.append(item)
        known = piece.stamps_ns if piece.end > piece.first else ()
        piece.stamps_ns = min((item.stamp_ns, *known)), max((item.stamp_ns, *known))
        piece.end += 1
        piece.n_bytes += n_bytes
        if not isinstance(item, FaultyFrame):
            self.turn_ns = item.stamp_ns
            self.n_to_turn = piece.end


def _loadable(source: Source, first_ns: int, last_ns: int) -> Iterator[StampedImage]:
    """Yield all images; those outside of two stamps cannot be loaded: so they cost nothing."""
    for image in source.images():
        is_in = first_ns <= image.stamp_ns <= last_ns
        yield image if is_in else replace(image, load=_not_loaded)


def _not_loaded() -> NDArray[Any]:
    raise RecordingError("outside of the piece that is read")


def _size(item: Frame | FaultyFrame) -> int:
    if isinstance(item, FaultyFrame):
        return 0
    images = (item.left, item.right) if isinstance(item, StereoFrame) else (item.image, item.depth)
    return sum(image.nbytes for image in images)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoundTripResult:
    """What a round trip gave.

    Parameters
    ----------
    summary : dict
        As written to `summary.json`; `round_trip` holds the errors.
    errors : dict of str to RoundTripError
        Of raw, causal and smoothed.
    turn_ns : int
        Stamp of the frame at the turn, nanoseconds.
    is_complete : bool
        As of `RunResult`.
    warnings : tuple of str
        What was skipped or broke off, a line each.
    """

    summary: dict[str, Any]
    errors: dict[str, RoundTripError]
    turn_ns: int
    is_complete: bool
    warnings: tuple[str, ...]


def run_round_trip(
    source: Source,
    out: str | Path,
    *,
    config: Config | None = None,
    excerpt: Excerpt | None = None,
    force: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
    on_written: Callable[[], None] | None = None,
) -> RoundTripResult:
    """Run odometry over a recording forward, then backward, and measure how far it ends off.

    Odometry takes the frames as one recording of twice the length. A run folder is written as by
    `run_recording`, with `round_trip.png` beside it.

    Parameters
    ----------
    source : Source
        From `open_recording`, or a rendered one; is read again for the way back.
    out : str or Path
        Folder for the trajectories, covariances, tables, summary and picture.
    config : Config, optional
    excerpt : Excerpt, optional
        Which frames are read; all where omitted.
    force : bool
        Replace an earlier run in the folder, complete or not.
    on_progress : callable, optional
        Called after each frame.
    on_written : callable, optional
        Called when all is computed and written; only the picture is drawn after it.

    Returns
    -------
    RoundTripResult

    Raises
    ------
    RecordingError
        When fewer than two frames are usable, or the recording cannot be read again.
    OutputError
        When the folder holds an earlier run, or something cannot be written.
    RunBusyError
        When another process is writing a run into the folder.

    Notes
    -----
    The error of a round trip is a lower bound of the drift. Both ways use the same images: noise
    of the images, and whatever reverses with the motion (a wrong baseline, depths that are all too
    large, a tilted rectification), gives opposite errors forward and backward, and cancels. So a
    large error shows that something is wrong, and a small one does not show that all is well. It
    measures what depends on the direction of the motion: bias of the estimator, lost tracks,
    chance.

    The raw chain has no memory: its error is that of the registrations. The window still holds
    keyframes of the way there when the way back begins; where the camera never loses sight of its
    start, these tie both ways together. Then the error of causal and smoothed says how well
    keyframes are found again, nothing of their drift.

    References
    ----------
    Z. Kalal, K. Mikolajczyk, J. Matas, "Forward-Backward Error: Automatic Detection of Tracking
    Failures", ICPR 2010, doi:10.1109/ICPR.2010.675.
    """
    config = config or Config()
    way = RoundTripFrames(source, config, excerpt)
    loop = RunLoop(source, config, BaseFrame(source.info.frame_id), excerpt=excerpt, items=way)
    with written_alone(Path(out), force=force), RunFolder(Path(out)) as folder:
        tell = None if on_progress is None else _doubled(on_progress)
        with RunningSummary(loop, folder, {}, tell) as progress:
            loop.run([folder], progress)
        if way.turn_ns is None:
            folder.discard()
            reason = loop.statistics.reason()
            raise RecordingError(f"{source.info.name}: no usable frame: {reason}")
    turn_ns = way.turn_ns
    errors = _read_errors(folder.path, turn_ns, source.info.name)
    warnings = loop.statistics.warnings()
    summary = _summary(loop, warnings, turn_ns, errors)
    folder.write_summary(summary)
    if on_written is not None:
        on_written()
    plot_round_trip(folder.path / ROUND_TRIP_PICTURE, errors)
    return RoundTripResult(
        summary=summary,
        errors=errors,
        turn_ns=turn_ns,
        is_complete=loop.statistics.is_complete,
        warnings=tuple(warnings),
    )


def _doubled(on_progress: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """Return a callback that is told of the way back as well; the turn is there once."""

    def tell(progress: Progress) -> None:
        on_progress(replace(progress, n_total=max(2 * progress.n_total - 1, 0)))

    return tell


def _read_errors(folder: Path, turn_ns: int, name: str) -> dict[str, RoundTripError]:
    trajectories = {name: read_trajectory(folder / f"{name}.txt") for name in TRAJECTORIES}
    path_m = float(trajectories["smoothed"].distances()[-1])
    errors: dict[str, RoundTripError] = {}
    for label, trajectory in trajectories.items():
        error = round_trip_error(trajectory, turn_ns, path_m=path_m)
        if isinstance(error, Failure):
            raise RecordingError(f"{name}: no round trip: {error.reason}")
        errors[label] = error
    return errors


def _summary(
    loop: RunLoop, warnings: list[str], turn_ns: int, errors: dict[str, RoundTripError]
) -> dict[str, Any]:
    summary = summarize(loop, Failure(reason="a round trip needs none"), warnings)
    summary["recording"] = f"{loop.source.info.name}, round trip"
    summary["round_trip"] = {
        "turn_ns": turn_ns,
        "path_m": errors["smoothed"].path_m,
        "estimates": {name: error.as_json() for name, error in errors.items()},
    }
    return summary
