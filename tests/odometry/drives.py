"""Simulated drives: exact poses, and a graph of a run that measures them with noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TypeAlias

import numpy as np

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.odometry.graph import RunGraph
from gvo.odometry.loops import LoopDetector
from gvo.types import Edge, Failure, FloatArray, Loop, Optimum, RelativePose
from tests.make.results import estimate_at

Rng: TypeAlias = np.random.Generator | None
# Of the length of a motion, and of its turn: radians per metre.
Bias: TypeAlias = tuple[float, float] | None

SIGMAS = np.array([0.001, 0.001, 0.001, 0.01, 0.01, 0.01])
PERIOD_NS = 100_000_000


def block(n_laps: float = 1.2, *, n_per_lap: int = 200, side_m: float = 50.0) -> FloatArray:
    """Return T_world_frame of a drive around a block with round corners, shape (n, 4, 4)."""
    s = np.arange(int(n_laps * n_per_lap)) / n_per_lap
    # The heading turns in the last fifth of each side.
    side, rest = np.divmod(4.0 * s, 1.0)
    yaw = 0.5 * np.pi * (side + np.clip((rest - 0.8) / 0.2, 0.0, 1.0))
    forward = np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=1)
    lap = forward[:n_per_lap]
    centred = forward - lap.mean(axis=0)
    positions = np.cumsum(centred, axis=0) * 4.0 * side_m / n_per_lap
    twists = np.stack([0 * yaw, yaw, 0 * yaw, 0 * yaw, 0 * yaw, 0 * yaw], axis=1)
    T = se3.exp(twists)
    T[:, :3, 3] = positions
    return se3.invert(T[0]) @ T


def measured(
    truth: FloatArray,
    i: int,
    j: int,
    sigmas: FloatArray,
    rng: Rng,
    *,
    bias: Bias = None,
    told: Bias = None,
) -> Edge:
    """Return the edge from frame i to frame j, with noise and a bias of its scale and yaw.

    If the sizes of both are told, the edge has their effects.
    """
    T = se3.invert(truth[i]) @ truth[j]
    effects = None
    if told is not None:
        effects = np.zeros((6, 2))
        effects[3:, 0] = told[0] * T[:3, :3].T @ T[:3, 3]
        effects[1, 1] = told[1] * np.linalg.norm(T[:3, 3])
    if bias is not None:
        scale, yaw = bias
        T = T.copy()
        T[:3, 3] *= 1.0 + scale
        turn = np.array([0.0, yaw * np.linalg.norm(T[:3, 3]), 0.0, 0.0, 0.0, 0.0])
        T = T @ se3.exp(turn)
    noise = np.zeros(6) if rng is None else sigmas * rng.normal(size=6)
    return Edge(
        reference_id=i * PERIOD_NS,
        T_reference_frame=T @ se3.exp(noise),
        covariance=np.diag(sigmas**2),
        effects=effects,
    )


class Drive:
    """A graph of a run along true poses; every few frames one is a keyframe."""

    def __init__(
        self,
        truth: FloatArray,
        rng: Rng = None,
        *,
        every: int = 5,
        n_links: int = 2,
        bias: Bias = None,
        told: Bias = None,
        sigmas: FloatArray = SIGMAS,
        max_frames: int = 3000,
    ) -> None:
        self.truth, self.rng, self.bias, self.sigmas = truth, rng, bias, sigmas
        self.told = told
        self.graph = RunGraph(max_frames=max_frames)
        self.every, self.n_links = every, n_links
        self.keyframes = [0]
        self.edges: list[list[Edge]] = []
        self.T = truth[0]

    def step(self, j: int) -> None:
        """Add frame j, measured from the frame before and from the latest keyframes."""
        edges: list[Edge] = []
        if j > 0:
            edges.append(self._measured(j - 1, j, self.sigmas))
            self.T = self.T @ edges[0].T_reference_frame
            for k in self.keyframes[-self.n_links :] if self.n_links else []:
                if k < j - 1:
                    edges.append(self._measured(k, j, 1.5 * self.sigmas))
        is_keyframe = j % self.every == 0
        estimate = estimate_at(j * PERIOD_NS, self.T, frame_id=j * PERIOD_NS)
        self.edges.append(edges)
        self.graph.add_frame(estimate, edges, is_place=is_keyframe)
        if is_keyframe and j > 0:
            self.keyframes.append(j)

    def _measured(self, i: int, j: int, sigmas: FloatArray) -> Edge:
        return measured(self.truth, i, j, sigmas, self.rng, bias=self.bias, told=self.told)

    def run(self) -> Drive:
        for j in range(len(self.truth)):
            self.step(j)
        return self

    def loop(self, i: int, j: int, *, T: FloatArray | None = None) -> Loop:
        """Return a loop between two frames; of another motion than the true one, if given."""
        edge = measured(self.truth, i, j, self.sigmas, self.rng)
        return Loop(
            stamp_ns=j * PERIOD_NS,
            reference_ns=i * PERIOD_NS,
            T_reference_frame=edge.T_reference_frame if T is None else T,
            covariance=edge.covariance,
            n_matches=100,
            n_inliers=80,
        )


def poses(optimum: Optimum) -> FloatArray:
    return np.array([each.T_world_frame for each in optimum.estimates])


def position_error(T: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square of the distances of positions, metres."""
    return float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


