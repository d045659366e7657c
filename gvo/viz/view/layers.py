"""Lines and points of the scene, sent in chunks: only those that changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from gvo.types import FloatArray
from gvo.viz.palette import ESTIMATES, LINKS, LOOP_STYLES, OTHERS, REFERENCE, REFUSED, rgb

COLOURS = {
    **ESTIMATES,
    "truth": REFERENCE,
    "keyframes": LINKS["keyframe"],
    "step": LINKS["step"],
    "keyframe link": LINKS["keyframe"],
    "depth": LINKS["depth"],
    "standstill": LINKS["standstill"],
    "refused": REFUSED,
    **{name: style.color for name, style in LOOP_STYLES.items()},
    "ellipsoids": OTHERS[3],
}
"""By name of what is drawn."""

_PATH_CHUNK = 256
_CLOUD_CHUNK = 8192


def add_points(
    scene: viser.SceneApi, node: str, points: NDArray[Any], colours: NDArray[Any], size_m: float
) -> Any:  # noqa: ANN401 - a handle of viser's
    """Add round points of shape (n, 3), metres, with colours (n, 3), RGB."""
    return scene.add_point_cloud(
        node,
        points,
        colours,
        point_size=size_m,
        point_shape="circle",
        point_shading="flat",
        precision="float32",
    )


class Segments:
    """Lines of one colour, all sent anew.

    Parameters
    ----------
    scene : viser.SceneApi
    node : str
        Where they are in the scene.
    colour : str
        As "#RRGGBB".
    thickness_px : float
    """

    def __init__(
        self, scene: viser.SceneApi, node: str, colour: str, *, thickness_px: float = 2.0
    ) -> None:
        self._scene = scene
        self._node = node
        self._colour = rgb(colour)
        self._thickness_px = thickness_px
        self._handle: Any = None

    def show(self, segments: FloatArray) -> None:
        """Draw lines of shape (n, 2, 3), metres."""
        if len(segments) == 0:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is not None:
            self._handle.points = segments.astype(np.float32)
        else:
            self._handle = self._scene.add_line_segments(
                self._node,
                segments.astype(np.float32),
                self._colour,
                thickness=self._thickness_px,
                thickness_units="screen",
            )


class Path:
    """A line in chunks; the truth is dashed. Parameters as of `Segments`."""

    def __init__(self, scene: viser.SceneApi, node: str, colour: str, *, is_dashed: bool) -> None:
        self._scene = scene
        self._node = node
        self._colour = colour
        self._is_dashed = is_dashed
        self._corners = ChunkedArray(_PATH_CHUNK, n_shared=1)
        self._chunks: dict[int, Segments] = {}

    def show(self, positions: FloatArray) -> None:
        """Draw corners of shape (n, 3), metres."""
        for number, corners in self._corners.update(positions.astype(np.float32)).items():
            segments = np.stack([corners[:-1], corners[1:]], axis=1)
            if self._is_dashed:
                segments = segments[_dashes(len(segments))]
            if number not in self._chunks:
                thickness_px = 2.0 if self._is_dashed else 3.0
                self._chunks[number] = Segments(
                    self._scene, f"{self._node}/{number}", self._colour, thickness_px=thickness_px
                )
            self._chunks[number].show(segments)


class Cloud:
    """Points in chunks, so that those that stay are sent once."""

    def __init__(self, scene: viser.SceneApi, node: str) -> None:
        self._scene = scene
        self._node = node
        self._rows = ChunkedArray(_CLOUD_CHUNK)
        self._handles: dict[int, Any] = {}

    def show(
        self, points: NDArray[np.float32], colours: NDArray[np.uint8], *, size_m: float
    ) -> None:
        """Draw points of shape (n, 3), metres, with colours (n, 3), RGB."""
        rows = np.concatenate([points, colours.astype(np.float32)], axis=1)
        for number, chunk in self._rows.update(rows).items():
            if number in self._handles:
                self._handles.pop(number).remove()
            if len(chunk) > 0:
                colours = chunk[:, 3:].astype(np.uint8)
                self._handles[number] = add_points(
                    self._scene, f"{self._node}/{number}", chunk[:, :3], colours, size_m
                )


def _dashes(n: int) -> NDArray[np.bool_]:
    """Return which of n segments are drawn: two of three, and all of a few."""
    drawn: NDArray[np.bool_] = (np.arange(n) % 3 != 2) | (n < 3)
    return drawn


class ChunkedArray:
    """Cuts rows into chunks of equal size and finds those that differ from before.

    Parameters
    ----------
    size : int
        Rows of a chunk.
    n_shared : int
        Rows that a chunk shares with the next: 1 where the rows are corners of a line.
    """

    def __init__(self, size: int, *, n_shared: int = 0) -> None:
        self._size = size
        self._n_shared = n_shared
        self._rows: NDArray[Any] | None = None

    def update(self, rows: NDArray[Any]) -> dict[int, NDArray[Any]]:
        """Return the chunks of rows (n, m) that changed, by number; an empty one went away."""
        before, self._rows = self._rows, rows.copy()
        if before is None:
            before = rows[:0]
        n_same = _common_prefix(before, rows)
        if n_same == len(before) == len(rows):
            return {}
        first = max(0, n_same - self._n_shared) // self._size
        last = (max(len(before), len(rows)) - 1) // self._size
        return {number: self._chunk(rows, number) for number in range(first, last + 1)}

    def _chunk(self, rows: NDArray[Any], number: int) -> NDArray[Any]:
        start = number * self._size
        chunk = rows[start : start + self._size + self._n_shared]
        return chunk if len(chunk) > self._n_shared else chunk[:0]


def _common_prefix(before: NDArray[Any], after: NDArray[Any]) -> int:
    n = min(len(before), len(after))
    differs = np.any(before[:n] != after[:n], axis=1)
    return int(np.argmax(differs)) if differs.any() else n
