"""Smoothing of any front-end's edges: a whole graph at once, or by the window as they come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, get_args

from gvo._version import __version__
from gvo.backend.batch import BatchOptimizer, Robust, WholeGraph
from gvo.backend.window import Keeping, SlidingWindow
from gvo.config import Config
from gvo.errors import GvoError, OutputError, RecordingError, SmoothingError, TrajectoryError
from gvo.io.edges.events import EdgeSource, Event, InputFaults, PoseEvent
from gvo.io.edges.lines import Request, format_error, format_estimate, parse_line
from gvo.io.edges.pose_graph import GRAPH, PoseGraphSource, write_graph
from gvo.io.run_folder.reader import read_estimates
from gvo.io.run_folder.writer import PICTURE, TRAJECTORIES, RunFolder, written_alone
from gvo.odometry.chain import EdgeChain
from gvo.runs.result import RunResult
from gvo.runs.summary import peak_memory_mb
from gvo.trajectory.evaluation import Evaluation, evaluate, evaluations_json
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, Estimate, FloatArray, FrameId, PositionPrior, Progress, Rejected, Status

POSES_HEADER = ("stamp_ns", "frame_id", "status", "n_edges", "n_rejected", "reason")
"""Columns of `frames.csv` in the folder of smoothed edges."""

_MAX_FOREIGN_LINES = 1000
"""A stream is refused after so many lines without a pose."""


SmoothedPose: TypeAlias = tuple[int, FrameId, FloatArray]
"""Stamp in nanoseconds, name, T_world_frame."""


@dataclass(slots=True, kw_only=True)
class SmoothingNotes:
    """Name of an input, decisions on how to read it, and warnings."""

    recording: str = ""
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    broken_off: str = ""


class Smoother:
    """A window, and the run folder that its poses are written to."""

    def __init__(
        self,
        folder: RunFolder,
        config: Config,
        notes: SmoothingNotes | None = None,
        *,
        keyframes: Keeping = "distance",
        poses: list[SmoothedPose] | None = None,
    ) -> None:
        self.folder, self.config, self._poses = folder, config, poses
        self.notes = notes or SmoothingNotes()
        self.window = SlidingWindow(config.window, keyframes=keyframes)
        self.statuses: Counter[Status] = Counter()
        self.chain = EdgeChain()

    @property
    def n_poses(self) -> int:
        """Poses taken in."""
        return sum(self.statuses.values())

    @property
    def n_tracked(self) -> int:
        """Poses that edges connect with earlier ones."""
        return self.statuses[Status.OK] + self.statuses[Status.RESUMED]

    def take(self, event: Event) -> Estimate | Rejected:
        """Add a pose, or an edge between two poses of the window."""
        if isinstance(event, PoseEvent):
            return self.add_pose(event)
        return self.window.add_edge(event.frame_id, event.edge)

    def add_pose(self, event: PoseEvent) -> Estimate:
        """Add a pose; write its raw and causal pose and those that became final."""
        causal = self.window.add_pose(event.frame_id, event.stamp_ns, event.edges, event.prior)
        raw = self.chain.advance(causal, event.edges, event.prior)
        self.statuses[causal.status] += 1
        reason = str(causal.rejected[0]) if causal.rejected else ""
        row = (causal.stamp_ns, causal.frame_id, causal.status, len(event.edges))
        self.folder.add_poses(raw, causal, (*row, len(causal.rejected), reason))
        self._add_finished(self.window.pop_finished())
        return causal

    def finish(self) -> None:
        """Write the poses that are still in the window."""
        self._add_finished(self.window.finish())

    def _add_finished(self, finished: list[Estimate]) -> None:
        self.folder.add_smoothed(finished)
        if self._poses is not None:
            self._poses += [(each.stamp_ns, each.frame_id, each.T_world_frame) for each in finished]
        self.chain.forget(estimate.frame_id for estimate in finished)


def smooth_edges(
    source: EdgeSource,
    out: str | Path,
    *,
    config: Config | None = None,
    keyframes: Keeping = "distance",
    ground_truth: Trajectory | None = None,
    force: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
    on_written: Callable[[], None] | None = None,
) -> RunResult:
    """Smooth the edges of an input in a sliding window and write a run folder.

    Parameters
    ----------
    source : EdgeSource
        From `open_edges`.
    out : str or Path
        Folder for the trajectories, covariances, table of poses, summary and picture; for a pose
        graph also `smoothed.g2o`.
    config : Config, optional
        Of which `window` is used.
    keyframes : {"manual", "distance"}
        Which older poses stay in the window: none, or some by their distance.
    ground_truth : Trajectory, optional
        True poses of the same frame.
    force : bool
        Replace an earlier run in the folder, complete or not.
    on_progress : callable, optional
        Called after each pose and each edge.
    on_written : callable, optional
        Called when everything but the picture is written.

    Returns
    -------
    RunResult

    Raises
    ------
    RecordingError
        If the input holds no pose, or the folder holds an earlier run or cannot be written.
    """
    notes = SmoothingNotes(recording=source.name, decisions=source.decisions)
    with _opened(Path(out), source, force=force) as (folder, poses):
        smoother = Smoother(folder, config or Config(), notes, keyframes=keyframes, poses=poses)
        with _finished(smoother):
            for event in _events(source, notes):
                smoother.take(event)
                if on_progress is not None:
                    n_done = smoother.n_poses
                    n_total = max(source.n_poses, n_done)
                    tracked = smoother.n_tracked
                    on_progress(Progress(n_done=n_done, n_total=n_total, n_tracked=tracked))
    notes.warnings += source.faults.warnings()
    return _conclude(smoother, _with_stamps(ground_truth, source, folder), on_written)


@contextmanager
def _opened(
    out: Path, source: EdgeSource | None, *, force: bool, names: Sequence[str] = TRAJECTORIES
) -> Iterator[tuple[RunFolder, list[SmoothedPose] | None]]:
    """Open the files of a run, and complete them also if it is interrupted.

    The list is for the poses of a pose graph, which are written at the end.
    """
    with (
        written_alone(out, force=force),
        _poses_counted(out),
        RunFolder(out, columns=POSES_HEADER, names=names) as folder,
    ):
        (out / GRAPH).unlink(missing_ok=True)
        if not isinstance(source, PoseGraphSource):
            yield folder, None
            return
        poses: list[SmoothedPose] = []
        try:
            yield folder, poses
        finally:
            write_graph(out, poses, source.measurement_lines)


@contextmanager
def _poses_counted(out: Path) -> Iterator[None]:
    """If a file cannot be written, add to the message how many poses are."""
    try:
        yield
    except (OutputError, TrajectoryError) as error:
        files = [path for name in TRAJECTORIES if (path := out / f"{name}.txt").exists()]
        n_poses = max((path.read_bytes().count(b"\n") for path in files), default=0)
        text = f"{error}; {n_poses} poses stand in {out}"
        raise OutputError(text, is_partly=n_poses > 0) from error


@contextmanager
def _finished(smoother: Smoother) -> Iterator[None]:
    """At the end, also an early one, write the poses in the window and the summary."""
    smoother.folder.write_summary(_summary(smoother) | {"state": "running"})
    try:
        try:
            yield
        finally:
            smoother.finish()
    except (OutputError, KeyboardInterrupt) as error:
        reason = str(error) or "interrupted"
        summary = _summary(smoother) | {"state": "interrupted", "warnings": [reason]}
        with suppress(OutputError):
            smoother.folder.write_summary(summary)
        raise
    if smoother.n_poses == 0:
        smoother.folder.discard()


def _events(source: EdgeSource, notes: SmoothingNotes) -> Iterator[Event]:
    """Yield events; if the input breaks off, note it and end."""
    try:
        yield from source.events()
    except (RecordingError, TrajectoryError) as error:
        notes.broken_off = str(error)


def _with_stamps(
    truth: Trajectory | None, source: EdgeSource, folder: RunFolder
) -> Trajectory | None:
    """Give true poses that have no stamps those of the poses, row by row."""
    if truth is None or truth.stamps_from != "rows":
        return truth
    stamps_ns = truth.stamps_ns
    if not source.has_made_up_stamps:
        stamps_ns = folder.frame_stamps_ns()
        if len(stamps_ns) != len(truth):
            return truth
    return Trajectory(stamps_ns=stamps_ns, T_world_frame=truth.T_world_frame)


def _conclude(
    smoother: Smoother, truth: Trajectory | None, on_written: Callable[[], None] | None
) -> RunResult:
    """Compare with the truth; write the summary and the picture."""
    folder, notes = smoother.folder, smoother.notes
    if smoother.n_poses == 0:
        raise _nothing_to_smooth(notes)
    estimates = read_estimates(folder.path)
    summary = {**_summary(smoother), "configuration": smoother.config.model_dump()}
    notes.warnings = [*_warnings(smoother), *notes.warnings]
    return _written(folder, summary, estimates, truth, notes, on_written)


def _nothing_to_smooth(notes: SmoothingNotes) -> RecordingError:
    """Return the error of an input that gave no pose."""
    reason = notes.broken_off or "; ".join(notes.warnings) or "it holds no pose"
    return RecordingError(f"{notes.recording}: nothing to smooth: {reason}")


def _written(
    folder: RunFolder,
    summary: dict[str, Any],
    estimates: dict[str, Trajectory],
    truth: Trajectory | None,
    notes: SmoothingNotes,
    on_written: Callable[[], None] | None,
) -> RunResult:
    """Compare with the truth; write the summary and the picture. Any warning is incomplete."""
    evaluations: tuple[Evaluation, ...] = ()
    if truth is not None:
        try:
            evaluations = tuple(evaluate(truth, e, name=name) for name, e in estimates.items())
        except GvoError as error:
            notes.warnings.append(f"not compared with the ground truth: {error}")
    warnings = notes.warnings
    if notes.broken_off:
        cut = f"the input broke off after {summary['frames']} poses: {notes.broken_off}"
        warnings = [cut, *warnings]
    summary |= {"errors": evaluations_json(evaluations)["estimates"], "warnings": warnings}
    with _poses_counted(folder.path):
        folder.write_summary(summary)
        if on_written is not None:
            on_written()
        # Matplotlib takes a third of a second to load.
        from gvo.viz.plots import plot_trajectories

        plot_trajectories(folder.path / PICTURE, truth if evaluations else None, estimates)
    is_complete = not warnings
    return RunResult(
        summary=summary, evaluations=evaluations, is_complete=is_complete, warnings=tuple(warnings)
    )


def _warnings(smoother: Smoother) -> Iterator[str]:
    counts = smoother.window.counts
    if counts.n_rejected:
        yield (
            f"{counts.n_rejected} edges or priors were refused, {counts.n_gated} of them because "
            f"others contradict them; the first: {counts.first_rejected}"
        )
    if counts.n_coasting:
        yield (
            f"{counts.n_coasting} of {smoother.n_poses} poses have no usable edge and continue "
            "the last velocity (frames.csv: coasting, lost)"
        )
    if counts.n_restored:
        yield f"{counts.n_restored} updates failed and were done again with less"


def _summary(smoother: Smoother) -> dict[str, Any]:
    batch_result = smoother.window.batch_result
    return _counted(smoother.notes, smoother.n_poses, smoother.n_tracked) | {
        "status_counts": {status.value: smoother.statuses[status] for status in Status},
        "window": asdict(smoother.window.counts),
        "batch": None if batch_result is None else batch_result.as_json(),
    }


def _counted(notes: SmoothingNotes, n_poses: int, n_tracked: int) -> dict[str, Any]:
    """Return what all summaries hold."""
    return {
        "gvo_version": __version__,
        "recording": notes.recording,
        "decisions": notes.decisions,
        "frames": n_poses,
        "tracked": n_tracked,
        "peak_memory_mb": round(peak_memory_mb(), 1),
    }


def optimize(
    graph: EdgeSource | Mapping[FrameId, Sequence[Edge]],
    *,
    robust: Robust = "none",
    covariances: bool = False,
) -> Trajectory:
    """Optimize a whole pose graph at once, by Levenberg-Marquardt.

    Parameters
    ----------
    graph : EdgeSource or mapping of hashable to sequence of Edge
        From `open_edges`, or for each pose (by its name, in any order) the edges to it. The first
        pose is the world. Invalid edges and poses not connected with the first are left out.
    robust : {"none", "huber", "gnc"}
        Least squares, Huber's kernel on each edge, or graduated non-convexity, by which an edge
        counts fully or not at all (edges between a pose and the next always count).
    covariances : bool
        Also compute the covariance of every pose (slower).

    Returns
    -------
    Trajectory
        For a mapping the stamp of the n-th pose is n seconds.

    Raises
    ------
    ValueError
        If `robust` is none of these, or the graph holds no pose, or a position alone as a prior.
    SmoothingError
        If GTSAM fails.

    Examples
    --------
    >>> import gvo, numpy as np
    >>> T = np.eye(4)
    >>> T[0, 3] = 1.0
    >>> edge = gvo.Edge(reference_id="a", T_reference_frame=T, covariance=1e-4 * np.eye(6))
    >>> gvo.optimize({"a": [], "b": [edge]}).positions[-1].round(6).tolist()
    [1.0, 0.0, 0.0]
    """
    if robust not in get_args(Robust):
        raise ValueError(f"robust must be one of {get_args(Robust)}, got {robust!r}")
    if isinstance(graph, Mapping):
        whole = WholeGraph()
        for number, frame_id in enumerate(graph):
            whole.add_pose(frame_id, number * 1_000_000_000)
        for frame_id, edges in graph.items():
            whole.add_edges(frame_id, edges)
    else:
        whole = read_graph(graph, SmoothingNotes())
    if not whole.frame_ids:
        raise ValueError("the graph holds no pose")
    optimizer = BatchOptimizer(whole, robust)
    optimizer.run()
    return optimizer.trajectory(optimizer.covariances() if covariances else None)


def read_graph(source: EdgeSource, notes: SmoothingNotes) -> WholeGraph:
    """Read all poses and edges of an input; if it breaks off, note it."""
    graph = WholeGraph()
    if isinstance(source, PoseGraphSource):
        graph.given.update(source.vertices.items())
    for event in _events(source, notes):
        if isinstance(event, PoseEvent):
            if isinstance(event.prior, PositionPrior):
                raise ValueError("a position alone as a prior is for the window")
            graph.add_pose(event.frame_id, event.stamp_ns, event.prior)
            graph.add_edges(event.frame_id, event.edges)
        else:
            graph.add_edges(event.frame_id, [event.edge])
    return graph


def optimize_edges(
    source: EdgeSource,
    out: str | Path,
    *,
    robust: Robust | None = None,
    covariances: bool = False,
    ground_truth: Trajectory | None = None,
    force: bool = False,
    on_step: Callable[[str], None] = lambda _: None,
    on_written: Callable[[], None] | None = None,
) -> RunResult:
    """Optimize the edges of a complete input at once, and write a run folder.

    Parameters
    ----------
    source : EdgeSource
        From `open_edges`.
    out : str or Path
        Folder for raw and smoothed poses, table of poses, summary and picture; for a pose graph
        also `smoothed.g2o`.
    robust : {"none", "huber", "gnc"}, optional
        As in `optimize`; by default "none" for a pose graph, which states its noise, else "huber".
    covariances : bool
        As in `optimize`; if they cannot be computed, the result is not complete and says why.
    ground_truth : Trajectory, optional
        True poses of the same frame.
    force : bool
        Replace an earlier run in the folder, complete or not.
    on_step : callable
        Called with a text after each step. If it raises, the best poses so far are written first.
    on_written : callable, optional
        As in `smooth_edges`.

    Returns
    -------
    RunResult

    Raises
    ------
    RecordingError
        If the input holds no pose, or the folder holds an earlier run or cannot be written.
    SmoothingError
        If GTSAM fails.
    """
    robust = robust or ("none" if isinstance(source, PoseGraphSource) else "huber")
    notes = SmoothingNotes(recording=source.name, decisions=source.decisions)
    graph = read_graph(source, notes)
    notes.warnings += source.faults.warnings()
    if not graph.frame_ids:
        raise _nothing_to_smooth(notes)
    optimizer = BatchOptimizer(graph, robust, on_step=on_step)
    with _opened(Path(out), source, force=force, names=("raw", "smoothed")) as (folder, poses):
        found = None
        try:
            optimizer.run()
            try:
                found = optimizer.covariances() if covariances else None
            except SmoothingError as error:
                notes.warnings.append(str(error))
        except KeyboardInterrupt:
            stopped = {"state": "interrupted", "warnings": ["interrupted"]}
            folder.write_summary(_batch_summary(graph, optimizer, robust, notes) | stopped)
            raise
        finally:
            # Also after an interrupt.
            smoothed = optimizer.trajectory(found)
            folder.add_trajectory("smoothed", smoothed)
            folder.add_trajectory("raw", optimizer.trajectory(of=optimizer.raw))
            folder.add_rows(_rows(graph, optimizer))
            if poses is not None:
                for number, T in zip(optimizer.numbers, optimizer.poses(), strict=True):
                    poses.append((graph.stamps_ns[number], graph.frame_ids[number], T))
    estimates = {"raw": optimizer.trajectory(of=optimizer.raw), "smoothed": smoothed}
    truth = _with_stamps(ground_truth, source, folder)
    summary = _batch_summary(graph, optimizer, robust, notes)
    notes.warnings = [*_batch_warnings(graph, optimizer), *notes.warnings]
    return _written(folder, summary, estimates, truth, notes, on_written)


def _batch_summary(
    graph: WholeGraph, optimizer: BatchOptimizer, robust: Robust, notes: SmoothingNotes
) -> dict[str, Any]:
    return _counted(notes, len(graph.frame_ids), len(optimizer.numbers)) | {
        "edges": len(graph.links),
        "robust": robust,
        "batch": optimizer.as_json(),
    }


def _rows(graph: WholeGraph, optimizer: BatchOptimizer) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the table of poses; an edge counts for both of its poses."""
    there = set(optimizer.numbers)
    ends = Counter(end for link in graph.links for end in (link.reference, link.frame))
    refused = Counter(end for link in optimizer.refused for end in (link.reference, link.frame))
    invalid = {rejected.frame_id: str(rejected) for rejected in reversed(graph.rejected)}
    n_invalid = Counter(rejected.frame_id for rejected in graph.rejected)
    poses = zip(graph.frame_ids, graph.stamps_ns, strict=True)
    for number, (frame_id, stamp_ns) in enumerate(poses):
        n_rejected = refused[number] + n_invalid[frame_id]
        reason = invalid.get(frame_id, "others contradict an edge" if n_rejected else "")
        status = Status.OK if number in there else Status.SKIPPED
        yield stamp_ns, frame_id, status, ends[number], n_rejected, reason


