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
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.io.recording import Source
from gvo.runs.loop import edge_over, motions_of_window
from gvo.trajectory.evaluation import Consistency, Motions, consistency, motions_of_chain
from gvo.types import Edge, FaultyFrame, Frame

WORLDS = {
    "drive": ("driving", "stereo", 80),
    "room": ("handheld", "rgbd", 120),
    "stereo_room": ("handheld", "stereo", 120),
}
KINDS = get_args(FrontendConfig.model_fields["kind"].annotation)
AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
SPAN_NS = 1_000_000_000


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
    """Run odometry over recordings and print the NEES of all their motions together."""
    found: dict[str, list[Consistency]] = {}
    for source in sources:
        truth = source.ground_truth()
        if truth is None:
            raise gvo.GvoError(f"{source.info.name}: expected a ground truth, found none")
        frames = list(gvo.frames(source, configs[0]))  # those of all front-ends
        for config in configs:
            frontend = f"{config.frontend.kind} " if len(configs) > 1 else ""
            for kind, motions in relative_poses(source.info.camera, frames, config).items():
                compared = consistency(truth, motions)
                if compared is not None:
                    found.setdefault(f"{frontend}{kind}", []).append(compared)
    for kind, parts in found.items():
        print_row(f"{name} {kind}", joined(parts))


def relative_poses(
    camera: StereoCamera | PinholeCamera,
    frames: Iterable[Frame | FaultyFrame],
    config: gvo.Config,
) -> dict[str, Motions]:
    """Run odometry over frames and return its relative poses over about 1 s."""
    odometry = gvo.Odometry(camera, config)
    raw: list[gvo.Estimate] = []
    windowed: list[tuple[int, Edge]] = []
    for frame in frames:
        if isinstance(frame, FaultyFrame):
            continue
        raw.append(odometry.track(frame).raw)
        edge = edge_over(odometry.window, frame.stamp_ns, SPAN_NS)
        if edge is not None:
            windowed.append((frame.stamp_ns, edge))
    return {
        "raw": motions_of_chain(chain_of(raw))[0],
        "window": motions_of_window(windowed, name="window"),
    }


def chain_of(estimates: Sequence[gvo.Estimate]) -> gvo.Trajectory:
    """Return the poses of a chain with their covariances."""
    return gvo.Trajectory(
        stamps_ns=np.array([each.stamp_ns for each in estimates]),
        T_world_frame=np.array([each.T_world_frame for each in estimates]),
        covariances=np.array([each.covariance for each in estimates]),
    )


def joined(parts: Sequence[Consistency]) -> Consistency:
    """Return the errors of several recordings together."""
    arrays = {
        key: np.concatenate([getattr(part, key) for part in parts])
        for key in ("start_ns", "end_ns", "errors", "covariances")
    }
    return Consistency(name=parts[0].name, **arrays)


def print_row(name: str, found: Consistency) -> None:
    """Print the mean NEES per degree of freedom and the largest bias."""
    rotation, translation = found.mean_nees()
    bias = np.mean(found.errors / found.sigmas, axis=0)
    worst = int(np.argmax(np.abs(bias)))
    print(
        f"{name:<34} {len(found.errors):>6} {rotation:>9.2f} {translation:>12.2f}"
        f"  {bias[worst]:+.2f} sigma in {AXES[worst]}"
    )


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"consistency: error: {error}", file=sys.stderr)
        sys.exit(2)
