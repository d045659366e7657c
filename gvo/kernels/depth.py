"""Depth images: read at keypoints, compared after a motion, and aligned with each other.

Depths are metres, NaN where unknown. A camera is an array that begins with (fx, fy, cx, cy); T is
T_reference_current, (4, 4).
"""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, kernel, vector
from gvo.kernels.linear import clear
from gvo.kernels.residuals import MIN_DEPTH_M, seen_from
from gvo.kernels.sampling import value_at

REACH = 2
"""Normals are differences over so many pixels on either side."""
STRIDE = 3
"""Every such point on a smooth surface is kept."""

# Share of known depths in a window that a plane is fitted to.
_MIN_KNOWN_SHARE = 0.5
# Share by which inverse depths may differ from the plane through their neighbours.
_MAX_BEND = 0.03
# Noise of a depth camera: so many metres, and so many per metre squared.
_SIGMA_M, _SIGMA_PER_M = 0.003, 0.003
# Threshold of the robust kernel, sigmas.
_HUBER = 1.5
# By how much depths of one surface may differ: so many sigmas, and a share for grazing views.
_MAX_SIGMAS, _MAX_SHARE = 10.0, 0.03


@kernel(In("f4", 2), In("f8", 2), "i8", "f8", "f8", "f8", Out("f8", 1), Out("b1", 1))
def sample_depths(image, keypoints, radius, nearest, farthest, max_step, depths, is_valid):
    """Write the depths at keypoints (u, v), and which of them can be relied on.

    The inverse depth of a plane is linear in the pixel: a depth is that of the plane fitted to the
    inverse depths up to a radius around, by least squares, at the keypoint itself. It is that of
    the nearest pixel where less than half of them are known. It is valid if that of the nearest
    pixel is in range, and those around span at most a share of it.
    """
    height, width = image.shape
    for k in range(len(keypoints)):
        column, row = np.rint(keypoints[k, 0]), np.rint(keypoints[k, 1])
        depths[k], is_valid[k] = np.nan, False
        if not (0.0 <= column < width and 0.0 <= row < height):
            continue
        i, j = int(column), int(row)
        depth = np.float64(image[j, i])
        depths[k] = depth
        lowest, highest, n = np.inf, -np.inf, 0.0
        # Sums of what is linear in the pixel, from the nearest one, and of its products.
        u, v, q, uu, uv, vv, uq, vq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for dv in range(max(-radius, -j), min(radius, height - 1 - j) + 1):
            for du in range(max(-radius, -i), min(radius, width - 1 - i) + 1):
                z = np.float64(image[j + dv, i + du])
                if np.isnan(z):
                    continue
                lowest, highest, n = min(lowest, z), max(highest, z), n + 1.0
                u, v, q = u + du, v + dv, q + 1.0 / z
                uu, uv, vv = uu + du * du, uv + du * dv, vv + dv * dv
                uq, vq = uq + du / z, vq + dv / z
        is_valid[k] = nearest <= depth <= farthest and highest - lowest <= max_step * depth
        n_needed = _MIN_KNOWN_SHARE * (2 * radius + 1) * (2 * radius + 1)
        if not (is_valid[k] and lowest > 0.0 and n > n_needed):
            continue
        # Means, then the second moments about them: two slopes are left to solve for.
        u, v, q = u / n, v / n, q / n
        uu, uv, vv = uu / n - u * u, uv / n - u * v, vv / n - v * v
        uq, vq = uq / n - u * q, vq / n - v * q
        determinant = uu * vv - uv * uv
        if not determinant > 0.0:
            continue
        slope_u, slope_v = vv * uq - uv * vq, uu * vq - uv * uq
        rise = slope_u * (keypoints[k, 0] - column - u) + slope_v * (keypoints[k, 1] - row - v)
        inverse = q + rise / determinant
        if inverse > 0.0:
            # Beside a hole or the border the plane continues, but not beyond all that was seen.
            depths[k] = min(max(1.0 / inverse, lowest), highest)


@kernel(
    *(In("f8", 2), In("f4", 2), Out("f8", 2), In("f8", 1), "f8", "f8", "f8"),
    Out("f8", 1),
    returns="i8",
)
def compare_depths(points, image, T, camera, nearest, farthest, sigma_px, differences):
    """Write how disparities of the current image differ from those of points of the reference.

    Measured less expected, fx baseline (1/z_measured - 1/z), over the sigma of the difference of
    two, of the points that fall on a depth in range. Return their number.
    """
    height, width = image.shape
    n = 0
    for k in range(len(points)):
        x, y, z = seen_from(T, points[k])
        if not z > nearest:
            continue
        u = np.rint(camera[0] * x / z + camera[2])
        v = np.rint(camera[1] * y / z + camera[3])
        if not (0.0 <= u < width and 0.0 <= v < height):
            continue
        measured = np.float64(image[int(v), int(u)])
        if nearest <= measured <= farthest:
            disparity = camera[0] * camera[4] * (1.0 / measured - 1.0 / z)
            differences[n] = disparity / (np.sqrt(2.0) * sigma_px)
            n += 1
    return n


