"""Rigid fits to triples of points, and the matches that agree with rigid transforms."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel, matrix
from gvo.kernels.residuals import MIN_DEPTH_M, seen_from

MIN_VARIANCE_RATIO = 1e-6
"""Spread across the main direction over spread along it (standard deviations squared): below
this, points lie on a line to 0.1 % and the rotation about it is noise."""
MIN_SPREAD_RATIO = 1e-13
"""Spread over distance from the origin (squared): below this, the spread is rounding."""


@helper
def _write_axes(points, axes):
    """Write the axes of a triangle as rows; return its first side, and the second in its plane.

    The first axis runs along the first side, the third along the normal.
    """
    a = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    b = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    normal = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    length = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    area = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    for i in range(3):
        axes[0, i], axes[2, i] = a[i] / length, normal[i] / area
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axes[1, i] = axes[2, j] * axes[0, k] - axes[2, k] * axes[0, j]
    along = b[0] * axes[0, 0] + b[1] * axes[0, 1] + b[2] * axes[0, 2]
    return length, along, area / length


@kernel(In("f8", 3), In("f8", 3), Out("f8", 3), Out("b1", 1))
def fit_triples(points_a, points_b, T, is_valid):
    """Fit a rigid transform T_a_b (m, 4, 4) to each triple of points (m, 3, 3).

    The best rotation maps one triangle's plane to the other's (Horn 1987, doi:10.1364/
    JOSAA.4.000629), and the best angle in it is that of a sum of complex numbers. What is no fit,
    of points on a line, of one point or of NaN, has the identity rotation.
    """
    axes_a, axes_b, turned = matrix(3, 3), matrix(3, 3), matrix(2, 3)
    for k in range(len(points_a)):
        a, p, q = _write_axes(points_a[k], axes_a)
        b, r, s = _write_axes(points_b[k], axes_b)
        # Sum over the vertices, from the centres: frame a's times the conjugates of frame b's.
        real = a * b + p * r + q * s - ((a + p) * (b + r) + q * s) / 3.0
        imaginary = q * r - p * s - (q * (b + r) - (a + p) * s) / 3.0
        total, product, farthest_a, farthest_b = np.hypot(real, imaginary), a * q * b * s, 0.0, 0.0
        for m in range(3):
            for i in range(3):
                farthest_a = max(farthest_a, abs(points_a[k, m, i]))
                farthest_b = max(farthest_b, abs(points_b[k, m, i]))
        is_spread = total > 3.0 * MIN_SPREAD_RATIO * farthest_a * farthest_b
        # Sum and product of the two singular values of the cross-covariance, times 3 and 9.
        is_wide = product / 3.0 > MIN_VARIANCE_RATIO * total * total
        is_valid[k] = is_spread and is_wide and total < np.inf
        cosine, sine = real / total, imaginary / total
        for i in range(3):
            turned[0, i] = cosine * axes_a[0, i] + sine * axes_a[1, i]
            turned[1, i] = cosine * axes_a[1, i] - sine * axes_a[0, i]
        for i in range(3):
            centre = (points_a[k, 0, i] + points_a[k, 1, i] + points_a[k, 2, i]) / 3.0
            T[k, 3, i] = 0.0
            for j in range(3):
                T[k, i, j] = 1.0 if i == j else 0.0
                if is_valid[k]:
                    T[k, i, j] = turned[0, i] * axes_b[0, j] + turned[1, i] * axes_b[1, j]
                    T[k, i, j] += axes_a[2, i] * axes_b[2, j]
                mean_b = (points_b[k, 0, j] + points_b[k, 1, j] + points_b[k, 2, j]) / 3.0
                centre -= T[k, i, j] * mean_b
            T[k, i, 3] = centre
        T[k, 3, 3] = 1.0


@kernel(
    *(In("f8", 3), In("f8", 2), In("f8", 2), In("f8", 2), In("f8", 1), "f8", "b1"),
    Out("b1", 2),
)
def find_inliers(T, points, current_points, uvd, camera, threshold, is_distance, inliers):
    """Write which of n matches agree with each of m transforms T_reference_current, (m, n).

    Points of the reference are compared with the current points (metres), or their projections
    with (u, v, disparity) measured in the current frame (pixels).
    """
    fx, fy, cx, cy, baseline = camera[0], camera[1], camera[2], camera[3], camera[4]
    for m in range(len(T)):
        for k in range(len(points)):
            x, y, z = seen_from(T[m], points[k])
            if is_distance:
                a, b = x - current_points[k, 0], y - current_points[k, 1]
                c = z - current_points[k, 2]
                is_possible = True
            else:
                is_possible = z > MIN_DEPTH_M
                a, b = fx * x / z + cx - uvd[k, 0], fy * y / z + cy - uvd[k, 1]
                c = fx * baseline / z - uvd[k, 2]
            inliers[m, k] = is_possible and a * a + b * b + c * c < threshold * threshold