def _batch_warnings(graph: WholeGraph, optimizer: BatchOptimizer) -> Iterator[str]:
    if graph.rejected:
        yield f"{len(graph.rejected)} edges or priors were refused; the first: {graph.rejected[0]}"
    if not optimizer.is_converged:
        yield (
            f"stopped after {optimizer.n_iterations} iterations, while the error still falls: "
            "where few measurements contradict each other, --robust none converges"
        )
    n_left_out = len(graph.frame_ids) - len(optimizer.numbers)
    if n_left_out:
        yield (
            f"{n_left_out} poses are not connected with the first one and were left out "
            "(frames.csv: skipped)"
        )


def smooth_lines(
    lines: Iterable[str],
    answer: Callable[[str], None],
    out: str | Path,
    *,
    config: Config | None = None,
    keyframes: Keeping = "distance",
    ground_truth: Trajectory | None = None,
    force: bool = False,
    on_written: Callable[[], None] | None = None,
) -> RunResult:
    """Smooth a stream of poses and edges, answering each line at once.

    Parameters
    ----------
    lines : iterable of str
        Of JSON; see `gvo.io.edges.lines`.
    answer : callable
        Gets the answer to each line that is not empty, without line end: the estimate of the
        line's pose, or `{"error": ...}`.
    out : str or Path
        Folder, as in `smooth_edges`.
    config : Config, optional
    keyframes : {"manual", "distance"}
        Which older poses stay in the window, besides those that a line keeps by `keep`.
    ground_truth : Trajectory, optional
        True poses of the same frame.
    force : bool
        Replace an earlier run in the folder, complete or not.
    on_written : callable, optional
        As in `smooth_edges`.

    Returns
    -------
    RunResult
        Not complete if a line was malformed.

    Raises
    ------
    RecordingError
        If no line held a pose, or the folder holds an earlier run or cannot be written.
    """
    faults, notes = InputFaults(), SmoothingNotes(recording="standard input")
    with _opened(Path(out), None, force=force) as (folder, _):
        smoother = Smoother(folder, config or Config(), notes, keyframes=keyframes)
        with _finished(smoother):
            try:
                _answer_all(lines, answer, smoother, faults)
            except OSError as error:
                words = f"the stream ends there: {error.strerror}"
                faults.add("answers could not be written", words)
            except TrajectoryError as error:
                notes.broken_off = str(error)
    notes.warnings += faults.warnings()
    return _conclude(smoother, ground_truth, on_written)


