"""Rigid transforms in 3-D and their covariances, batched over leading dimensions.

A twist is (rx, ry, rz, tx, ty, tz); perturbations act on the right:
T(xi) = T @ exp(xi). This is the order of GTSAM's Pose3.

References
----------
J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018,
doi:10.48550/arXiv.1812.01537.
"""

from __future__ import annotations

from math import atan2, hypot, isfinite, sin, tan

import numpy as np
from scipy.linalg.lapack import dgesdd, dpotrf

from gvo.types import BoolArray, FloatArray

# Radians below which the series of `log` has more digits than its closed form.
_SMALL_ANGLE = 1e-4
# Largest deviation of R R^T from the identity, and largest asymmetry of correlations, taken for
# rounding.
_MAX_SKEW = 1e-6
_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
# Smallest eigenvalue of correlations that is more than rounding.
_MIN_EIGENVALUE = 1e-12
# A covariance times this is positive definite if all eigenvalues of its correlations are larger.
_LESS_DEFINITE = 1.0 - _MIN_EIGENVALUE * np.eye(6)


def make_transform(R: FloatArray, t: FloatArray) -> FloatArray:
    """Return T, shape (..., 4, 4), of a rotation (..., 3, 3) and a translation (..., 3)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def invert(T: FloatArray) -> FloatArray:
    """Return the inverse of rigid transforms, shape (..., 4, 4)."""
    if T.ndim == 2:  # by plain numbers: a fifth of the time of arrays
        (a, b, c, x), (d, e, f, y), (g, h, i, z), last_row = T.tolist()
        first, second = [a, d, g, -(a * x + d * y + g * z)], [b, e, h, -(b * x + e * y + h * z)]
        return np.array([first, second, [c, f, i, -(c * x + f * y + i * z)], last_row])
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    t_inverse = -(R_inverse @ T[..., :3, 3, np.newaxis])[..., 0]
    return make_transform(R_inverse, t_inverse)


def transform_points(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Map points (..., n, 3) of frame b to frame a by T_a_b (..., 4, 4)."""
    R, t = T_a_b[..., :3, :3], T_a_b[..., :3, 3]
    return points_b @ np.swapaxes(R, -1, -2) + t[..., np.newaxis, :]


def skew(v: FloatArray) -> FloatArray:
    """Return the matrices [v]_x, shape (..., 3, 3), with [v]_x w = v x w."""
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2] = -v[..., 2], v[..., 1]
    S[..., 1, 0], S[..., 1, 2] = v[..., 2], -v[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -v[..., 1], v[..., 0]
    return S


def exp(xi: FloatArray) -> FloatArray:
    """Return the transform of a twist (Sola 2018, eq. 172).

    Parameters
    ----------
    xi : ndarray of float64, shape (..., 6)
        Twists (rx, ry, rz, tx, ty, tz), radians and metres.

    Returns
    -------
    ndarray of float64, shape (..., 4, 4)
    """
    if xi.ndim > 1:
        transforms = np.array([exp(each) for each in xi.reshape(-1, 6)])
        return transforms.reshape(*xi.shape[:-1], 4, 4)
    u, v, w, x, y, z = xi.tolist()
    angle = hypot(u, v, w)
    if angle < 1e-5:
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    else:
        # (1 - cos) by the half angle: the difference itself loses the digits of small angles.
        a, b = sin(angle) / angle, 2.0 * (sin(0.5 * angle) / angle) ** 2
        c = (angle - sin(angle)) / angle**3
    p, q, r = v * z - w * y, w * x - u * z, u * y - v * x  # omega x rho; V rho, eq. 174
    s, t = x + b * p + c * (v * r - w * q), y + b * q + c * (w * p - u * r)
    n = z + b * r + c * (u * q - v * p)
    # By plain numbers: a tenth of the time of arrays.
    return np.array(
        [
            [1.0 - b * (v * v + w * w), b * u * v - a * w, b * u * w + a * v, s],
            [b * u * v + a * w, 1.0 - b * (u * u + w * w), b * v * w - a * u, t],
            [b * u * w - a * v, b * v * w + a * u, 1.0 - b * (u * u + v * v), n],
            _LAST_ROW,
        ]
    )


def log(T: FloatArray) -> FloatArray:
    """Return the twist of a transform, the inverse of `exp` (Sola 2018, eq. 173).

    Parameters
    ----------
    T : ndarray of float64, shape (..., 4, 4)

    Returns
    -------
    ndarray of float64, shape (..., 6)
        Twists (rx, ry, rz, tx, ty, tz), rotation angle in [0, pi].
    """
    if T.ndim == 2:
        return _log_of_one(T)
    omega = _rotation_vectors(quaternions(T[..., :3, :3]))
    angle = np.linalg.norm(omega, axis=-1)[..., np.newaxis, np.newaxis]
    is_small = angle < _SMALL_ANGLE
    safe = np.where(is_small, 1.0, angle)
    half = 0.5 * safe
    c = np.where(is_small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half / np.tan(half)) / safe**2)
    W = skew(omega)
    V_inverse = np.eye(3) - 0.5 * W + c * (W @ W)
    return np.concatenate([omega, (V_inverse @ T[..., :3, 3:])[..., 0]], axis=-1)


