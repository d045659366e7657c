"""Put the window behind LiDAR odometry: a stream of poses, as KISS-ICP writes it, and loops.

The poses come as a file (TUM or KITTI); each is tied to the one before it, and to the keyframes
by edges of a second source, such as a scan matcher. Here that source is a file of the same
frame's poses with less drift; in your program it is whatever registers two scans.

Example: python scripts/smooth_pose_stream.py kiss_poses.txt --loops slam_poses.txt
"""

import argparse
import sys
from pathlib import Path

import numpy as np

import gvo

# Of a step: radians and metres, and what a loop is worth.
STEP_COVARIANCE = np.diag(np.repeat([0.002, 0.02], 3) ** 2)
LOOP_COVARIANCE = np.diag(np.repeat([0.002, 0.05], 3) ** 2)


def relative_edge(
    poses: gvo.Trajectory, reference: int, frame: int, covariance: np.ndarray
) -> gvo.Edge:
    """Return the edge from one pose of a trajectory to another, named by their rows."""
    T_world_reference, T_world_frame = poses.T_world_frame[[reference, frame]]
    T_reference_frame = np.linalg.inv(T_world_reference) @ T_world_frame
    return gvo.Edge(
        reference_id=reference, T_reference_frame=T_reference_frame, covariance=covariance
    )


def main() -> None:
    """Feed the window pose by pose; print where each is, and how sure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("poses", type=Path, help="odometry, TUM or KITTI")
    parser.add_argument("--loops", type=Path, help="poses with less drift, row by row")
    parser.add_argument("--every", type=int, default=20, help="rows from keyframe to keyframe")
    arguments = parser.parse_args()
    if arguments.every < 1:
        parser.error("--every must be at least 1")

    poses = gvo.read_trajectory(arguments.poses)
    loops = None if arguments.loops is None else gvo.read_trajectory(arguments.loops)
    window = gvo.SlidingWindow()
    keyframes: list[int] = []
    for row, stamp_ns in enumerate(poses.stamps_ns):
        edges = [relative_edge(poses, row - 1, row, STEP_COVARIANCE)] if row else []
        if loops is not None and row < len(loops):
            edges += [relative_edge(loops, k, row, LOOP_COVARIANCE) for k in keyframes[-3:]]
        estimate = window.add_pose(row, int(stamp_ns), edges)
        if row % arguments.every == 0:
            window.keep(row)
            keyframes.append(row)
            if len(keyframes) > 3:
                window.release(keyframes.pop(0))
            sigma = float(np.sqrt(estimate.covariance[3:, 3:].trace()))
            window.pop_finished()  # smoothed poses that left: yours to store
            print(f"{row:6d} {estimate.T_world_frame[:3, 3].round(2)} +- {sigma:.2f} m")
    last = window.finish()[-1]
    drift = np.linalg.norm((np.linalg.inv(last.T_world_frame) @ poses.T_world_frame[-1])[:3, 3])
    print(f"{len(poses)} poses; the last one is {drift:.2f} m from the odometry's")


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"smooth_pose_stream: error: {error}", file=sys.stderr)
        sys.exit(2)
