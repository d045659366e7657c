"""G2o files streamed, and written with smoothed poses."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import count, islice
from pathlib import Path

import numpy as np

from gvo._text import text_lines
from gvo.errors import OutputError, TrajectoryError, write_faults
from gvo.io.edges.events import EdgeEvent, Event, InputFaults, PoseEvent, anchor, inverted
from gvo.trajectory import g2o
from gvo.types import Edge, FloatArray, FrameId

_SECOND_NS = 1_000_000_000
_TAG = re.compile(r"[A-Z][A-Z0-9_]*(:[A-Z0-9_]+)*$")
GRAPH = "smoothed.g2o"
# Lines that are parsed together.
_BLOCK = 512


class PoseGraphSource:
    """A file of g2o: `EDGE_SE3:QUAT`, `VERTEX_SE3:QUAT`, `FIX`, and the older `EDGE3`, `VERTEX3`.

    A pose comes with its first edge to a known pose, together with the edges of the lines that
    follow at once. An edge between two poses that are both unknown waits until one of them is
    known. A file has no stamps: the n-th pose gets n seconds. The pose named by `FIX` holds the
    world, else that of the first vertex, else that of the first edge; the poses of other vertices
    are in no event, as the edges tell where they are.

    Parameters
    ----------
    path : Path
        Text file.

    Attributes
    ----------
    vertices : dict of int to ndarray of float64, shape (4, 4), or None
        Unless it is None, gets T_world_frame of all vertices as events are read.

    Raises
    ------
    TrajectoryError
        When the file cannot be read or holds no edge between poses in 3-D.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.name = path.stem
        self.faults = InputFaults()
        self.has_made_up_stamps = True
        self.vertices: dict[FrameId, FloatArray] | None = None
        self._fixed: dict[int, FloatArray] = {}
        self._start_id: int | None = None
        self._malformed: int | None = None
        self._n_vertices = 0
        self._scan()
        self.n_poses = self._n_vertices
        origin = "where its vertex is" if self._start_id in self._fixed else "the origin"
        self.decisions = [
            "stamps: the order of the poses, a second each; a g2o file has none",
            f"world: pose {self._start_id} is {origin}",
        ]

    def events(self) -> Iterator[Event]:
        """Yield poses and edges in file order.

        Raises
        ------
        TrajectoryError
            Naming the line that is malformed.
        """
        graph = _Connector(self._fixed)
        if self._start_id is not None:
            yield graph.start(self._start_id)
        for line in self._lines():
            if isinstance(line, g2o.Measurement):
                yield from graph.take(line)
            elif isinstance(line, g2o.Vertex) and self.vertices is not None:
                self.vertices[line.frame_id] = line.T_world_frame
        yield from graph.flush()
        self._report_unconnected(graph)

    def measurement_lines(self) -> Iterator[str]:
        """Yield the lines of all edges and of `FIX`, edges in the newer form, else as read.

        They end where the events end: at the first line that is not understood.

        Raises
        ------
        TrajectoryError
            When the file cannot be read again.
        """
        for number, text in self._texts():
            if number == self._malformed:
                return
            tag = text.split(maxsplit=1)[0]
            if tag in g2o.MEASUREMENT_TAGS or tag == "FIX":
                try:
                    line = g2o.convert_line(text)
                except ValueError:
                    return
                yield line

    def _scan(self) -> None:
        """Find what holds the world, and the tags that are not understood, in one quick pass."""
        first_vertex: g2o.Vertex | None = None
        first_edge: g2o.Measurement | None = None
        fixed_ids: list[int] = []
        for number, text in self._texts():
            tag = text.split(maxsplit=1)[0]
            if tag not in g2o.TAGS:
                self._note_foreign(tag, number)
                continue
            is_edge = tag in g2o.MEASUREMENT_TAGS
            self._n_vertices += not is_edge and tag != "FIX"
            if tag == "FIX" or (first_edge if is_edge else first_vertex) is None:
                line = self._parsed(number, text)
                fixed_ids += line.frame_ids if isinstance(line, g2o.Fix) else ()
                first_edge = line if isinstance(line, g2o.Measurement) else first_edge
                first_vertex = line if isinstance(line, g2o.Vertex) else first_vertex
        if first_edge is None:
            foreign = "".join(f" ({warning})" for warning in self.faults.warnings())
            raise TrajectoryError(
                f"{self._path}: holds no edge between poses in 3-D; expected lines of "
                f"{' or '.join(g2o.MEASUREMENT_TAGS)}{foreign}"
            )
        self._choose_anchor(fixed_ids, first_vertex, first_edge)

    def _choose_anchor(
        self, fixed_ids: list[int], first_vertex: g2o.Vertex | None, first_edge: g2o.Measurement
    ) -> None:
        if fixed_ids:
            self._start_id = fixed_ids[0]
            self._fixed = self._vertices(set(fixed_ids))
        elif first_vertex is not None:
            self._start_id = first_vertex.frame_id
            self._fixed = {first_vertex.frame_id: first_vertex.T_world_frame}
        else:
            self._start_id = first_edge.reference_id

    def _vertices(self, frame_ids: set[int]) -> dict[int, FloatArray]:
        lines = (line for line in self._lines() if isinstance(line, g2o.Vertex))
        return {line.frame_id: line.T_world_frame for line in lines if line.frame_id in frame_ids}

    def _note_foreign(self, tag: str, number: int) -> None:
        if not _TAG.match(tag):
            raise TrajectoryError(
                f"{self._path}:{number}: {tag[:40]!r} is no tag of a g2o file; expected lines of "
                f"{', '.join(g2o.TAGS)}"
            )
        if not tag.startswith("PARAMS"):
            self.faults.add("lines are of tags that are not read", f"{tag} in line {number}")

    def _lines(self) -> Iterator[g2o.Line]:
        numbered = self._texts()
        while block := list(islice(numbered, _BLOCK)):
            try:
                lines: Iterable[g2o.Line | None] = g2o.parse_lines([text for _, text in block])
            except ValueError:
                lines = (self._parsed(number, text) for number, text in block)
            yield from (line for line in lines if line is not None)

    def _parsed(self, number: int, text: str) -> g2o.Line | None:
        try:
            return g2o.parse_line(text)
        except ValueError as error:
            self._malformed = number
            raise TrajectoryError(f"{self._path}:{number}: {error}") from None

    def _texts(self) -> Iterator[tuple[int, str]]:
        """Yield line numbers and lines that hold anything."""
        for number, line in text_lines(self._path, TrajectoryError):
            text = line.partition("#")[0].strip()
            if text:
                yield number, text

    def _report_unconnected(self, graph: _Connector) -> None:
        if graph.n_waiting:
            self.faults.add(
                "edges are not connected with the first pose and were left out",
                graph.first_waiting(),
                n=graph.n_waiting,
            )
        n_missing = self._n_vertices - graph.n_known
        if n_missing > 0:
            self.faults.add(
                "vertices have no edge that connects them with the first pose",
                f"{graph.n_known} of {self._n_vertices} are connected",
                n=n_missing,
            )


