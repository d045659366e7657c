"""The numbers of a frame for the page."""

from __future__ import annotations

import numpy as np

from gvo.trajectory.trajectory import format_stamp
from gvo.viz.scene import Scene, position_sigmas
from gvo.viz.view.newest import FrameView


def frame_rows(frame: FrameView, n_frames: int) -> dict[str, str]:
    """Return the numbers of a frame, value by label."""
    rows = {
        "frame": f"{frame.index} of {n_frames}",
        "stamp [s]": format_stamp(frame.stamp_ns),
        "status": "skipped" if frame.result is None else str(frame.result.status),
    }
    if frame.reason:
        rows["reason"] = frame.reason
    return rows if frame.scene is None else rows | _scene_rows(frame.scene)


def _scene_rows(scene: Scene) -> dict[str, str]:
    counts, estimate = scene.counts, scene.poses["causal"]
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in scene.stage_ms.items())
    turn_deg = np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))
    refused = f" ({counts['refused']} refused)" if counts["refused"] else ""
    return {
        **{name: f"{counts[name]}" for name in ("keypoints", "matches", "inliers")},
        "links": f"{counts['links']}{refused}",
        "keyframes": f"{counts['keyframes']}",
        "ms": f"{sum(scene.stage_ms.values()):.1f} ({stages})",
        "position [m]": ", ".join(f"{value:.3f}" for value in estimate.T_world_frame[:3, 3]),
        "sigma [m]": ", ".join(f"{value:.4f}" for value in position_sigmas(estimate)),
        "turn sigma [deg]": f"{turn_deg:.3f}",
    }
