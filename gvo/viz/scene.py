"""What is drawn of a run: by the page, by Rerun, and by RViz and Foxglove, from the same values."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.convert.bag_messages import pose_numbers
from gvo.types import (
    BoolArray,
    Estimate,
    FloatArray,
    FrameResult,
    ImageArray,
    IntArray,
    Loop,
    RelativePose,
)

ESTIMATES: Final = ("raw", "causal", "smoothed")
GLOBAL: Final = "global"
"""The estimate that comes at the end of a run."""
N_SHOWN_POSES: Final = 500
"""Most poses of a path while the run goes."""
NOTHING: Final = RelativePose(T_reference_current=np.eye(4), covariance=np.zeros((6, 6)))
"""A registration without matches."""

# Stamps (n,) in nanoseconds; positions in metres and quaternions (x, y, z, w), (n, 7).
Path: TypeAlias = tuple[IntArray, FloatArray]
_N_NUMBERS = 7
_SECOND_NS = 10**9
_MAX_LOOPS = 1000  # that are drawn


class StampedPose(NamedTuple):
    """Stamp in nanoseconds and pose (4, 4) of a frame."""

    stamp_ns: int
    T_world_frame: FloatArray


class Track:
    """The poses of one estimate so far, 64 bytes each, in the order of their stamps."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._poses = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, estimate: Estimate) -> None:
        """Take a pose, in any order of stamps; one of the same stamp is replaced."""
        index = bisect_left(self._stamps_ns, estimate.stamp_ns)
        numbers = array("d", pose_numbers(estimate.T_world_frame).tolist())
        start = _N_NUMBERS * index
        if estimate.stamp_ns in self._stamps_ns[index : index + 1]:
            self._poses[start : start + _N_NUMBERS] = numbers
        else:
            self._stamps_ns.insert(index, estimate.stamp_ns)
            self._poses[start:start] = numbers

    def before(self, stamp_ns: int) -> StampedPose | None:
        """Return stamp and pose (4, 4) of the latest pose before a stamp."""
        index = bisect_left(self._stamps_ns, stamp_ns) - 1
        if index < 0:
            return None
        numbers = np.array(self._poses[_N_NUMBERS * index : _N_NUMBERS * (index + 1)])
        R = np.asarray(Rotation.from_quat(numbers[3:]).as_matrix())
        return StampedPose(self._stamps_ns[index], se3.make_transform(R, numbers[:3]))

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Return the pose (4, 4) at a stamp, if there is one."""
        pose = self.before(stamp_ns + 1)
        return pose.T_world_frame if pose is not None and pose.stamp_ns == stamp_ns else None

    def path(self, n_most: int | None = None) -> Path:
        """Return stamps (n,) and poses (n, 7).

        Of more than `n_most`, every second, fourth, ... and the last are taken: those shown stay
        the same while the track grows.
        """
        stride = 1
        while n_most is not None and stride * (n_most - 1) < len(self) > n_most:
            stride *= 2
        rows = np.arange(0, len(self) - 1 + stride, stride).clip(max=len(self) - 1)
        stamps_ns = np.frombuffer(self._stamps_ns, dtype=np.int64)
        return stamps_ns[rows], np.frombuffer(self._poses).reshape(-1, _N_NUMBERS)[rows]

    def lines(self, loops: Iterable[Loop]) -> FloatArray:
        """Return lines (n, 2, 3) from frame to reference of those loops that count, metres."""
        ends = [
            [self._position(loop.stamp_ns), self._position(loop.reference_ns)]
            for loop in loops
            if not loop.reason
        ]
        return np.array([each for each in ends if None not in each]).reshape(-1, 2, 3)

    def _position(self, stamp_ns: int) -> array[float] | None:
        index = bisect_left(self._stamps_ns, stamp_ns)
        is_there = stamp_ns in self._stamps_ns[index : index + 1]
        return self._poses[_N_NUMBERS * index : _N_NUMBERS * index + 3] if is_there else None

    def forget(self, n: int) -> None:
        """Forget the n oldest poses."""
        del self._stamps_ns[:n], self._poses[: _N_NUMBERS * n]


class History:
    """What a run has given so far, appended to frame by frame.

    Attributes
    ----------
    tracks : dict of str to Track
        Of "raw", "causal", "smoothed" and "global".
    keyframes : dict of int to Estimate
        The kept frames by stamp, as they are known best.
    window : dict of int to Estimate
        Newest poses of the window by stamp, where they were given.
    loops : list of Loop
        Those that were confirmed, a thousand at most, the newest ones.
    is_second_new : bool
        Whether a second of the recording began with the newest frame.
    """

    def __init__(self) -> None:
        self.tracks = {name: Track() for name in (*ESTIMATES, GLOBAL)}
        self.keyframes: dict[int, Estimate] = {}
        self.window: dict[int, Estimate] = {}
        self.loops: list[Loop] = []
        self.is_second_new = False
        self._first_ns: int | None = None
        self._n_seconds = 0

    def add(self, result: FrameResult) -> None:
        """Take what a frame gave."""
        if self._first_ns is None:
            self._first_ns = result.stamp_ns
        n_seconds = (result.stamp_ns - self._first_ns) // _SECOND_NS
        self.is_second_new = n_seconds > self._n_seconds
        self._n_seconds = max(n_seconds, self._n_seconds)
        for name, estimate in (("raw", result.raw), ("causal", result.causal)):
            self.tracks[name].add(estimate)
        known = {**self.keyframes, result.stamp_ns: result.causal}
        self.keyframes = {ns: known[ns] for ns in result.keyframes_ns if ns in known}
        self.loops = [*self.loops, *result.loops][-_MAX_LOOPS:]
        self.add_late("smoothed", result.finished)

    def add_late(self, name: str, estimates: Iterable[Estimate]) -> None:
        """Take smoothed or global poses, in any order."""
        for estimate in estimates:
            self.tracks[name].add(estimate)

    def forget(self, n_most: int) -> None:
        """Forget the older half of the poses where there are too many."""
        for track in self.tracks.values():
            if len(track) > n_most:
                track.forget(n_most // 2)

    def correct(self, estimates: Iterable[Estimate]) -> None:
        """Take the newest poses of the window: better ones than those known, but not final."""
        self.window = {estimate.stamp_ns: estimate for estimate in estimates}
        self.keyframes |= {ns: self.window[ns] for ns in self.keyframes if ns in self.window}
        self.add_late("smoothed", self.window.values())

    def paths(self, n_most: int | None = None) -> dict[str, Path]:
        """Return the paths so far by name, see `Track.path`; those without a pose are left out."""
        return {name: track.path(n_most) for name, track in self.tracks.items() if len(track)}

    def position(self, stamp_ns: int) -> FloatArray | None:
        """Return the position (3,) of a frame as the window has it, else as it was when it came."""
        if stamp_ns in self.window:
            return self.window[stamp_ns].T_world_frame[:3, 3]
        T = self.tracks["causal"].at(stamp_ns)
        return None if T is None else T[:3, 3]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points:
    """The matched points of a frame that are finite.

    Parameters
    ----------
    points_cam : ndarray of float64, shape (n, 3)
        In the `cam` frame, metres.
    pixels : ndarray of float64, shape (n, 2)
        Where they are in the image, (u, v); NaN where the front-end does not tell.
    inliers : ndarray of bool, shape (n,)
        Which the pose rests on.
    """

    points_cam: FloatArray
    pixels: FloatArray
    inliers: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What is drawn of a run at one of its frames.

    Parameters
    ----------
    stamp_ns : int
        Of the frame, nanoseconds.
    poses : dict of str to Estimate
        Raw and causal pose of the frame.
    keyframes, window : tuple of Estimate
        As `History` has them.
    paths : dict of str to Path
        Where a full second of the recording begins, each of at most 500 poses; else none.
    lines : dict of str to ndarray of float64, shape (n, 2, 3)
        Links of the frame by kind ("step", "keyframe link", "depth", "imu") or "refused",
        and its "loops", metres.
    points : Points
    counts, stage_ms, chi2 : dict of str to number
        Counts by name, milliseconds by stage, mean of the accepted links by kind.
    caption : list of str
        How the frame was tracked, and what is special about it.
    """

    stamp_ns: int
    poses: dict[str, Estimate]
    keyframes: tuple[Estimate, ...]
    window: tuple[Estimate, ...]
    paths: dict[str, Path]
    lines: dict[str, FloatArray]
    points: Points
    counts: dict[str, int]
    stage_ms: dict[str, float]
    chi2: dict[str, float]
    caption: list[str]