class MadeUpPlaces:
    """A front-end for loops whose images are numbers of frames: a place is where its frame was.

    Places of one lap have descriptors of their own; a tenth of the bits differ in each lap.
    """

    def __init__(self, truth: FloatArray, n_per_lap: int, *, n_points: int = 60) -> None:
        self.truth, self.n_per_lap = truth, n_per_lap
        self.rng = np.random.default_rng(0)
        bits = self.rng.integers(0, 2, (n_per_lap, n_points, 256), dtype=np.uint8)
        self.descriptors = np.packbits(bits, axis=2)
        depths = self.rng.uniform(4.0, 20.0, 50)
        rays = np.c_[self.rng.uniform(-0.6, 0.6, 50), self.rng.uniform(-0.2, 0.2, 50), np.ones(50)]
        self.points_cam = depths[:, np.newaxis] * rays
        self.camera = StereoCamera(
            fx=500, fy=500, cx=320, cy=120, width=640, height=240, baseline=0.5
        )

    def extract(self, frame: int) -> int:
        return frame

    def describe(self, observations: int) -> SimpleNamespace:
        words = self.descriptors[observations % self.n_per_lap]
        flipped = self.rng.random((len(words), 256)) < 0.1
        return SimpleNamespace(
            stamp_ns=observations * PERIOD_NS,
            points_cam=self.points_cam,
            descriptors_left=words ^ np.packbits(flipped, axis=1),
        )

    def recognize(
        self, reference: SimpleNamespace, current: SimpleNamespace, observations: int
    ) -> RelativePose | Failure:
        """Measure the motion from a place to a frame near it."""
        i = reference.stamp_ns // PERIOD_NS
        edge = measured(self.truth, i, observations, SIGMAS, self.rng)
        if np.linalg.norm(edge.T_reference_frame[:3, 3]) > 3.0:
            return Failure(reason="somewhere else")
        return RelativePose(
            T_reference_current=edge.T_reference_frame,
            covariance=edge.covariance,
            matches=np.zeros((80, 2), dtype=np.int64),
            inliers=np.ones(80, dtype=np.bool_),
        )


def go_round(truth: FloatArray, n_per_lap: int, *, bias: Bias = None) -> Drive:
    """Drive with loops, found by made-up places."""
    drive = Drive(truth, np.random.default_rng(1), bias=bias)
    detector = LoopDetector(frontend=MadeUpPlaces(truth, n_per_lap), graph=drive.graph)
    drive.graph.loops = detector.loops
    for j in range(len(truth)):
        drive.step(j)
        if j % drive.every == 0:
            near = {k * PERIOD_NS for k in drive.keyframes[-10:]}
            loops = detector.look(j, drive.T, near=near)
            drive.graph.advance(is_looped=bool(loops))
    return drive
