"""Robust Gauss-Newton of a pose over stereo reprojection residuals, and its covariance.

Matches are rows: points of the reference (n, 3), measurements of the current frame (n, 3), factors
that whiten (n, 6), which are used (n). Of k constants of the camera each has the derivatives of
(u, v, disparity) in both frames, (k, 2, n, 3). T is T_reference_current.
"""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel, matrix, vector
from gvo.kernels.linear import clear, copy, dot, factorize, invert, solve, substitute
from gvo.kernels.motion import move_right, normalize_rotation
from gvo.kernels.residuals import (
    whiten,
    write_pose_jacobian,
    write_reference_jacobian,
    write_residual,
)

DONE, BEHIND, OPEN = 0, 1, 2
"""How a kernel ended: well; with a point behind the camera; with a direction left open."""

# The first round only has to be good enough to choose the inliers again; then the most there are.
# Integers of NumPy: for each of Python the descent would be compiled anew.
_N_FIRST_STEPS = np.int64(2)
_N_STEPS = np.int64(10)
# Squared length of a step, in sigmas, that no longer matters.
_CONVERGED = 1e-3
# Variance inflation of a parameter above which a direction of motion is unobservable.
_MAX_INFLATION = 1e10
# Lower bound of the noise scale: two copies of one image, which recordings do hold, fit exactly
# and tell no more about the motion than other pairs.
_MIN_SCALE = 0.1
# Pseudo-observations with the covariance implied by the sigmas: the sample covariance of few
# gradients is itself uncertain. Without them 12 matches give an NEES of 3 instead of 1.
_N_PROMISED = 24
# Largest ratio of variances with and without the curvature of the kernel: if long residuals alone
# constrain a direction, their curvature is no measure of it.
_MAX_LOSS = 10.0
# Points, measurements, factors, which are used. What is written by one kernel is writeable for all:
# helpers are compiled once for each kind of array.
_MATCHES = In("f8", 2), In("f8", 2), In("f8", 2), Out("b1", 1)


@helper
def _linearize(T, point, uvd, factors, camera, huber, J, r):
    """Write whitened Jacobian (6, 3) and residual of a match, times the root of its weight.

    The weight is that of the Huber kernel (Huber 1964). Return that root; zero behind the camera.
    """
    squared, x, y, z = write_residual(T, point, uvd, factors, camera, r)
    if not squared < np.inf:
        return 0.0
    root = np.sqrt(huber / max(np.sqrt(squared), huber))
    write_pose_jacobian(x, y, z, camera, J)
    for i in range(6):
        whiten(factors, root, J[i])
    for i in range(3):
        r[i] *= root
    return root


@helper
def _add_up(T, points, uvd, factors, is_used, camera, huber, H, g):
    """Write the normal equations H step = g; False where a point falls behind the camera."""
    r, J = vector(3), matrix(6, 3)
    clear(H, g)
    for k in range(len(points)):
        if not is_used[k]:
            continue
        if _linearize(T, points[k], uvd[k], factors[k], camera, huber, J, r) == 0.0:
            return False
        for i in range(6):
            g[i] += J[i, 0] * r[0] + J[i, 1] * r[1] + J[i, 2] * r[2]
            for j in range(6):
                H[i, j] += J[i, 0] * J[j, 0] + J[i, 1] * J[j, 1] + J[i, 2] * J[j, 2]
    return True


@helper
def _descend(T, points, uvd, factors, is_used, camera, huber, n_steps):
    """Move T to the minimum of the robust cost; return how it ended."""
    H, g, step = matrix(6, 6), vector(6), vector(6)
    for _ in range(n_steps):
        if not _add_up(T, points, uvd, factors, is_used, camera, huber, H, g):
            return BEHIND
        for i in range(6):
            step[i] = g[i]
        if not solve(H, step):
            return OPEN
        move_right(T, step)
        if dot(step, g) < _CONVERGED:
            break
    return DONE


@kernel(Out("f8", 2), *_MATCHES, In("f8", 1), "f8", "i8", returns="i8")
def descend(T, points, uvd, factors, is_used, camera, huber, n_steps):
    """Move T by a few Gauss-Newton steps; return how it ended."""
    return _descend(T, points, uvd, factors, is_used, camera, huber, n_steps)


@kernel(Out("f8", 2), *_MATCHES, In("f8", 1), "f8", "f8", returns="i8")
def refine(T, points, uvd, factors, is_used, camera, huber, gate):
    """Move T to the minimum, its inliers chosen anew; return how it ended.

    The inliers of a minimal sample are biased towards its error: after a few steps they are those
    whose residuals are shorter than the gate, unless that loses half of them.
    """
    ended = _descend(T, points, uvd, factors, is_used, camera, huber, _N_FIRST_STEPS)
    if ended != DONE:
        return ended
    r, n_near, n_used = vector(3), 0, 0
    for k in range(len(points)):
        n_near += write_residual(T, points[k], uvd[k], factors[k], camera, r)[0] < gate * gate
        n_used += is_used[k]
    if n_near >= n_used // 2:
        for k in range(len(points)):
            squared = write_residual(T, points[k], uvd[k], factors[k], camera, r)[0]
            is_used[k] = squared < gate * gate
    ended = _descend(T, points, uvd, factors, is_used, camera, huber, _N_STEPS)
    # Orthonormal to the last digit: many motions are composed with this one.
    normalize_rotation(T)
    return ended