def scene(result: FrameResult, history: History) -> Scene:
    """Return what is drawn of a frame.

    Parameters
    ----------
    result : FrameResult
        Of the frame, with poses in the same world as those of the history.
    history : History
        Of the run up to this frame, which was added to it.
    """
    loops = history.tracks["causal"].lines(result.loops)
    return Scene(
        stamp_ns=result.stamp_ns,
        poses={"raw": result.raw, "causal": result.causal},
        keyframes=tuple(history.keyframes.values()),
        window=tuple(history.window.values()),
        paths=history.paths(N_SHOWN_POSES) if history.is_second_new else {},
        lines=_links(result, history) | ({"loops": loops} if len(loops) else {}),
        points=matched_points(result),
        counts={
            "keypoints": result.n_keypoints,
            "points": result.n_points,
            "matches": result.n_matches,
            "inliers": result.n_inliers,
            "links": result.n_links,
            "refused": sum(not link.is_accepted for link in result.links),
            "keyframes": len(result.keyframes_ns),
            "loops": len(result.loops),
        },
        stage_ms=result.stage_ms,
        chi2=_chi2(result),
        caption=caption(result),
    )


def _links(result: FrameResult, history: History) -> dict[str, FloatArray]:
    here = result.causal.T_world_frame[:3, 3]
    lines: dict[str, list[FloatArray]] = {}
    for link in result.links:
        start = history.position(link.reference_ns)
        if start is not None:
            name = "keyframe link" if link.kind == "keyframe" else link.kind
            ends = np.stack([start, here])
            lines.setdefault(name if link.is_accepted else "refused", []).append(ends)
    return {name: np.stack(ends) for name, ends in lines.items()}


