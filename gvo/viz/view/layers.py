"""Lines and points of the scene, drawn in pieces, so that only what changed is sent."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from gvo.types import FloatArray
from gvo.viz.palette import ESTIMATES, LINKS, OTHERS, REFERENCE, REFUSED

COLOURS = {
    **ESTIMATES,
    "truth": REFERENCE,
    "keyframes": LINKS["keyframe"],
    "step": LINKS["step"],
    "keyframe link": LINKS["keyframe"],
    "standstill": LINKS["standstill"],
    "refused": REFUSED,
    "ellipsoids": OTHERS[3],
}
"""Of what is drawn, by name."""

_PATH_PIECE = 256
_CLOUD_PIECE = 8192


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the channels of "#RRGGBB"."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


class Path:
    """A line in pieces; the truth is dashed."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        self._scene = scene
        self._name = name
        self._pieces = ChunkedArray(_PATH_PIECE, n_shared=1)
        self._nodes: dict[int, Any] = {}

    def show(self, positions: FloatArray, *, is_visible: bool) -> None:
        """Draw corners of shape (n, 3), metres, in the world."""
        for number, corners in self._pieces.update(positions.astype(np.float32)).items():
            segments = np.stack([corners[:-1], corners[1:]], axis=1)
            if self._name == "truth":
                segments = segments[_dashes(len(segments))]
            self._show_piece(number, segments, is_visible)

    def _show_piece(self, number: int, segments: NDArray[Any], is_visible: bool) -> None:
        node = self._nodes.get(number)
        if len(segments) == 0:
            if node is not None:
                self._nodes.pop(number).remove()
        elif node is not None:
            node.points = segments
        else:
            self._nodes[number] = self._scene.add_line_segments(
                f"/paths/{self._name}/{number}",
                segments,
                rgb(COLOURS[self._name]),
                thickness=2.0 if self._name == "truth" else 3.0,
                thickness_units="screen",
                visible=is_visible,
            )

    def set_visible(self, is_visible: bool) -> None:
        """Show or hide it."""
        for node in self._nodes.values():
            node.visible = is_visible


class Cloud:
    """Points in pieces, so that those that stay are sent once."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._pieces = ChunkedArray(_CLOUD_PIECE)
        self._nodes: dict[int, Any] = {}

    def show(
        self,
        points: NDArray[np.float32],
        colours: NDArray[np.uint8],
        *,
        point_size: float,
        is_visible: bool,
    ) -> None:
        """Draw points of shape (n, 3), metres, in the world."""
        rows = np.concatenate([points, colours.astype(np.float32)], axis=1)
        for number, piece in self._pieces.update(rows).items():
            if number in self._nodes:
                self._nodes.pop(number).remove()
            if len(piece) > 0:
                self._nodes[number] = self._scene.add_point_cloud(
                    f"/cloud/{number}",
                    piece[:, :3],
                    piece[:, 3:].astype(np.uint8),
                    point_size=point_size,
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                    visible=is_visible,
                )

    def set_visible(self, is_visible: bool) -> None:
        """Show or hide it."""
        for node in self._nodes.values():
            node.visible = is_visible


class Segments:
    """A few lines that are all drawn anew."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        self._scene = scene
        self._name = name
        self._node: Any = None

    def show(self, segments: FloatArray, *, is_visible: bool) -> None:
        """Draw lines of shape (n, 2, 3), metres, in the world."""
        if self._node is not None and len(segments) > 0:
            self._node.points = segments.astype(np.float32)
            return
        if self._node is not None:
            self._node.remove()
            self._node = None
        if len(segments) > 0:
            self._node = self._scene.add_line_segments(
                f"/{self._name.replace(' ', '_')}",
                segments.astype(np.float32),
                rgb(COLOURS[self._name]),
                thickness=2.0,
                thickness_units="screen",
                visible=is_visible,
            )

    def set_visible(self, is_visible: bool) -> None:
        """Show or hide it."""
        if self._node is not None:
            self._node.visible = is_visible


def _dashes(n: int) -> NDArray[np.bool_]:
    """Return which of n segments are drawn: two of three, and all of a few."""
    drawn: NDArray[np.bool_] = (np.arange(n) % 3 != 2) | (n < 3)
    return drawn


class ChunkedArray:
    """Cuts rows into pieces of equal size and tells which of them differ from before.

    Parameters
    ----------
    size : int
        Rows of a piece.
    n_shared : int
        Rows that a piece shares with the next: 1 where the rows are corners of a line.
    """

    def __init__(self, size: int, *, n_shared: int = 0) -> None:
        self._size = size
        self._n_shared = n_shared
        self._rows: NDArray[Any] | None = None

    def update(self, rows: NDArray[Any]) -> dict[int, NDArray[Any]]:
        """Return the pieces that changed, by number; an empty one went away.

        Parameters
        ----------
        rows : ndarray, shape (n, m)
        """
        before, self._rows = self._rows, rows.copy()
        if before is None:
            before = rows[:0]
        n_same = _common_prefix(before, rows)
        if n_same == len(before) == len(rows):
            return {}
        first = max(0, n_same - self._n_shared) // self._size
        last = (max(len(before), len(rows)) - 1) // self._size
        return {number: self._piece(rows, number) for number in range(first, last + 1)}

    def _piece(self, rows: NDArray[Any], number: int) -> NDArray[Any]:
        start = number * self._size
        piece = rows[start : start + self._size + self._n_shared]
        return piece if len(piece) > self._n_shared else piece[:0]


def _common_prefix(before: NDArray[Any], after: NDArray[Any]) -> int:
    n = min(len(before), len(after))
    differs = np.any(before[:n] != after[:n], axis=1)
    return int(np.argmax(differs)) if differs.any() else n
