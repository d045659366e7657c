"""G2o files streamed, and written with smoothed poses."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, count, islice
from operator import itemgetter
from pathlib import Path

import numpy as np

from gvo._text import text_lines
from gvo.errors import ConfigurationError, OutputError, TrajectoryError, write_faults
from gvo.geometry.edges import inverse
from gvo.io.edges.events import EdgeEvent, Event, InputFaults, PoseEvent, anchor
from gvo.io.edges.pose_streams import StepSigma
from gvo.io.poses.tf import list_names
from gvo.io.run_folder.line_file import replace_text
from gvo.trajectory import g2o
from gvo.types import Edge, FloatArray, FrameId

_SECOND_NS = 1_000_000_000
_TAG = re.compile(r"[A-Z][A-Z0-9_]*(:[A-Z0-9_]+)*$")
GRAPH = "smoothed.g2o"
# Lines that are parsed together.
_BLOCK = 512


class PoseGraphSource:
    """A file of g2o: `EDGE_SE3:QUAT`, `VERTEX_SE3:QUAT`, `FIX`, and the older `EDGE3`, `VERTEX3`.

    A pose is yielded with its first edge to a pose yielded before, and with the edges of the lines
    that follow directly. An edge whose poses are both new waits until one of them is yielded. The
    file has no stamps: the n-th pose gets n seconds. The world is fixed by the pose that `FIX`
    names, else by the first vertex, else by the first edge. Poses of other vertices are not used,
    since the edges determine them.

    Parameters
    ----------
    path : Path
        Text file.
    sigma : StepSigma, optional
        Noise of edges whose information matrix is none; they are refused without it.

    Attributes
    ----------
    vertices : dict of int to ndarray of float64, shape (4, 4)
        T_world_frame of all vertices.
    measurement_lines : list of str
        All edges that are used and `FIX`, up to the first line that is not understood, as they
        were read; the older edges in the newer form, those without information with the sigma.

    Raises
    ------
    TrajectoryError
        When the file cannot be read, gives an id twice, or holds no edge between poses in 3-D.
    ConfigurationError
        When there is a `sigma`, and no edge needs it.
    """

    def __init__(self, path: Path, sigma: StepSigma | None = None) -> None:
        self.name = path.stem
        self.faults = InputFaults()
        self.has_made_up_stamps = True
        self.vertices: dict[int, FloatArray] = {}
        self.measurement_lines: list[str] = []
        self._edges: list[g2o.Measurement] = []
        self._fixed_ids: list[int] = []
        self._fault = ""
        self._sigma, self._n_given = sigma, 0
        self._repeated: set[int] = set()
        self._read(path)
        if self._repeated:
            ids = list_names([str(each) for each in sorted(self._repeated)])
            raise TrajectoryError(f"{path}: ids are given to more than one vertex: {ids}")
        self.n_poses = len(self.vertices)
        if not self._edges:
            known = f"expected lines of {' or '.join(g2o.MEASUREMENT_TAGS)}"
            found = "; ".join(self.faults.warnings()) or known
            raise TrajectoryError(
                self._fault
                or f"{path}: holds no edge between poses in 3-D that can be used; {found}"
            )
        first = self._fixed_ids[:1] or list(self.vertices)[:1] or [self._edges[0].reference_id]
        self._start_id = first[0]
        origin = "where its vertex is" if self._start_id in self.vertices else "the origin"
        self.decisions = [
            "stamps: the order of the poses, a second each; a g2o file has none",
            f"world: pose {self._start_id} is {origin}",
        ]
        if sigma is not None:
            if not self._n_given:
                raise ConfigurationError(f"--sigma: {path} states the noise of its edges itself")
            self.decisions.append(
                f"noise: {sigma.describe()} of {self._n_given} edges without information"
            )

    def events(self) -> Iterator[Event]:
        """Yield poses and edges in file order.

        Raises
        ------
        TrajectoryError
            Naming the line that is malformed.
        """
        fixed = {name: T for name, T in self.vertices.items() if name in self._fixed_ids}
        fixed[self._start_id] = self.vertices.get(self._start_id, np.eye(4))
        graph = _Connector(fixed)
        yield graph.pose(self._start_id)
        for edge in self._edges:
            yield from graph.take(edge)
        yield from graph.flush()
        if self._fault:
            raise TrajectoryError(self._fault)
        self._report_unconnected(graph.known)

    def _read(self, path: Path) -> None:
        """Read the file up to its end, or to a line that is malformed."""
        numbered = _texts(path)
        while block := list(islice(numbered, _BLOCK)):
            self._note_foreign(path, block)
            try:
                lines = g2o.parse_lines([text for _, text in block])
                self._add(lines, block)
            except ValueError:
                for number, text in block:
                    try:
                        self._add([g2o.parse_line(text)], [(number, text)])
                    except ValueError as error:
                        self._fault = f"{path}:{number}: {error}"
                        return

    def _add(self, lines: Iterable[g2o.Line | None], block: Iterable[tuple[int, str]]) -> None:
        for line, (_, text) in zip(lines, block, strict=True):
            if isinstance(line, g2o.Vertex):
                if line.frame_id in self.vertices:
                    self._repeated.add(line.frame_id)
                self.vertices[line.frame_id] = line.T_world_frame
                continue
            if isinstance(line, g2o.Measurement):
                self._add_edge(line, text)
            elif isinstance(line, g2o.Fix):
                self._fixed_ids += line.frame_ids
                self.measurement_lines.append(text.strip())

    def _add_edge(self, line: g2o.Measurement, text: str) -> None:
        if line.fault and self._sigma is None:
            kind = f"edges were refused: their {line.fault}, give --sigma DEG,M to use them"
            self.faults.add(kind, f"{line.reference_id} {line.frame_id}")
            return
        if line.fault and self._sigma is not None:
            self._n_given += 1
            T, covariance = line.T_reference_frame, self._sigma.covariance(line.T_reference_frame)
            line = replace(line, covariance=covariance)
            text = g2o.format_edge(line.reference_id, line.frame_id, T, covariance)
        self._edges.append(line)
        self.measurement_lines.append(g2o.convert_line(text))

    def _note_foreign(self, path: Path, block: Iterable[tuple[int, str]]) -> None:
        for number, text in block:
            tag = text.split(maxsplit=1)[0]
            if tag in g2o.TAGS or tag.startswith("PARAMS"):
                continue
            if not _TAG.match(tag):
                raise TrajectoryError(
                    f"{path}:{number}: {tag[:40]!r} is not a tag of g2o; expected lines of "
                    f"{', '.join(g2o.TAGS)}"
                )
            self.faults.add("lines are of tags that are not read", f"{tag} in line {number}")

    def _report_unconnected(self, known: set[int]) -> None:
        apart = [edge for edge in self._edges if edge.frame_id not in known]
        if apart:
            self.faults.add(
                "edges are not connected with the first pose and were left out",
                f"{apart[0].reference_id} {apart[0].frame_id}",
                n=len(apart),
            )
        n_missing = self.n_poses - len(known)
        if n_missing > 0:
            self.faults.add(
                "vertices have no edge that connects them with the first pose",
                f"{len(known)} of {self.n_poses} are connected",
                n=n_missing,
            )


def _texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line numbers and lines that hold anything."""
    for number, line in text_lines(path, TrajectoryError):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text


