"""Measure whether covariances tell the errors that are made: the NEES of relative poses over 1 s.

The normalized estimation error squared, e^T C^-1 e per degree of freedom, is one on average
where covariances C fit the errors e; above one they promise too much. It is taken of rotation
and translation apart, on rendered recordings of given seeds or on recordings with ground truth:

raw     over 1 s of the raw chain
window  between the newest pose and the one in the window that is nearest to 1 s old, 0.5 to 1.5 s,
        from their joint covariance (`odometry.window.relative_pose`)

Each row also names the largest bias: the mean of an error over its sigma, and its axis. Several
front-ends see the same frames, which are rendered once.

Example: python scripts/consistency.py --seeds 10-19 --frontends klt descriptor
"""

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

import gvo
from gvo.config import FrontendConfig
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.io.recording import Source
from gvo.types import FaultyFrame, FloatArray, Frame

WORLDS = {
    "drive": ("driving", "stereo", 80),
    "room": ("handheld", "rgbd", 120),
    "stereo_room": ("handheld", "stereo", 120),
}
KINDS = get_args(FrontendConfig.model_fields["kind"].annotation)
AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
SPAN_NS = 1_000_000_000
MOST_OFF_NS = 500_000_000

# A relative pose, with its covariance, and the stamps that it leads from and to.
Relative = tuple[int, int, FloatArray, FloatArray]


def main() -> None:
    """Parse the arguments and print one row for each kind of recording and estimate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="*", help="instead of rendered ones")
    parser.add_argument("--seeds", type=seeds, default="0-9", help="first and last, or one")
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--frontends", nargs="+", choices=KINDS, default=[])
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()
    kinds = [f"frontend.kind={kind}" for kind in arguments.frontends]
    settings = [[*arguments.set, kind] for kind in kinds] or [arguments.set]
    configs = [gvo.load_configuration(settings=each) for each in settings]
    print(f"{'recording':<34} {'pairs':>6} {'rotation':>9} {'translation':>12}  bias")
    for path in arguments.recordings:
        report(path.name, [gvo.open_recording(path, config=configs[0])], configs)
    if not arguments.recordings:
        for name in arguments.worlds:
            report(name, (rendered(name, seed) for seed in arguments.seeds), configs)


def seeds(text: str) -> range:
    """Return the seeds of a text such as 10-19 or 7."""
    first, _, last = text.partition("-")
    found = range(int(first), int(last or first) + 1)
    if not found:
        raise ValueError(text)
    return found


def rendered(name: str, seed: int) -> Source:
    """Return a rendered recording of a few seconds."""
    world, sensor, n_frames = WORLDS[name]
    return gvo.SyntheticRecording(world, sensor, n_frames=n_frames, seed=seed)  # type: ignore[arg-type]


def report(name: str, sources: Iterable[Source], configs: Sequence[gvo.Config]) -> None:
    """Run odometry over recordings and print the NEES of all their pairs together."""
    errors: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for source in sources:
        truth = source.ground_truth()
        if truth is None:
            raise gvo.GvoError(f"{source.info.name}: expected a ground truth, found none")
        frames = list(gvo.frames(source, configs[0]))  # those of all front-ends
        for config in configs:
            frontend = f"{config.frontend.kind} " if len(configs) > 1 else ""
            for kind, pairs in relative_poses(source.info.camera, frames, config).items():
                errors.setdefault(f"{frontend}{kind}", []).extend(compare(pairs, truth))
    for kind, pairs_of_kind in errors.items():
        if pairs_of_kind:
            print_row(f"{name} {kind}", *map(np.array, zip(*pairs_of_kind, strict=True)))


def relative_poses(
    camera: StereoCamera | PinholeCamera,
    frames: Iterable[Frame | FaultyFrame],
    config: gvo.Config,
) -> dict[str, list[Relative]]:
    """Run odometry over frames and return its relative poses over about 1 s."""
    odometry = gvo.Odometry(camera, config)
    raw: list[gvo.Estimate] = []
    windowed: list[Relative] = []
    for frame in frames:
        if isinstance(frame, FaultyFrame):
            continue
        raw.append(odometry.track(frame).raw)
        windowed += in_window(odometry.window, frame.stamp_ns)
    return {"raw": chained(raw), "window": windowed}


def in_window(
    window: gvo.SlidingWindow, stamp_ns: int, *, span_ns: int = SPAN_NS
) -> list[Relative]:
    """Return the newest pose in one about a span older; nothing where the window holds none."""
    stamps = {window.stamp_ns(pose): pose for pose in window.poses()}
    start = nearest(np.array(list(stamps)), stamp_ns - span_ns)
    if start is None:
        return []
    edge = window.relative_pose(stamps[start], stamp_ns)
    return [(start, stamp_ns, edge.T_reference_frame, edge.covariance)]


def nearest(stamps_ns: FloatArray, target_ns: int) -> int | None:
    """Return the stamp nearest to a target, None where all are half a second off."""
    best = int(stamps_ns[np.argmin(np.abs(stamps_ns - target_ns))])
    return best if abs(best - target_ns) <= MOST_OFF_NS else None


def chained(estimates: list[gvo.Estimate], *, span_ns: int = SPAN_NS) -> list[Relative]:
    """Return the relative poses over a span of a chain; only there do covariances subtract."""
    stamps_ns = np.array([estimate.stamp_ns for estimate in estimates])
    by_stamp = dict(zip(stamps_ns.tolist(), estimates, strict=True))
    pairs: list[Relative] = []
    for b in estimates:
        start = nearest(stamps_ns, b.stamp_ns - span_ns)
        if start is None or start >= b.stamp_ns:
            continue
        a = by_stamp[start]
        T_a_b = se3.invert(a.T_world_frame) @ b.T_world_frame
        Ad = se3.adjoint(se3.invert(T_a_b))
        pairs.append((start, b.stamp_ns, T_a_b, b.covariance - Ad @ a.covariance @ Ad.T))
    return pairs


def compare(pairs: list[Relative], truth: gvo.Trajectory) -> list[tuple[FloatArray, FloatArray]]:
    """Return errors (6,) and covariances (6, 6) of the pairs that the ground truth covers."""
    first, last = truth.stamps_ns[[0, -1]]
    compared = []
    for start, end, T_a_b, covariance in pairs:
        if first <= start and end <= last:
            T_world_a, T_world_b = truth.interpolate(np.array([start, end])).T_world_frame
            error = se3.log(se3.invert(T_a_b) @ se3.invert(T_world_a) @ T_world_b)
            compared.append((error, covariance))
    return compared


def mean_nees(errors: FloatArray, covariances: FloatArray) -> tuple[float, float]:
    """Return the mean NEES per degree of freedom of rotations and of translations."""
    means = []
    for block in (slice(0, 3), slice(3, 6)):
        solved = np.linalg.solve(covariances[:, block, block], errors[:, block, np.newaxis])
        means.append(float(np.mean(np.sum(errors[:, block] * solved[..., 0], axis=1))) / 3.0)
    return means[0], means[1]


def print_row(name: str, errors: FloatArray, covariances: FloatArray) -> None:
    """Print the mean NEES per degree of freedom and the largest bias."""
    rotation, translation = mean_nees(errors, covariances)
    bias = np.mean(errors / np.sqrt(np.einsum("nii->ni", covariances)), axis=0)
    worst = int(np.argmax(np.abs(bias)))
    print(
        f"{name:<34} {len(errors):>6} {rotation:>9.2f} {translation:>12.2f}"
        f"  {bias[worst]:+.2f} sigma in {AXES[worst]}"
    )


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"consistency: error: {error}", file=sys.stderr)
        sys.exit(2)