def matched_points(result: FrameResult) -> Points:
    """Return the matched points of a frame; none without a registration."""
    found = result.registration or NOTHING
    points_cam, pixels = found.points_current, found.pixels_current
    if len(pixels) != len(points_cam):
        pixels = np.full((len(points_cam), 2), np.nan)
    is_finite = np.isfinite(points_cam).all(axis=1)
    inliers = found.inliers[: len(points_cam)][is_finite]
    return Points(points_cam=points_cam[is_finite], pixels=pixels[is_finite], inliers=inliers)


def _chi2(result: FrameResult) -> dict[str, float]:
    values: dict[str, list[float]] = {}
    for link in result.links:
        if link.is_accepted and link.chi2 is not None:
            values.setdefault(link.kind, []).append(link.chi2)
    return {kind: float(np.mean(found)) for kind, found in values.items()}


def caption(result: FrameResult) -> list[str]:
    """Say how a frame was tracked, in a line, and what is special about it, in others."""
    counts = f"{result.n_inliers} of {result.n_matches} matches are inliers, {result.n_links} links"
    special = result.reason, loop_text(result)
    return [f"{result.status}: {counts}", *(text for text in special if text)]


def loop_text(result: FrameResult) -> str:
    """Say to what the newest loop of a frame leads; nothing where there is none."""
    if not result.loops:
        return ""
    loop = result.loops[-1]
    ago_s = 1e-9 * (loop.stamp_ns - loop.reference_ns)
    return f"loop to {ago_s:.1f} s before, {loop.n_inliers} inliers"


def placed_matches(result: FrameResult) -> RelativePose:
    """Return the registration of a frame with those matches that have points; none without it."""
    found = result.registration or NOTHING
    n = min(len(found.pixels_current), len(found.points_current))
    names = "pixels_reference", "pixels_current", "points_current", "inliers"
    return replace(found, **{name: getattr(found, name)[:n] for name in names})


def grey_values(image: ImageArray, pixels: FloatArray) -> ImageArray:
    """Return the grey values (n,) of the nearest pixels; 0 outside the image."""
    height, width = image.shape
    u, v = np.rint(np.nan_to_num(pixels, nan=-1.0)).T
    is_inside: BoolArray = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values = np.zeros(len(pixels), dtype=np.uint8)
    values[is_inside] = image[v[is_inside].astype(np.int64), u[is_inside].astype(np.int64)]
    return values


class Ellipsoids(NamedTuple):
    """Centres (n, 3) and half axes (n, 3) in metres, quaternions (n, 4) of the axes, x first."""

    centres: FloatArray
    half_axes: FloatArray
    quaternions_xyzw: FloatArray


def ellipsoids(estimates: Sequence[Estimate], n_sigmas: float) -> Ellipsoids:
    """Return the ellipsoids of positions in the world.

    Parameters
    ----------
    estimates : sequence of Estimate
        Those whose covariance is not finite are left out.
    n_sigmas : float
        Half axes are so many standard deviations.
    """
    known = [each for each in estimates if np.isfinite(each.covariance).all()]
    T_world_frame = np.array([each.T_world_frame for each in known]).reshape(-1, 4, 4)
    covariances = np.array([each.covariance for each in known]).reshape(-1, 6, 6)
    # They are stated along the axes of the frame: the pose turns them into the world.
    variances, axes = np.linalg.eigh(covariances[:, 3:, 3:])
    axes = T_world_frame[:, :3, :3] @ axes
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, np.newaxis]
    quaternions = Rotation.from_matrix(axes).as_quat() if known else np.zeros((0, 4))
    half_axes = n_sigmas * np.sqrt(np.maximum(variances, 0.0))
    return Ellipsoids(T_world_frame[:, :3, 3], half_axes, np.asarray(quaternions))


def position_sigmas(estimate: Estimate) -> FloatArray:
    """Return the standard deviations (3,) of a position along the axes of the world, metres."""
    R = estimate.T_world_frame[:3, :3]
    return np.asarray(np.sqrt(np.diag(R @ estimate.covariance[3:, 3:] @ R.T)))
