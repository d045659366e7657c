"""A window's graph as text for g2o, GTSAM and their viewers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gvo.g2o import format_edge, format_vertex
from gvo.types import FloatArray, FrameId, GraphEdge


def g2o_lines(poses: Mapping[FrameId, FloatArray], graph: Sequence[GraphEdge]) -> Iterator[str]:
    """Yield vertices and edges, without line ends.

    Frames that are named by whole numbers keep them; others are numbered in their order, the
    name behind the vertex as a comment. Priors, for which the format has no line that all
    readers know, are left out.

    Parameters
    ----------
    poses : mapping of hashable to ndarray of float64, shape (4, 4)
        T_world_frame.
    graph : sequence of GraphEdge
    """
    is_numbered = all(
        isinstance(frame_id, int | np.integer) and frame_id >= 0 for frame_id in poses
    )
    numbers = {
        frame_id: frame_id if is_numbered else number for number, frame_id in enumerate(poses)
    }
    for frame_id, T in poses.items():
        comment = "" if is_numbered else f"  # {frame_id!r}"
        yield f"{format_vertex(str(numbers[frame_id]), T)}{comment}"
    for edge in graph:
        if edge.reference_id is not None:
            yield format_edge(
                str(numbers[edge.reference_id]),
                str(numbers[edge.frame_id]),
                edge.T_reference_frame,
                edge.covariance,
            )
