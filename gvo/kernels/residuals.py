"""Whitened stereo reprojection residuals of matches, and their derivatives.

The residual of a match is its measurement (u, v, disparity) in the current frame less the
projection of its point in the reference. Both frames are noisy: the reference's covariance is
propagated through the motion and added before the residual is whitened.

A camera is an array (fx, fy, cx, cy, baseline, width, height); T is T_reference_current, (4, 4).
"""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel, matrix, vector

MIN_DEPTH_M = 1e-3
# Nearer points, and points behind the camera, are no inliers: their noise is not propagated.
_MIN_NOISE_DEPTH_M = 0.1


@helper
def seen_from(T, point):
    """Return a point of the reference as the current camera has it, R' (p - t)."""
    x, y, z = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
    return (
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )


@helper
def write_pose_jacobian(x, y, z, camera, J):
    """Write the derivatives of (u, v, disparity) by the camera's motion into six rows of J.

    (rx, ry, rz, tx, ty, tz), right perturbation of its pose: points move the other way.
    """
    fx, fy, baseline = camera[0], camera[1], camera[4]
    x, y, inverse_z = x / z, y / z, 1.0 / z
    disparity = fx * baseline * inverse_z
    J[0, 0], J[0, 1], J[0, 2] = fx * x * y, fy * (1.0 + y * y), disparity * y
    J[1, 0], J[1, 1], J[1, 2] = -fx * (1.0 + x * x), -fy * x * y, -disparity * x
    J[2, 0], J[2, 1], J[2, 2] = fx * y, -fy * x, 0.0
    J[3, 0], J[3, 1], J[3, 2] = -fx * inverse_z, 0.0, 0.0
    J[4, 0], J[4, 1], J[4, 2] = 0.0, -fy * inverse_z, 0.0
    J[5, 0], J[5, 1], J[5, 2] = fx * x * inverse_z, fy * y * inverse_z, disparity * inverse_z


@helper
def write_reference_jacobian(T, point, camera, J):
    """Write the derivatives of what is predicted by what the reference measured.

    J[i, j]: of the i-th of (u, v, disparity) in the current frame by the j-th in the reference.
    Meaningless, but finite, for points less than 0.1 m in front of the current camera.
    """
    fx, fy, baseline = camera[0], camera[1], camera[4]
    x, y, z = seen_from(T, point)
    if not z >= _MIN_NOISE_DEPTH_M:
        x, y, z = 0.0, 0.0, 1.0
    for j in range(3):
        # How the point moves in its own frame, then in the current one.
        p, q, r = 0.0, 0.0, 0.0
        if j == 0:
            p = point[2] / fx
        elif j == 1:
            q = point[2] / fy
        else:
            scale = -point[2] / (fx * baseline)
            p, q, r = scale * point[0], scale * point[1], scale * point[2]
        a = T[0, 0] * p + T[1, 0] * q + T[2, 0] * r
        b = T[0, 1] * p + T[1, 1] * q + T[2, 1] * r
        c = T[0, 2] * p + T[1, 2] * q + T[2, 2] * r
        J[0, j] = fx * (a - x / z * c) / z
        J[1, j] = fy * (b - y / z * c) / z
        J[2, j] = -fx * baseline / z * c / z


@helper
def whiten(factors, root, row):
    """Multiply (u, v, disparity) by the lower triangle of a match and by a number, in place."""
    u, v, d = row[0], row[1], row[2]
    row[0] = root * factors[0] * u
    row[1] = root * (factors[1] * u + factors[2] * v)
    row[2] = root * (factors[3] * u + factors[4] * v + factors[5] * d)


@helper
def write_residual(T, point, uvd, factors, camera, r):
    """Write the whitened residual of a match; return its squared length, the current point.

    Infinite where the point falls behind the camera.
    """
    x, y, z = seen_from(T, point)
    if not z > MIN_DEPTH_M:
        return np.inf, x, y, z
    r[0] = uvd[0] - (camera[0] * x / z + camera[2])
    r[1] = uvd[1] - (camera[1] * y / z + camera[3])
    r[2] = uvd[2] - camera[0] * camera[4] / z
    whiten(factors, 1.0, r)
    return r[0] * r[0] + r[1] * r[1] + r[2] * r[2], x, y, z


@kernel(Out("f8", 2), In("f8", 2), In("f8", 2), In("f8", 2), In("f8", 1), Out("f8", 2))
def write_factors(T, points, reference_sigmas, current_sigmas, camera, factors):
    """Write what whitens the residuals of n matches.

    The lower triangle W (00, 10, 11, 20, 21, 22) with W'W = C^-1, where C = J S J' + D: S and D
    are the variances of (u, v, disparity) in the reference and in the current frame, and J is the
    derivative of one by the other at T. The squared pivots of C are no less than D.
    """
    J, C = matrix(3, 3), matrix(3, 3)
    for k in range(len(points)):
        write_reference_jacobian(T, points[k], camera, J)
        for i in range(3):
            for j in range(i + 1):
                C[i, j] = 0.0
                for m in range(3):
                    C[i, j] += J[i, m] * J[j, m] * reference_sigmas[k, m] ** 2
        var_u, var_v, var_d = (
            current_sigmas[k, 0] ** 2,
            current_sigmas[k, 1] ** 2,
            current_sigmas[k, 2] ** 2,
        )
        w_uu = 1.0 / np.sqrt(C[0, 0] + var_u)
        l_vu, l_du = C[1, 0] * w_uu, C[2, 0] * w_uu
        w_vv = 1.0 / np.sqrt(max(C[1, 1] + var_v - l_vu * l_vu, var_v))
        l_dv = (C[2, 1] - l_du * l_vu) * w_vv
        w_dd = 1.0 / np.sqrt(max(C[2, 2] + var_d - l_du * l_du - l_dv * l_dv, var_d))
        w_vu = -l_vu * w_uu * w_vv
        factors[k, 0], factors[k, 1], factors[k, 2] = w_uu, w_vu, w_vv
        factors[k, 3] = -(l_du * w_uu + l_dv * w_vu) * w_dd
        factors[k, 4], factors[k, 5] = -l_dv * w_vv * w_dd, w_dd


@kernel(Out("f8", 2), In("f8", 2), In("f8", 2), In("f8", 2), In("f8", 1), Out("f8", 1))
def square_residuals(T, points, uvd, factors, camera, squared):
    """Write the squared lengths of whitened residuals; infinite behind the camera."""
    r = vector(3)
    for k in range(len(points)):
        squared[k] = write_residual(T, points[k], uvd[k], factors[k], camera, r)[0]