def _log_of_one(T: FloatArray) -> FloatArray:
    """Return the twist of one transform by plain numbers: a twentieth of the time of arrays."""
    qx, qy, qz, qw = quaternion(T[:3, :3])
    x, y, z = T[:3, 3].tolist()
    sine = hypot(qx, qy, qz)
    angle = 2.0 * atan2(sine, qw)
    ratio = angle / sine if sine > 0.0 else 2.0
    u, v, w = ratio * qx, ratio * qy, ratio * qz
    half = 0.5 * angle
    is_small = angle < _SMALL_ANGLE
    c = 1.0 / 12.0 + angle**2 / 720.0 if is_small else (1.0 - half / tan(half)) / angle**2
    a, b, d = v * z - w * y, w * x - u * z, u * y - v * x  # omega x t
    return np.array(
        [
            *(u, v, w),
            x - 0.5 * a + c * (v * d - w * b),
            y - 0.5 * b + c * (w * a - u * d),
            z - 0.5 * d + c * (u * b - v * a),
        ]
    )


def quaternion(R: FloatArray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of one rotation (3, 3); w >= 0.

    As `quaternions` by plain numbers, which take a tenth of the time for one rotation.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    rows = (
        (1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1.0 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz),
    )
    longest = max(range(4), key=lambda i: rows[i][i])
    x, y, z, w = rows[longest]
    length = hypot(x, y, z, w) if w >= 0.0 else -hypot(x, y, z, w)
    return x / length, y / length, z / length, w / length


def quaternions(R: FloatArray) -> FloatArray:
    """Return the unit quaternions (x, y, z, w), shape (..., 4), of rotations (..., 3, 3); w >= 0.

    Without the checks of `scipy.spatial.transform.Rotation`, which take ten times as long.

    References
    ----------
    I. Y. Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", Journal
    of Guidance, Control, and Dynamics 23(6), 2000, doi:10.2514/2.4654 (the matrix 4 q q^T).
    """
    Q = np.empty((*R.shape[:-2], 4, 4))
    Q[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    trace = diagonal.sum(axis=-1)
    Q[..., [0, 1, 2], [0, 1, 2]] = 1.0 - trace[..., np.newaxis] + 2.0 * diagonal
    Q[..., 3, 3] = 1.0 + trace
    Q[..., 3, :3] = Q[..., :3, 3] = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    # Each row is the quaternion times one of its elements: the longest has the most digits.
    longest = np.argmax(np.diagonal(Q, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(Q, longest[..., np.newaxis, np.newaxis], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def _rotation_vectors(q: FloatArray) -> FloatArray:
    """Return the rotation vectors, shape (..., 3), of quaternions (..., 4) with w >= 0."""
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    is_turned = sine > 0.0
    angle_over_sine = 2.0 * np.arctan2(sine, q[..., 3:]) / np.where(is_turned, sine, 1.0)
    return np.asarray(q[..., :3] * np.where(is_turned, angle_over_sine, 2.0))


def adjoint(T: FloatArray) -> FloatArray:
    """Return Ad_T, shape (..., 6, 6): T @ exp(xi) = exp(Ad_T xi) @ T (Sola 2018, eq. 175)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = R
    Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = skew(t) @ R
    return Ad


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotations nearest to matrices (..., 3, 3) in the Frobenius norm."""
    if M.ndim == 2:  # LAPACK called directly: numpy takes several times as long for one matrix
        U, _, Vt, _ = dgesdd(M)
    else:
        U, _, Vt = np.linalg.svd(M)
    signs = np.ones((*M.shape[:-2], 3))
    signs[..., 2] = np.linalg.det(U @ Vt)
    return np.asarray((U * signs[..., np.newaxis, :]) @ Vt)


def normalize(T: FloatArray) -> FloatArray:
    """Return transforms (..., 4, 4) with their rotation made orthonormal again."""
    return make_transform(nearest_rotation(T[..., :3, :3]), T[..., :3, 3])


def transport_covariance(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Return the covariances (..., 6, 6) of Ad_T xi from those of xi, see `adjoint`."""
    Ad = adjoint(T)
    return np.asarray(Ad @ covariance @ np.swapaxes(Ad, -1, -2))


def compose_covariance(
    covariance_a_b: FloatArray, T_b_c: FloatArray, covariance_b_c: FloatArray
) -> FloatArray:
    """Return the covariances (..., 6, 6) of T_a_b @ T_b_c, independent errors, first order."""
    moved = transport_covariance(covariance_a_b, invert(T_b_c))
    return np.asarray(
        0.5 * (moved + np.swapaxes(moved, -1, -2)) + covariance_b_c
    )  # symmetric in spite of rounding


def covariance_from_ros(covariance_ros: FloatArray, R_parent_frame: FloatArray) -> FloatArray:
    """Return the covariance of a pose from that of a ROS message.

    Parameters
    ----------
    covariance_ros : ndarray of float64, shape (..., 6, 6)
        Of (x, y, z, rx, ry, rz): the position in the parent frame, and the rotation about the
        axes of the parent frame.
    R_parent_frame : ndarray of float64, shape (..., 3, 3)
        Rotation of the pose.

    Returns
    -------
    ndarray of float64, shape (..., 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame.
    """
    R_frame_parent = np.swapaxes(R_parent_frame, -1, -2)
    J = np.zeros((*R_parent_frame.shape[:-2], 6, 6))
    J[..., :3, 3:] = R_frame_parent
    J[..., 3:, :3] = R_frame_parent
    return np.asarray(J @ covariance_ros @ np.swapaxes(J, -1, -2))


def rotation_angle(T: FloatArray) -> FloatArray:
    """Return the rotation angles in radians, shape (...), of transforms (..., 4, 4)."""
    R = T[..., :3, :3]
    vee = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
        axis=-1,
    )
    sine = 0.5 * np.linalg.norm(vee, axis=-1)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def mahalanobis(xi: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared lengths, shape (...), of twists (..., 6) in units of their sigmas."""
    solved = np.linalg.solve(covariance, xi[..., np.newaxis])[..., 0]
    return np.asarray(np.sum(xi * solved, axis=-1))


def is_rotation(R: FloatArray, *, tolerance: float) -> BoolArray:
    """Tell which matrices (..., 3, 3) are rotations; the tolerance is that of R R^T."""
    skews = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return np.asarray((skews <= tolerance) & (np.linalg.det(R) > 0.0))


def is_rigid(T: FloatArray, *, tolerance: float = _MAX_SKEW) -> bool:
    """Tell whether a matrix (4, 4) is a rigid transform of finite numbers.

    Poses are checked several times per frame: plain numbers take a tenth of the time of arrays.
    """
    # NaN fails every comparison.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last_row = T.tolist()
    return bool(
        last_row == _LAST_ROW
        and isfinite(x + y + z)
        and abs(a * a + b * b + c * c - 1.0) <= tolerance
        and abs(d * d + e * e + f * f - 1.0) <= tolerance
        and abs(g * g + h * h + i * i - 1.0) <= tolerance
        and abs(a * d + b * e + c * f) <= tolerance
        and abs(a * g + b * h + c * i) <= tolerance
        and abs(d * g + e * h + f * i) <= tolerance
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    )


def transform_fault(T: FloatArray, *, tolerance: float = _MAX_SKEW) -> str:
    """Say why a matrix is no rigid transform (4, 4), to follow its name; empty if it is one."""
    if T.shape != (4, 4):
        return f"must have shape (4, 4), got {T.shape}"
    if is_rigid(T, tolerance=tolerance):
        return ""
    if not np.isfinite(T).all():
        return "is not finite"
    if T[3].tolist() != _LAST_ROW:
        return "must have (0, 0, 0, 1) as its last row"
    return "holds no rotation"


def is_definite(symmetric: FloatArray) -> bool:
    """Tell whether a symmetric matrix of finite numbers is positive definite."""
    _, failed_minor = dpotrf(symmetric)
    return bool(failed_minor == 0)


def is_plain_covariance(covariance: FloatArray) -> bool:
    """Tell whether a matrix (6, 6) is finite, exactly symmetric and positive definite.

    The quick check; `covariance_fault` also accepts one that is symmetric up to rounding.
    """
    # A symmetric matrix has the same bytes by rows and by columns. LAPACK does not notice NaN, a
    # sum of squares does.
    return (
        isfinite(np.vdot(covariance, covariance))
        and covariance.tobytes() == covariance.tobytes("F")
        and is_definite(covariance * _LESS_DEFINITE)
    )


def covariance_fault(covariance: FloatArray) -> str:
    """Say why a matrix (n, n) is no covariance, to follow its name; empty if it is one."""
    if covariance.shape == (6, 6) and is_plain_covariance(covariance):
        return ""
    if not np.isfinite(covariance).all():
        return "is not finite"
    variances = np.diag(covariance)
    if variances.min() <= 0.0:
        return "is not positive definite"
    # On correlations: rounding leaves zero elements of the covariance at any ratio.
    sigmas = np.sqrt(variances)
    correlations = covariance / np.outer(sigmas, sigmas)
    if np.abs(correlations - correlations.T).max() > _MAX_SKEW:
        return "is not symmetric"
    is_sound = np.linalg.eigvalsh(correlations).min() > _MIN_EIGENVALUE
    return "" if is_sound else "is not positive definite"