class _Connector:
    """Turns edges into events, one by one: those between two unknown poses wait."""

    def __init__(self, fixed: dict[int, FloatArray]) -> None:
        self._fixed = fixed
        self.known: set[int] = set()
        self._stamps_ns = count(0, _SECOND_NS)
        # A new pose and the edges that come with it, until a line is of something else.
        self._pending: tuple[int, list[g2o.Measurement]] | None = None
        self._waiting: dict[int, list[g2o.Measurement]] = {}  # by either end

    def take(self, line: g2o.Measurement) -> Iterator[Event]:
        ends = {line.reference_id, line.frame_id}
        if self._pending is not None:
            frame_id, lines = self._pending
            if frame_id in ends and len(ends) == 2 and ends - {frame_id} <= self.known:
                lines.append(line)
                return
        yield from self.flush()
        unknown = ends - self.known
        if not unknown:
            yield EdgeEvent(frame_id=line.frame_id, edge=_edge(line))
        elif len(unknown) == 1 and len(ends) == 2:
            self._pending = (unknown.pop(), [line])
        else:
            for end in ends:
                self._waiting.setdefault(end, []).append(line)

    def flush(self) -> Iterator[Event]:
        """Yield the pose whose edges were being gathered, and all that waited for it."""
        if self._pending is None:
            return
        frame_id, lines = self._pending
        self._pending = None
        yield self.pose(frame_id, lines)
        queue = deque([frame_id])
        while queue:
            near = queue.popleft()
            by_end: dict[int, list[g2o.Measurement]] = {}
            for line in self._waiting.pop(near, []):
                far = line.frame_id if line.reference_id == near else line.reference_id
                if far != near:
                    self._waiting[far].remove(line)
                by_end.setdefault(far, []).append(line)
            for far, lines in by_end.items():
                if far in self.known:
                    for line in lines:
                        yield EdgeEvent(frame_id=line.frame_id, edge=_edge(line))
                else:
                    yield self.pose(far, lines)
                    queue.append(far)

    def pose(self, frame_id: int, lines: Iterable[g2o.Measurement] = ()) -> PoseEvent:
        self.known.add(frame_id)
        fixed = self._fixed.get(frame_id)
        return PoseEvent(
            frame_id=frame_id,
            stamp_ns=next(self._stamps_ns),
            edges=tuple(
                _edge(line) if line.frame_id == frame_id else inverse(_edge(line), line.frame_id)
                for line in lines
            ),
            prior=None if fixed is None else anchor(fixed),
        )


def _edge(line: g2o.Measurement) -> Edge:
    return Edge(
        reference_id=line.reference_id,
        T_reference_frame=line.T_reference_frame,
        covariance=line.covariance,
    )


def write_graph(
    folder: Path, poses: Iterable[tuple[int, FrameId, FloatArray]], measurement_lines: Iterable[str]
) -> None:
    """Write `smoothed.g2o`: the vertices by their stamps, then the measurements.

    Parameters
    ----------
    folder : Path
        Of the run.
    poses : iterable of (stamp_ns, frame_id, T_world_frame)
        In any order, named by whole numbers.
    measurement_lines : iterable of str
        Without their line ends.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    vertices = (g2o.format_vertex(str(name), T) for _, name, T in sorted(poses, key=itemgetter(0)))
    text = "".join(f"{line}\n" for line in chain(vertices, measurement_lines))
    with write_faults(OutputError, folder / GRAPH):
        replace_text(folder / GRAPH, text)