def _answer_all(
    lines: Iterable[str], answer: Callable[[str], None], smoother: Smoother, faults: InputFaults
) -> None:
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            reply = _reply(parse_line(line), smoother)
        except ValueError as error:
            faults.add("lines were not understood", f"line {number}: {error}")
            reply = format_error(f"line {number}: {error}")
            if number >= _MAX_FOREIGN_LINES and smoother.n_poses == 0:
                raise TrajectoryError(
                    f"{number} lines hold no pose; line {number}: {error}"
                ) from error
        answer(reply)


def _reply(request: Request, smoother: Smoother) -> str:
    """Add a new pose, or edges and prior to one of the window; return its estimate as a line."""
    frame_id, window, rejected = request.frame_id, smoother.window, list[Rejected]()
    if frame_id in window:
        rejected = _extend(request, window)
        estimate = window.estimate(frame_id)
    elif request.stamp_ns is None:
        raise ValueError(f"{frame_id!r} is not in the window; a new pose needs a stamp")
    else:
        edges, prior, stamp_ns = request.edges, request.prior, request.stamp_ns
        event = PoseEvent(frame_id=frame_id, stamp_ns=stamp_ns, edges=edges, prior=prior)
        estimate = smoother.add_pose(event)
    if request.keep is not None and frame_id in window:
        (window.keep if request.keep else window.release)(frame_id)
    return format_estimate(estimate, rejected)


def _extend(request: Request, window: SlidingWindow) -> list[Rejected]:
    """Add edges and prior to a pose of the window; return what was refused."""
    frame_id, stamp_ns = request.frame_id, window.stamp_ns(request.frame_id)
    if request.stamp_ns not in (None, stamp_ns):
        raise ValueError(
            f"{frame_id!r} is in the window with the stamp {stamp_ns}, got {request.stamp_ns}"
        )
    answers: list[Estimate | Rejected] = [window.add_edge(frame_id, edge) for edge in request.edges]
    if request.prior is not None:
        answers.append(window.add_prior(frame_id, request.prior))
    return [reply for reply in answers if isinstance(reply, Rejected)]
