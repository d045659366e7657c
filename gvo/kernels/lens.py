"""What a calibration leaves: errors of a stereo camera that change smoothly over the image.

Of pixels and disparities there are eleven constants, in this order. The disparity's own, a
polynomial of the place in the image: d0 pixels, then dx, dy, dxx, dxy, dyy in focal lengths. Those
of both lenses alike: a tilt of the image planes (tx, ty), which rectification took for a turn, and
what radial and tangential distortion is left (k1, p1, p2). They act on the disparity as the
difference between the two images (D. C. Brown, "Close-range camera calibration", Photogrammetric
Engineering 37(8), 1971). Rows of the right image have six: the same polynomial.

A camera is an array (fx, fy, cx, cy, baseline, width, height).
"""

from __future__ import annotations

from gvo.kernels.jit import In, Out, helper, kernel, vector

N_LENS, N_POLYNOMIAL = 11, 6


@helper
def _polynomial(x, y, f, a):
    """Return a0 + f (a1 x + a2 y + a3 x^2 + a4 x y + a5 y^2)."""
    return a[0] + f * (a[1] * x + a[2] * y + a[3] * x * x + a[4] * x * y + a[5] * y * y)


@helper
def _lens_errors(u, v, disparity, lens, camera):
    """Return by how much u, v and disparity are too large, in pixels."""
    f = camera[0]
    x, y, d = (u - camera[2]) / f, (v - camera[3]) / f, disparity / f
    right, xx, xy, yy = x - d, x * x, x * y, y * y
    tx, ty, k1, p1, p2 = lens[6], lens[7], lens[8], lens[9], lens[10]
    r2, right_xx = xx + yy, right * right
    along = tx * xx + ty * xy + k1 * x * r2 + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
    across = tx * xy + ty * yy + k1 * y * r2 + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
    apart = d * (ty + 2.0 * p1) * y + (tx + 3.0 * p2) * (xx - right_xx)
    apart += k1 * (x * r2 - right * (right_xx + yy))
    return f * along, f * across, _polynomial(x, y, f, lens) + f * apart


@helper
def take_off(uvd, lens, camera):
    """Return (u, v, disparity) without the errors, which hardly change within their own size."""
    du, dv, dd = _lens_errors(uvd[0], uvd[1], uvd[2], lens, camera)
    return uvd[0] - du, uvd[1] - dv, uvd[2] - dd


@helper
def put_on(uvd, lens, camera):
    """Return (u, v, disparity) with the errors."""
    du, dv, dd = _lens_errors(uvd[0], uvd[1], uvd[2], lens, camera)
    return uvd[0] + du, uvd[1] + dv, uvd[2] + dd


@kernel(In("f8", 2), In("f8", 1), In("f8", 1), Out("f8", 2))
def take_off_all(uvd, lens, camera, ideal):
    """Write n (u, v, disparity) without the errors."""
    for k in range(len(uvd)):
        ideal[k, 0], ideal[k, 1], ideal[k, 2] = take_off(uvd[k], lens, camera)


@kernel(In("f8", 2), In("f8", 1), Out("f8", 3))
def write_lens_fields(uvd, camera, fields):
    """Write the errors of n (u, v, disparity) by a unit of each constant, fields (11, n, 3)."""
    lens = vector(N_LENS)
    for c in range(N_LENS):
        for i in range(N_LENS):
            lens[i] = 1.0 if i == c else 0.0
        for k in range(len(uvd)):
            du, dv, dd = _lens_errors(uvd[k, 0], uvd[k, 1], uvd[k, 2], lens, camera)
            fields[c, k, 0], fields[c, k, 1], fields[c, k, 2] = du, dv, dd


@kernel(In("f8", 2), In("f8", 1), Out("f8", 3))
def write_considered(uvd, camera, fields):
    """Write the errors of n (u, v, disparity) by a pixel of each constant, fields (9, n, 3).

    An offset of the disparities and its bends x, y, xx, xy, yy; k1 (two pixels), the focal length
    (three), the baseline (one per cent): at the middle of the left border, or of the upper one.
    """
    f, half_width, half_height = camera[0], 0.5 * camera[5] / camera[0], 0.5 * camera[6] / camera[0]
    for k in range(len(uvd)):
        x, y, d = (uvd[k, 0] - camera[2]) / f, (uvd[k, 1] - camera[3]) / f, uvd[k, 2] / f
        along, across, right = x / half_width, y / half_height, x - d
        for c in range(9):
            fields[c, k, 0], fields[c, k, 1] = 0.0, 0.0
        fields[0, k, 2], fields[1, k, 2], fields[2, k, 2] = 1.0, along, across
        fields[3, k, 2], fields[4, k, 2] = along * along, along * across
        fields[5, k, 2] = across * across
        radial = 2.0 * (x * x + y * y) / half_width**3
        fields[6, k, 0], fields[6, k, 1] = radial * x, radial * y
        fields[6, k, 2] = radial * x - 2.0 * (right * right + y * y) / half_width**3 * right
        fields[7, k, 0], fields[7, k, 1] = 3.0 * along, 3.0 * y / half_width
        fields[7, k, 2], fields[8, k, 2] = 3.0 * d / half_width, 0.01 * uvd[k, 2]


@kernel(In("f8", 2), In("f8", 2), In("f8", 1), Out("f8", 2))
def write_row_errors(pixels, rows, camera, errors):
    """Write by how much rows of the right image are too large at n pixels, by m sets: (m, n)."""
    for c in range(len(rows)):
        for k in range(len(pixels)):
            x = (pixels[k, 0] - camera[2]) / camera[0]
            y = (pixels[k, 1] - camera[3]) / camera[0]
            errors[c, k] = _polynomial(x, y, camera[0], rows[c])
