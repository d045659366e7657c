"""Smooth relative poses of your own front-end with the sliding window, numpy alone.

Reads a CSV with a row per relative pose: name of the new pose, stamp in nanoseconds, name of the
reference, x, y, z, qx, qy, qz, qw, and the sigmas of rotation (rad) and translation (m). Several
rows of one new pose are its edges to several references; the very first reference is the origin.

Example: python scripts/smooth_edges.py edges.csv
"""

import argparse
import csv
import sys
from itertools import groupby
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import gvo


def read_edge(row: list[str]) -> gvo.Edge:
    """Make an edge of a row: a 4x4 pose in the reference, and its 6x6 covariance."""
    numbers = np.array([float(field) for field in row[3:12]])
    T_reference_frame = np.eye(4)
    T_reference_frame[:3, :3] = Rotation.from_quat(numbers[3:7]).as_matrix()
    T_reference_frame[:3, 3] = numbers[:3]
    covariance = np.diag(np.repeat(numbers[7:9], 3) ** 2)
    return gvo.Edge(reference_id=row[2], T_reference_frame=T_reference_frame, covariance=covariance)


def main() -> None:
    """Read, smooth, print: the causal pose of each frame, then the smoothed ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("edges", type=Path, help="CSV: name, stamp, reference, pose, sigmas")
    path = parser.parse_args().edges

    window = gvo.SlidingWindow(keyframes="distance")
    with path.open(encoding="utf-8", newline="") as file:
        for (name, stamp), rows in groupby(csv.reader(file), key=lambda row: tuple(row[:2])):
            edges = [read_edge(row) for row in rows]
            if window.newest is None:
                window.add_pose(edges[0].reference_id, int(stamp) - 1, [])
            estimate = window.add_pose(name, int(stamp), edges)
            sigma = np.sqrt(estimate.covariance[3:, 3:].trace())
            print(f"causal {name} {estimate.T_world_frame[:3, 3].round(4)} +- {sigma:.4f} m")
            for refusal in estimate.rejected:
                print(f"refused {refusal}")
    for smoothed in window.finish():
        print(f"smoothed {smoothed.frame_id} {smoothed.T_world_frame[:3, 3].round(4)}")


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, IndexError) as error:
        print(f"smooth_edges: error: {' '.join(sys.argv[1:])}: {error}", file=sys.stderr)
        sys.exit(2)
