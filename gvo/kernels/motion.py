"""Rigid motions of single transforms (4, 4), in place."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import helper, matrix, vector


@helper
def write_rotation(x, y, z, R):
    """Write the rotation of a rotation vector (Rodrigues)."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-5:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        # (1 - cos) by the half angle: the difference itself loses the digits of small angles.
        a, b = np.sin(angle) / angle, 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@helper
def move_right(T, step):
    """Overwrite T by T @ [R(step[:3]) | step[3:]]: a retraction, to first order the exponential."""
    S, row = matrix(3, 3), vector(4)
    write_rotation(step[0], step[1], step[2], S)
    for i in range(3):
        for j in range(3):
            row[j] = T[i, 0] * S[0, j] + T[i, 1] * S[1, j] + T[i, 2] * S[2, j]
        row[3] = T[i, 0] * step[3] + T[i, 1] * step[4] + T[i, 2] * step[5] + T[i, 3]
        for j in range(4):
            T[i, j] = row[j]


@helper
def normalize_rotation(T):
    """Overwrite the rotation of T by the nearest one: Newton's iteration of the polar factor.

    R <- (R + R^-T) / 2 (Higham 1986, doi:10.1137/0907079).
    """
    C = matrix(3, 3)
    for _ in range(20):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for m in range(3):
                n, p = (m + 1) % 3, (m + 2) % 3
                C[i, m] = T[j, n] * T[k, p] - T[j, p] * T[k, n]
        determinant = T[0, 0] * C[0, 0] + T[0, 1] * C[0, 1] + T[0, 2] * C[0, 2]
        largest = 0.0
        for i in range(3):
            for m in range(3):
                change = 0.5 * (C[i, m] / determinant - T[i, m])
                T[i, m] += change
                largest = max(largest, abs(change))
        if largest < 1e-12:
            break