@helper
def _sandwich(A, S, out):
    """Write A S A' of (6, 6), symmetric in spite of rounding."""
    for i in range(6):
        for j in range(i + 1):
            value = 0.0
            for a in range(6):
                for b in range(6):
                    value += A[i, a] * S[a, b] * A[j, b]
            out[i, j] = out[j, i] = value


@kernel(
    *(Out("f8", 2), *_MATCHES, In("f8", 1), "f8", Out("f8", 2), Out("f8", 1)),
    returns="i8",
)
def write_covariance(T, points, uvd, factors, is_used, camera, huber, covariance, scale):
    """Write the covariance of a pose (6, 6), and the scale of the noise (1); return how it ended.

    A^-1 S A^-1 (White 1980): A is the second derivative of the robust cost, S the sample
    covariance of the matches' gradients. Beyond its threshold the Huber cost is linear: residuals
    there have no curvature along their own direction.
    """
    H, g, inverse = matrix(6, 6), vector(6), matrix(6, 6)
    curvature, sample = matrix(6, 6), matrix(6, 6)
    if not _add_up(T, points, uvd, factors, is_used, camera, huber, H, g):
        return BEHIND
    copy(H, curvature)
    if not invert(curvature, inverse):
        return OPEN
    for i in range(6):
        if not H[i, i] * inverse[i, i] < _MAX_INFLATION:
            return OPEN
    copy(H, curvature)
    clear(sample, g)
    r, J, score, n, sum_of_squares = vector(3), matrix(6, 3), vector(6), 0, 0.0
    for k in range(len(points)):
        if not is_used[k]:
            continue
        _linearize(T, points[k], uvd[k], factors[k], camera, huber, J, r)
        squared = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        n += 1
        sum_of_squares += squared
        for i in range(6):
            score[i] = J[i, 0] * r[0] + J[i, 1] * r[1] + J[i, 2] * r[2]
        # The weighted square of a residual beyond the threshold h is h times its length.
        is_long = squared > huber * huber
        for i in range(6):
            for j in range(6):
                sample[i, j] += score[i] * score[j]
                if is_long:
                    curvature[i, j] -= score[i] * score[j] / squared
    scale[0] = max(np.sqrt(sum_of_squares / max(3 * n - 6, 1)), _MIN_SCALE)
    sensitivity = matrix(6, 6)
    is_sane = invert(curvature, sensitivity)
    for i in range(6):
        is_sane = is_sane and sensitivity[i, i] < _MAX_LOSS * inverse[i, i]
    if not is_sane:
        copy(inverse, sensitivity)
    for i in range(6):
        for j in range(6):
            seen, promised = n / max(n - 2, 1) * sample[i, j], scale[0] ** 2 * H[i, j]
            sample[i, j] = (n * seen + _N_PROMISED * promised) / (n + _N_PROMISED)
            sample[i, j] += _MIN_SCALE**2 * H[i, j]
    _sandwich(sensitivity, sample, covariance)
    return DONE


@helper
def _write_constants(T, point, sensitivities, k, camera, J, rows):
    """Write the derivatives of a match's residual by each constant into rows from the seventh on.

    An error moves the current measurement directly, the prediction through the reference.
    """
    write_reference_jacobian(T, point, camera, J)
    for c in range(len(sensitivities)):
        before, now = sensitivities[c, 0, k], sensitivities[c, 1, k]
        for i in range(3):
            moved = J[i, 0] * before[0] + J[i, 1] * before[1] + J[i, 2] * before[2]
            rows[6 + c, i] = now[i] - moved


@helper
def _add_match(factors, root, rows, r, A, b):
    """Whiten the rows of constants, and add all rows to the lower triangle of A, and to b."""
    for c in range(6, len(rows)):
        whiten(factors, root, rows[c])
    for i in range(len(rows)):
        b[i] += dot(rows[i], r)
        for j in range(i + 1):
            A[i, j] += dot(rows[i], rows[j])


