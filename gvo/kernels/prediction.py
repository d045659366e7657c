"""Where corners of a reference should be in another frame, and how they should look there."""

from __future__ import annotations

from gvo.kernels.jit import In, Out, kernel
from gvo.kernels.lens import put_on, take_off
from gvo.kernels.residuals import MIN_DEPTH_M, seen_from
from gvo.kernels.shutter import settle

# Distance to a plane, as a share of the reference's, below which the current camera is at it or
# behind it; and the steepest slope that a surface has in the current image.
_MIN_DISTANCE = 0.05
_MAX_SLOPE = 0.75


@kernel(
    *(In("f8", 2), In("f8", 2), Out("f8", 2), In("f8", 1), In("f8", 2), In("f8", 1), In("f8", 1)),
    *(Out("i8", 1), Out("f8", 2), Out("f8", 3), Out("f8", 2)),
    returns="i8",
)
def predict(uvd, slopes, T, lens, velocities, exposure, camera, indices, seen, warps, moved_slopes):
    """Write which of n corners a motion brings into view, where, and how warped; return how many.

    Measurements (u, v, disparity) of the reference and the slopes of its disparities (n, 2); T is
    T_reference_current; the lens errors are in all of them; velocities (2, 6) of both frames bend
    them, by the exposure. What is seen is what this camera measures, with all of its errors.

    The surface at a pixel is a plane: its inverse depth is linear in the pixel. Then a pixel x,
    in coordinates of the ray, goes to R x + t (n . x), divided by its third component, and the
    plane n . p = 1 becomes R n / (1 + t . R n), with R, t of T_current_reference.
    """
    fx, fy, cx, cy, baseline = camera[0], camera[1], camera[2], camera[3], camera[4]
    readout_s, delay_s = exposure[0], exposure[1]
    # The reference's origin in the current camera.
    tx, ty, tz = seen_from(T, (0.0, 0.0, 0.0))
    n_seen = 0
    for k in range(len(uvd)):
        ideal = take_off(uvd[k], lens, camera)
        u, v, settled = settle(ideal, velocities[0], readout_s, delay_s, camera)
        z = fx * baseline / settled
        x, y, z = seen_from(T, ((u - cx) / fx * z, (v - cy) / fy * z, z))
        if not z > MIN_DEPTH_M:
            continue
        place = fx * x / z + cx, fy * y / z + cy, fx * baseline / z
        moved = settle(place, velocities[1], -readout_s, -delay_s, camera)
        u, v, disparity = put_on(moved, lens, camera)
        if not (0.0 <= u <= camera[5] - 1.0 and 0.0 <= v <= camera[6] - 1.0):
            continue
        indices[n_seen] = k
        seen[n_seen, 0], seen[n_seen, 1], seen[n_seen, 2] = u, v, disparity

        x, y, inverse_depth = (ideal[0] - cx) / fx, (ideal[1] - cy) / fy, ideal[2] / (fx * baseline)
        a, b = slopes[k, 0] / (fx * baseline), slopes[k, 1] / (fx * baseline)
        X = T[0, 0] * x + T[1, 0] * y + T[2, 0] + inverse_depth * tx
        Y = T[0, 1] * x + T[1, 1] * y + T[2, 1] + inverse_depth * ty
        Z = T[0, 2] * x + T[1, 2] * y + T[2, 2] + inverse_depth * tz
        z_u, z_v = T[0, 2] / fx + tz * a, T[1, 2] / fy + tz * b
        warps[n_seen, 0, 0] = fx * (T[0, 0] / fx + tx * a - X / Z * z_u) / Z
        warps[n_seen, 0, 1] = fx * (T[1, 0] / fy + tx * b - X / Z * z_v) / Z
        warps[n_seen, 1, 0] = fy * (T[0, 1] / fx + ty * a - Y / Z * z_u) / Z
        warps[n_seen, 1, 1] = fy * (T[1, 1] / fy + ty * b - Y / Z * z_v) / Z

        # The plane's normal, by the slopes of its inverse depth along the coordinates of rays.
        along, across = slopes[k, 0] / baseline, slopes[k, 1] * fy / (fx * baseline)
        constant = inverse_depth - along * x - across * y
        X = T[0, 0] * along + T[1, 0] * across + T[2, 0] * constant
        Y = T[0, 1] * along + T[1, 1] * across + T[2, 1] * constant
        Z = T[0, 2] * along + T[1, 2] * across + T[2, 2] * constant
        distance = max(1.0 + X * tx + Y * ty + Z * tz, _MIN_DISTANCE)
        along, across = X / distance * baseline, Y / distance * fx * baseline / fy
        moved_slopes[n_seen, 0] = min(max(along, -_MAX_SLOPE), _MAX_SLOPE)
        moved_slopes[n_seen, 1] = min(max(across, -_MAX_SLOPE), _MAX_SLOPE)
        n_seen += 1
    return n_seen
