"""The tree of frames: one tree, with the camera in it, without gaps."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.limits import judged, measured, unknown
from gvo.io.bag.messages import bare
from gvo.io.poses.tf import TfBuffer, describe_parents
from gvo.io.poses.truth import TRUTH_FRAMES
from gvo.types import Failure, IntArray

_N_NAMED = 5
# A tree of fewer frames is a pair of cameras, or a data set with its ground truth: no robot.
_MIN_FRAMES = 3


def check_frame_tree(
    buffer: TfBuffer, camera_frame: str, stamps_ns: IntArray, *, base_frame: str
) -> Iterator[Finding]:
    """Yield what is missing between the camera, the robot's base and the root of their tree.

    Odometry itself needs no transforms; `--frame` and ground truth from `/tf` do.
    """
    edges = buffer.edges - {(TRUTH_FRAMES.parent, TRUTH_FRAMES.child)}
    frames = {name for edge in edges for name in edge}
    if len(frames) < _MIN_FRAMES:
        yield Finding(name="tf: frames", value=", ".join(sorted(buffer.frames)) or "none")
        return
    roots = {parent for parent, _ in edges} - {child for _, child in edges}
    parents = describe_parents(edges)
    yield _check_trees(len(frames), roots, parents)
    camera, base_frame = bare(camera_frame), bare(base_frame)
    if not camera:
        yield unknown("tf: camera", "the images name no frame")
        return
    if camera not in frames:
        yield Finding(
            name="tf: camera",
            value=f"{camera} is in no transform",
            threshold="in the tree",
            verdict="warning",
            fix=f"record /tf_static, or publish where {camera} is on the robot",
        )
        return
    yield _check_base(buffer, camera, base_frame, parents)
    root = next((root for root in sorted(roots) if buffer.chain(root, camera)), None)
    if root is not None and root != camera:
        yield from _check_gaps(buffer.edge_stamps_ns(root, camera), root, camera, stamps_ns)


def _check_trees(n_frames: int, roots: Collection[str], parents: str) -> Finding:
    names = sorted(roots)
    more = ", ..." if len(names) > _N_NAMED else ""
    return judged(
        "tf: frames",
        f"{n_frames} in {len(names)} tree{'s' if len(names) != 1 else ''}"
        f" (root {', '.join(names[:_N_NAMED])}{more})",
        is_ok=len(names) <= 1 and not parents,
        threshold="1 tree",
        fix=parents or "a transform between the trees is missing: record /tf_static as well",
    )


def _check_base(buffer: TfBuffer, camera: str, base_frame: str, parents: str) -> Finding:
    name = "tf: camera"
    if base_frame not in buffer.frames:
        return Finding(name=name, value=f"{camera} is in the tree, there is no {base_frame}")
    chain = buffer.chain(base_frame, camera)
    return judged(
        name,
        f"{camera} is not connected to {base_frame}"
        if isinstance(chain, Failure)
        else " - ".join(chain),
        is_ok=not isinstance(chain, Failure),
        threshold=f"connected to {base_frame}",
        fix=parents or "record /tf_static, or give the camera's pose on the robot in a file",
    )


def _check_gaps(
    edge_stamps_ns: IntArray, root: str, camera: str, stamps_ns: IntArray
) -> Iterator[Finding]:
    name = f"tf: {root} to {camera}"
    if len(edge_stamps_ns) == 0:
        yield Finding(name=name, value="static", verdict="ok")
        return
    first_ns, last_ns = edge_stamps_ns[0], edge_stamps_ns[-1]
    if len(stamps_ns):
        share = float(np.mean((stamps_ns < first_ns) | (stamps_ns > last_ns)))
        text = f"{share:.1%} of the images"
        yield measured(f"{name}: images outside", share, text=text)
    longest_s = float(np.diff(edge_stamps_ns).max(initial=0)) / 1e9
    yield measured(f"{name}: gaps", longest_s, rule="transform gaps")