@kernel(
    *(Out("f8", 2), *_MATCHES, In("f8", 4), In("f8", 1), "f8", Out("f8", 2)),
    returns="i8",
)
def write_effects(T, points, uvd, factors, is_used, sensitivities, camera, huber, effects):
    """Write by how much one unit of each of k constants moves the pose (k, 6); how it ended."""
    n_constants = len(sensitivities)
    H, rows, r, J = matrix(6, 6), matrix(6 + n_constants, 3), vector(3), matrix(3, 3)
    clear(H, vector(6))
    for c in range(n_constants):
        for i in range(6):
            effects[c, i] = 0.0
    for k in range(len(points)):
        if not is_used[k]:
            continue
        root = _linearize(T, points[k], uvd[k], factors[k], camera, huber, rows, r)
        if root == 0.0:
            return BEHIND
        _write_constants(T, points[k], sensitivities, k, camera, J, rows)
        for i in range(6):
            for j in range(i + 1):
                H[i, j] += dot(rows[i], rows[j])
        for c in range(n_constants):
            whiten(factors[k], root, rows[6 + c])
            for i in range(6):
                effects[c, i] += dot(rows[6 + c], rows[i])
    if not factorize(H):
        return OPEN
    for c in range(n_constants):
        substitute(H, effects[c])
    return DONE


@kernel(
    *(Out("f8", 2), *_MATCHES, In("f8", 4), In("f8", 1), "f8", Out("f8", 2), Out("f8", 1)),
    returns="i8",
)
def eliminate_pose(
    T, points, uvd, factors, is_used, sensitivities, camera, huber, information, score
):
    """Write the normal equations of the errors of k constants, whatever the pose; how it ended.

    Their information (k, k) and score (k): what no motion explains (the Schur complement).
    """
    n_constants = len(sensitivities)
    size, effects = 6 + n_constants, matrix(n_constants, 6)
    A, b, rows, r, J = matrix(size, size), vector(size), matrix(size, 3), vector(3), matrix(3, 3)
    clear(A, b)
    for k in range(len(points)):
        if not is_used[k]:
            continue
        root = _linearize(T, points[k], uvd[k], factors[k], camera, huber, rows, r)
        if root == 0.0:
            return BEHIND
        _write_constants(T, points[k], sensitivities, k, camera, J, rows)
        _add_match(factors[k], root, rows, r, A, b)
    factor = matrix(6, 6)
    copy(A, factor)
    if not factorize(factor):
        return OPEN
    for c in range(n_constants):
        for i in range(6):
            effects[c, i] = A[6 + c, i]
        substitute(factor, effects[c])
    for c in range(n_constants):
        score[c] = b[6 + c] - dot(effects[c], b[:6])
        for d in range(c + 1):
            information[c, d] = A[6 + c, 6 + d] - dot(effects[c], A[6 + d, :6])
            information[d, c] = information[c, d]
    return DONE


@kernel(
    *(Out("f8", 2), *_MATCHES, In("f8", 4), In("f8", 1), "f8", "f8", "i8"),
    *(Out("f8", 1), Out("f8", 2), Out("f8", 2)),
    returns="i8",
)
def adjust(
    T,
    points,
    uvd,
    factors,
    is_used,
    sensitivities,
    camera,
    huber,
    weight,
    n_steps,
    values,
    covariance,
    effects,
):
    """Estimate a pose and k constants together, these around zero by a sigma of one over weight.

    Move T; write the values (k) and their covariance (k, k), and by how much the pose moves by what
    is taken off for each (k, 6). Values are zero before. Return how it ended.
    """
    n, n_constants = len(points), len(sensitivities)
    size = 6 + n_constants
    # By the motion from which it begins the constants move residuals.
    start, constants = matrix(4, 4), matrix(size, 3)
    copy(T, start)
    J, rows, r, measured = matrix(3, 3), matrix(size, 3), vector(3), vector(3)
    H, g, factor = matrix(size, size), vector(size), matrix(size, size)
    for _ in range(n_steps):
        clear(H, g)
        for k in range(n):
            if not is_used[k]:
                continue
            _write_constants(start, points[k], sensitivities, k, camera, J, constants)
            for m in range(3):
                measured[m] = uvd[k, m]
                for c in range(n_constants):
                    measured[m] -= values[c] * constants[6 + c, m]
            root = _linearize(T, points[k], measured, factors[k], camera, huber, rows, r)
            if root == 0.0:
                return BEHIND
            for c in range(n_constants):
                for m in range(3):
                    rows[6 + c, m] = constants[6 + c, m]
            _add_match(factors[k], root, rows, r, H, g)
        for c in range(n_constants):
            H[6 + c, 6 + c] += weight
            g[6 + c] -= weight * values[c]
        copy(H, factor)
        if not solve(factor, g):
            return OPEN
        move_right(T, g)
        for c in range(n_constants):
            values[c] += g[6 + c]
    normalize_rotation(T)
    inverse, of_pose = matrix(size, size), matrix(6, 6)
    copy(H, factor)
    copy(H, of_pose)
    if not invert(factor, inverse) or not factorize(of_pose):
        return OPEN
    for c in range(n_constants):
        for d in range(n_constants):
            covariance[c, d] = weight * inverse[6 + c, 6 + d]
        for i in range(6):
            effects[c, i] = -H[6 + c, i]
        substitute(of_pose, effects[c])
    return DONE