class _Connector:
    """Turns measurements into events: what is known, what waits."""

    def __init__(self, fixed: dict[int, FloatArray]) -> None:
        self._fixed = fixed
        self._known = _Ids()
        self._stamps_ns = count(0, _SECOND_NS)
        self._pending: tuple[int, list[g2o.Measurement]] | None = None
        # By either end, measurements by their number.
        self._waiting: dict[int, dict[int, g2o.Measurement]] = {}
        self._numbers = count()

    @property
    def n_known(self) -> int:
        return len(self._known)

    @property
    def n_waiting(self) -> int:
        return len({number for group in self._waiting.values() for number in group})

    def first_waiting(self) -> str:
        numbered = {n: m for group in self._waiting.values() for n, m in group.items()}
        first = numbered[min(numbered)]
        return f"{first.reference_id} {first.frame_id}"

    def start(self, frame_id: int) -> PoseEvent:
        self._known.add(frame_id)
        return PoseEvent(
            frame_id=frame_id,
            stamp_ns=next(self._stamps_ns),
            prior=anchor(self._fixed.get(frame_id, np.eye(4))),
        )

    def take(self, line: g2o.Measurement) -> Iterator[Event]:
        ends = (line.reference_id, line.frame_id)
        if self._pending is not None:
            frame_id, lines = self._pending
            others = [end for end in ends if end != frame_id]
            if len(others) == 1 and others[0] in self._known:
                lines.append(line)
                return
        yield from self.flush()
        unknown = [end for end in ends if end not in self._known]
        if not unknown:
            yield EdgeEvent(frame_id=line.frame_id, edge=_edge(line))
        elif len(unknown) == 1:
            self._pending = (unknown[0], [line])
        else:
            number = next(self._numbers)
            for end in ends:
                self._waiting.setdefault(end, {})[number] = line

    def flush(self) -> Iterator[Event]:
        """Yield the pose whose lines were being gathered, and what waited for it."""
        if self._pending is None:
            return
        (frame_id, lines), self._pending = self._pending, None
        yield self._pose(frame_id, lines)
        yield from self._connect(frame_id)

    def _connect(self, frame_id: int) -> Iterator[Event]:
        """Yield what waited for a pose, and for the poses that come of it."""
        queue = deque([frame_id])
        while queue:
            near = queue.popleft()
            by_end: dict[int, list[g2o.Measurement]] = {}
            for number, line in self._waiting.pop(near, {}).items():
                far = line.frame_id if line.reference_id == near else line.reference_id
                self._waiting.get(far, {}).pop(number, None)
                by_end.setdefault(far, []).append(line)
            for far, lines in by_end.items():
                if far in self._known:
                    for line in lines:
                        yield EdgeEvent(frame_id=line.frame_id, edge=_edge(line))
                else:
                    yield self._pose(far, lines)
                    queue.append(far)

    def _pose(self, frame_id: int, lines: list[g2o.Measurement]) -> PoseEvent:
        self._known.add(frame_id)
        fixed = self._fixed.get(frame_id)
        return PoseEvent(
            frame_id=frame_id,
            stamp_ns=next(self._stamps_ns),
            edges=tuple(
                _edge(line) if line.frame_id == frame_id else inverted(_edge(line), line.frame_id)
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


class _Ids:
    """A set of ids that takes no memory for ids in a row."""

    def __init__(self) -> None:
        self._first = 0
        self._end = 0
        self._others: set[int] = set()

    def __contains__(self, frame_id: int) -> bool:
        return self._first <= frame_id < self._end or frame_id in self._others

    def __len__(self) -> int:
        return self._end - self._first + len(self._others)

    def add(self, frame_id: int) -> None:
        if self._end == self._first:
            self._first = self._end = frame_id
        self._others.add(frame_id)
        while self._end in self._others:
            self._others.remove(self._end)
            self._end += 1


class GraphFile:
    """Vertices under their own ids, and the measurements after them.

    Parameters
    ----------
    folder : Path
        Made where it is missing; the file is `smoothed.g2o`.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / GRAPH
        self._part = self._path.with_suffix(".g2o.part")
        with write_faults(OutputError, self._path):
            folder.mkdir(parents=True, exist_ok=True)
            self._path.unlink(missing_ok=True)
            self._file = self._part.open("w", encoding="utf-8", newline="\n")

    def add(self, stamp_ns: int, frame_id: FrameId, T_world_frame: FloatArray) -> None:
        """Write a smoothed pose, named by a whole number; they may come in any order."""
        with write_faults(OutputError, self._path):
            self._file.write(f"{stamp_ns} {g2o.format_vertex(str(frame_id), T_world_frame)}\n")

    def close(self, measurement_lines: Iterable[str]) -> None:
        """Sort the vertices by their stamps, and add the measurements.

        Parameters
        ----------
        measurement_lines : iterable of str
            Without their line ends.
        """
        with write_faults(OutputError, self._path):
            self._file.close()
            vertices = self._part.read_text(encoding="utf-8").splitlines(keepends=True)
            vertices.sort(key=lambda line: int(line.split(" ", 1)[0]))
            with self._path.open("w", encoding="utf-8", newline="\n") as file:
                file.writelines(line.split(" ", 1)[1] for line in vertices)
                file.writelines(f"{line}\n" for line in measurement_lines)
            self._part.unlink()
