"""When pixels are exposed: rows one after the other, right images later than left ones.

Row v of h is exposed at the stamp + readout * (v / h - 1/2). Until the stamp a point moves in the
camera's frame by exp(velocity * readout * (v / h - 1/2)) (Hedborg et al. 2012,
doi:10.1109/CVPR.2012.6247831). A right image that is exposed later than the left one shows the
point moved as well, and so another disparity.

A velocity is (rx, ry, rz, tx, ty, tz), rad/s and m/s, right of the pose; an exposure is the readout
time and the delay of the right image, seconds; a camera is an array (fx, fy, cx, cy, baseline,
width, height).
"""

from __future__ import annotations

from gvo.kernels.jit import In, Out, helper, kernel, matrix
from gvo.kernels.lens import take_off
from gvo.kernels.residuals import write_pose_jacobian

# Moved to the middle of the exposure, points must stay in front of the camera.
_MIN_DEPTH_M = 0.05


@helper
def _ray_rate(uvd, velocity, camera):
    """Return how fast a point moves in the camera's frame over its depth, 1/s."""
    x, y = (uvd[0] - camera[2]) / camera[0], (uvd[1] - camera[3]) / camera[1]
    inverse_depth = uvd[2] / (camera[0] * camera[4])
    return (
        velocity[1] - velocity[2] * y + inverse_depth * velocity[3],
        velocity[2] * x - velocity[0] + inverse_depth * velocity[4],
        velocity[0] * y - velocity[1] * x + inverse_depth * velocity[5],
    )


@helper
def row_time(v, camera):
    """Return when a row is exposed, as a share of the readout time after its middle."""
    return v / camera[6] - 0.5


@helper
def _right_rate(uvd, a, c, camera):
    """Return how fast a point moves in the right image until it is exposed, pixels/s."""
    return camera[0] * a - (uvd[0] - uvd[2] - camera[2]) * c


@helper
def settle(uvd, velocity, readout_s, delay_s, camera):
    """Return (u, v, disparity) as seen in the middle of the exposure; as it is where behind.

    Negative times: the inverse. The motion is small: its exponential to second order. All is
    divided by the depth.
    """
    u, v, disparity = uvd
    if readout_s == 0.0 and delay_s == 0.0:
        return u, v, disparity
    fx, fy, cx, cy, baseline = camera[0], camera[1], camera[2], camera[3], camera[4]
    dt = readout_s * row_time(v, camera)
    a, b, c = _ray_rate(uvd, velocity, camera)
    disparity -= delay_s * _right_rate(uvd, a, c, camera)
    half = 0.5 * dt
    x = dt * (a + half * (velocity[1] * c - velocity[2] * b))
    y = dt * (b + half * (velocity[2] * a - velocity[0] * c))
    z = dt * (c + half * (velocity[0] * b - velocity[1] * a)) + 1.0
    if not z > _MIN_DEPTH_M / (fx * baseline) * disparity:
        return uvd
    return (u - cx + fx * x) / z + cx, (v - cy + fy * y) / z + cy, disparity / z


@kernel(In("f8", 2), In("f8", 1), In("f8", 1), In("f8", 1), In("f8", 1), Out("f8", 2))
def settle_rows(uvd, lens, velocity, exposure, camera, settled):
    """Write (u, v, disparity) without lens errors as seen in the middle of the exposure."""
    for k in range(len(uvd)):
        ideal = take_off(uvd[k], lens, camera)
        u, v, disparity = settle(ideal, velocity, exposure[0], exposure[1], camera)
        settled[k, 0], settled[k, 1], settled[k, 2] = u, v, disparity


@kernel(In("f8", 2), In("f8", 1), In("f8", 1), In("f8", 1), Out("f8", 3))
def write_exposure_errors(uvd, lens, velocity, camera, errors):
    """Write the errors of (u, v, disparity) by a second of readout, and of delay: (2, n, 3)."""
    for k in range(len(uvd)):
        ideal = take_off(uvd[k], lens, camera)
        share = row_time(ideal[1], camera)
        a, b, c = _ray_rate(ideal, velocity, camera)
        errors[0, k, 0] = -share * (camera[0] * a - (ideal[0] - camera[2]) * c)
        errors[0, k, 1] = -share * (camera[1] * b - (ideal[1] - camera[3]) * c)
        errors[0, k, 2] = share * ideal[2] * c
        errors[1, k, 0], errors[1, k, 1] = 0.0, 0.0
        errors[1, k, 2] = _right_rate(ideal, a, c, camera)


@kernel(In("f8", 2), In("f8", 2), In("f8", 1), "f8", In("f8", 1), Out("f8", 3))
def write_velocity_errors(points, uvd, sigmas, readout_s, camera, errors):
    """Write by how much settled (u, v, disparity) err by a sigma of each axis: errors (6, n, 3)."""
    J = matrix(6, 3)
    for k in range(len(points)):
        write_pose_jacobian(points[k, 0], points[k, 1], points[k, 2], camera, J)
        dt = readout_s * row_time(uvd[k, 1], camera)
        for axis in range(6):
            for i in range(3):
                errors[axis, k, i] = dt * sigmas[axis] * J[axis, i]
