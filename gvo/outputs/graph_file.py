"""A pose graph of g2o with smoothed poses, written as they are finished."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gvo.errors import RecordingError
from gvo.trajectory.g2o import format_vertex
from gvo.types import Estimate

GRAPH = "smoothed.g2o"


class GraphFile:
    """Vertices under their own ids, and the measurements after them.

    Parameters
    ----------
    folder : Path
        Made where it is missing; the file is `smoothed.g2o`.

    Raises
    ------
    RecordingError
        When the file cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / GRAPH
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._path.unlink(missing_ok=True)
            self._file = self._part.open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror}") from error

    @property
    def _part(self) -> Path:
        return self._path.with_suffix(".g2o.part")

    def add(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses, named by whole numbers, in any order."""
        for estimate in estimates:
            vertex = format_vertex(str(estimate.frame_id), estimate.T_world_cam)
            self._file.write(f"{estimate.stamp_ns} {vertex}\n")

    def close(self, measurement_lines: Iterable[str]) -> None:
        """Sort the vertices by their stamps, and add the measurements.

        Parameters
        ----------
        measurement_lines : iterable of str
            Without their line ends.
        """
        try:
            self._file.close()
            vertices = self._part.read_text(encoding="utf-8").splitlines(keepends=True)
            vertices.sort(key=lambda line: int(line.split(" ", 1)[0]))
            with self._path.open("w", encoding="utf-8", newline="\n") as file:
                file.writelines(line.split(" ", 1)[1] for line in vertices)
                file.writelines(f"{line}\n" for line in measurement_lines)
            self._part.unlink()
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror}") from error
