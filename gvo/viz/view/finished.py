"""The page of a finished run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import viser

from gvo.errors import RecordingError, TrajectoryError
from gvo.io.run_folder.reader import RunRecord, read_run
from gvo.io.run_folder.writer import GLOBAL
from gvo.trajectory.alignment import alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.view import panels
from gvo.viz.view.player import RunPlayer
from gvo.viz.view.scene import COLOURS, Scene, Up
from gvo.viz.view.server import ViewServer, open_server

N_ELLIPSOIDS = 60
"""How many covariances are drawn at most along the path."""

_MAX_START_SIGMAS = 10
# Largest half axis at first, as a share of the extent of the path.
_ELLIPSOID_SHARE = 0.07
_PATHS = ("raw", "causal", "smoothed", "global")
_DRAWN = {*_PATHS, "truth", "ellipsoids", "loops", "refused loops"}
_NOT_RECORDED = {"keyframes", "links", "image", "points", "cloud"}


def serve_record(folder: Path, *, host: str, port: int, name: str) -> ViewServer:
    """Serve the page of a run folder; see `gvo.viz.view.serve`."""
    record = read_run(folder)
    if len(record.frames.stamps_ns) == 0:
        raise RecordingError(f"{folder}: holds no frames: there is nothing to show; run again")
    view = open_server(host, port, title=f"gvo {name or record.name}")
    view.on_close(FinishedPage(view.viser, record).close)
    return view


def world_up(record: RunRecord) -> Up:
    """Return which axis points up: -y where the world is the first camera, else +z."""
    poses = tracked(record)
    is_first = len(poses) == 0 or np.allclose(poses.T_world_frame[0], np.eye(4), atol=1e-6)
    return "-y" if is_first and _is_of_camera(record.summary) else "+z"


def _is_of_camera(summary: Mapping[str, Any]) -> bool:
    """Tell whether the poses are those of the camera, whatever its frame is called."""
    run = summary.get("run")
    if run is None:
        return bool(summary.get("base_frame", "camera") == "camera")
    return bool(run["output"]["frame"] == run["recording"]["frame_id"])


def tracked(record: RunRecord) -> Trajectory:
    """Return the causal poses; where all was optimized at once, which has none, the smoothed."""
    causal, smoothed = (record.trajectories[name] for name in ("causal", "smoothed"))
    return causal if len(causal) else smoothed


def aligned_truth(record: RunRecord) -> Trajectory | None:
    """Return the truth in the world of the run, fitted to the smoothed positions."""
    estimates = record.comparable()
    estimate = estimates.get("smoothed") or estimates.get("causal")
    if record.truth is None or estimate is None or len(record.truth) == 0:
        return None
    try:
        truth, paired = pair(record.truth, estimate)
    except TrajectoryError:
        return None
    return alignment(paired, truth, "se3").apply(record.truth)


def start_sigmas(record: RunRecord) -> int:
    """Return the number of sigmas with which ellipsoids are seen and do not hide the path."""
    smoothed = record.trajectories["smoothed"]
    if smoothed.covariances is None or len(smoothed) == 0:
        return _MAX_START_SIGMAS
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(smoothed.covariances[:, 3:, 3:]).max()))
    reach_m = float(np.linalg.norm(np.ptp(smoothed.positions, axis=0)))
    n_sigmas = _ELLIPSOID_SHARE * reach_m / max(sigma_m, 1e-9)
    return int(np.clip(n_sigmas, 1, _MAX_START_SIGMAS))


class FinishedPage:
    """Shows a run frame by frame.

    Parameters
    ----------
    server : viser.ViserServer
    record : RunRecord
        Of at least one frame.
    """

    def __init__(self, server: viser.ViserServer, record: RunRecord) -> None:
        self._server, self._record = server, record
        self._truth = aligned_truth(record)
        held = record.trajectories
        # Of a graph optimized at once there are no causal poses, and covariances only on request.
        self._absent = {*_NOT_RECORDED, *(name for name in held if len(held[name]) == 0)}
        self._absent |= set() if self._truth is not None else {"truth"}
        self._absent |= set() if held["smoothed"].covariances is not None else {"ellipsoids"}
        if GLOBAL not in record.trajectories:
            self._absent |= {GLOBAL, "loops", "refused loops"}
        up = world_up(record)
        self.scene = Scene(server.scene, up=up)
        self._add_frame_panel()
        self.player = RunPlayer(record.frames.stamps_ns, lambda index: self._painter.offer())
        self.playback = panels.Playback(server.gui, self.player, before=lambda: None)
        self._view = panels.ViewPoint(server, up, is_following=False)
        self._painter = panels.Painter(self.draw)
        self._sigmas = panels.add_scene_controls(
            server.gui, self.scene, self._absent, start_sigmas(record)
        )
        self._sigmas.on_update(lambda _: self._painter.offer())
        self._sigmas.visible = "ellipsoids" not in self._absent
        self._show_all()
        self.player.seek(self.player.n_frames - 1)

    def close(self) -> None:
        """End the threads of the page."""
        self.player.close()
        self._painter.close()

    def settle(self) -> None:
        """Wait until the frame that was asked for last is drawn."""
        self._painter.settle()

    def draw(self) -> None:
        """Draw the run up to the frame of the player."""
        index = self.player.index
        stamp_ns = int(self._record.frames.stamps_ns[index])
        with self._server.atomic():
            self.playback.show(index)
            self.numbers.content = panels.numbers_html(self._rows(index, stamp_ns))
            past = {
                name: trajectory.select(trajectory.stamps_ns <= stamp_ns)
                for name, trajectory in self._record.trajectories.items()
            }
            for name, trajectory in past.items():
                self.scene.show_path(name, trajectory.positions)
            if self._record.loops is not None and GLOBAL in past:
                self.scene.show_links(self._record.loops.lines_on(past[GLOBAL]))
            if self._truth is not None:
                is_past = self._truth.stamps_ns <= stamp_ns
                self.scene.show_path("truth", self._truth.positions[is_past])
            self._draw_ellipsoids(stamp_ns)
            T_world_frame = self._pose(stamp_ns)
            if T_world_frame is not None:
                self.scene.show_pose(T_world_frame)
                self._view.show_pose(T_world_frame)

    def _add_frame_panel(self) -> None:
        with panels.add_frame_panel(self._server):
            self.numbers = self._server.gui.add_html("")
            shown = _DRAWN - self._absent
            self._server.gui.add_html(panels.legend_html(name for name in COLOURS if name in shown))

    def _show_all(self) -> None:
        """Choose sizes and the view by the whole path."""
        positions = [t.positions for t in self._record.trajectories.values() if len(t) > 0]
        if not positions:
            return
        points = np.concatenate(positions)
        reach = max(0.1, float(np.linalg.norm(np.ptp(points, axis=0))))
        self.scene.set_camera(4, 3, 3.0, size_m=0.04 * reach)
        up = panels.UP[self.scene.up]
        ground = points[np.argmin(points @ up)] - 0.02 * reach * up
        self.scene.show_ground(ground, panels.grid_cell(0.1 * reach))
        self._view.look_down(points)

    def _rows(self, index: int, stamp_ns: int) -> dict[str, str]:
        frames = self._record.frames
        rows = panels.frame_rows(index, self.player.n_frames, stamp_ns, frames.statuses[index])
        if frames.reasons[index]:
            rows["reason"] = frames.reasons[index]
        rows |= {name: f"{counts[index]}" for name, counts in frames.counts.items()}
        rows |= self._milliseconds(stamp_ns)
        poses = tracked(self._record)
        row = int(np.searchsorted(poses.stamps_ns, stamp_ns))
        if row < len(poses) and poses.stamps_ns[row] == stamp_ns:
            covariance = None if poses.covariances is None else poses.covariances[row]
            rows |= panels.pose_rows(poses.T_world_frame[row], covariance)
        return rows

    def _milliseconds(self, stamp_ns: int) -> dict[str, str]:
        timings = self._record.timings
        if timings is None:
            return {}
        (found,) = np.nonzero(timings.stamps_ns == stamp_ns)
        stages = {name: float(ms[found[0]]) for name, ms in timings.stages_ms.items() if len(found)}
        known = {name: ms for name, ms in stages.items() if np.isfinite(ms)}
        parts = ", ".join(f"{name} {ms:.1f}" for name, ms in known.items())
        return {"ms": f"{sum(known.values()):.1f} ({parts})"} if known else {}

    def _pose(self, stamp_ns: int) -> FloatArray | None:
        """Return the last pose until a stamp."""
        poses = tracked(self._record)
        row = int(np.searchsorted(poses.stamps_ns, stamp_ns, side="right")) - 1
        return poses.T_world_frame[row] if row >= 0 else None

    def _draw_ellipsoids(self, stamp_ns: int) -> None:
        """Draw covariances along the smoothed path, of the same poses whatever frame is shown."""
        smoothed = self._record.trajectories["smoothed"]
        every = max(1, -(-len(smoothed) // N_ELLIPSOIDS))
        thinned = smoothed.select(slice(None, None, every))
        is_past = thinned.stamps_ns <= stamp_ns
        if thinned.covariances is not None:
            self.scene.show_ellipsoids(
                thinned.T_world_frame[is_past], thinned.covariances[is_past], self._sigmas.value
            )