@kernel(In("f4", 2), "i8", "f8", "f8", Out("f4", 2))
def reduce_depth(image, step, nearest, farthest, inverse):
    """Write the mean inverse depths of two by two pixels, a step apart; NaN at holes and steps."""
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            j, i = 2 * v * step, 2 * u * step
            a, b = 1.0 / image[j, i], 1.0 / image[j, i + step]
            c, d = 1.0 / image[j + step, i], 1.0 / image[j + step, i + step]
            mean = 0.25 * (a + b + c + d)
            spread = abs(a - mean) + abs(b - mean) + abs(c - mean) + abs(d - mean)
            is_smooth = spread < 4.0 * _MAX_BEND * mean
            is_in_range = mean * nearest <= 1.0 <= mean * farthest
            inverse[v, u] = mean if is_smooth and is_in_range else np.nan


@kernel(In("f4", 2), In("f8", 1), Out("f8", 2), Out("f8", 2), returns="i8")
def fit_surfaces(inverse, camera, points, normals):
    """Write every third point on smooth surfaces, and its unit normal; return their number.

    On a plane 1/z = a x + b y + c, (x, y) = ((u - cx) / fx, (v - cy) / fy); (a, b, c) is normal.
    """
    height, width = inverse.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    n_smooth, n = 0, 0
    for v in range(REACH, height - REACH):
        for u in range(REACH, width - REACH):
            at = np.float64(inverse[v, u])
            left, right = inverse[v, u - REACH], inverse[v, u + REACH]
            above, below = inverse[v - REACH, u], inverse[v + REACH, u]
            limit = _MAX_BEND * at
            if not (abs(left + right - 2.0 * at) < limit and abs(above + below - 2.0 * at) < limit):
                continue
            n_smooth += 1
            if (n_smooth - 1) % STRIDE != 0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            a = (right - left) * fx / (2.0 * REACH)
            b = (below - above) * fy / (2.0 * REACH)
            c = at - a * x - b * y
            length = np.sqrt(a * a + b * b + c * c)
            points[n, 0], points[n, 1], points[n, 2] = x / at, y / at, 1.0 / at
            normals[n, 0], normals[n, 1], normals[n, 2] = a / length, b / length, c / length
            n += 1
    return n


@kernel(
    *(Out("f8", 2), In("f8", 2), In("f8", 2), In("f4", 2), In("f8", 1), "f8", "i8"),
    *(Out("f8", 2), Out("f8", 1), Out("f8", 1)),
    returns="i8",
)
def linearize_planes(T, points, normals, inverse, camera, gate, every, H, g, squares):
    """Write the normal equations H step = g of the motion between two depth images.

    A point p of the reference, seen at depth z, has the residual r = n . p (z_measured - z) / z
    over its sigma: how far what is measured at its pixel, between four inverse depths, lies off
    the plane with the normal n (Chen & Medioni 1992). Its derivatives by the camera's motion
    (rx, ry, rz, tx, ty, tz), right perturbation, are those of n . p: (n x p, -n). Weights are
    those of the Huber kernel. Of every so manieth point that count whose residuals are below the
    gate; return their number, and write the sum of their squared residuals (1).
    """
    height, width = inverse.shape
    J, n = vector(6), 0
    clear(H, g)
    squares[0] = 0.0
    for m in range((len(points) + every - 1) // every):
        k = m * every
        x, y, z = seen_from(T, points[k])
        if not z > MIN_DEPTH_M:
            continue
        u, v = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
        if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
            continue
        stretch = 1.0 / (value_at(inverse, u, v) * z) - 1.0
        sigma = _SIGMA_M + _SIGMA_PER_M * z * z
        p, q, s = normals[k, 0], normals[k, 1], normals[k, 2]
        a = T[0, 0] * p + T[1, 0] * q + T[2, 0] * s
        b = T[0, 1] * p + T[1, 1] * q + T[2, 1] * s
        c = T[0, 2] * p + T[1, 2] * q + T[2, 2] * s
        r = (a * x + b * y + c * z) * stretch / sigma
        # Of grazing views: what is measured lies on another surface, however small the residual.
        is_near = abs(stretch) * z < _MAX_SIGMAS * sigma + _MAX_SHARE * z
        if not (abs(r) < gate and is_near):
            continue
        n += 1
        squares[0] += r * r
        J[0], J[1], J[2] = b * z - c * y, c * x - a * z, a * y - b * x
        J[3], J[4], J[5] = -a, -b, -c
        weight = min(1.0, _HUBER / max(abs(r), 1e-9)) / sigma
        for m in range(6):
            g[m] += weight * r * J[m]
            for o in range(6):
                H[m, o] += weight * J[m] * J[o] / sigma
    return n
