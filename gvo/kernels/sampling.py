"""Images between their pixels: bilinear, the border replicated."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel


@helper
def value_at(image, x, y):
    """Return one value of an image; NaN at NaN."""
    height, width = image.shape
    if np.isnan(x) or np.isnan(y):
        return np.nan
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    i, j = int(x), int(y)
    after, below = min(i + 1, width - 1), min(j + 1, height - 1)
    x, y = x - i, y - j
    upper = (1.0 - x) * image[j, i] + x * image[j, after]
    lower = (1.0 - x) * image[below, i] + x * image[below, after]
    return (1.0 - y) * upper + y * lower


@helper
def _sample_upright(image, x, y, reach_u, reach_v, out):
    """As `sample`, of pixels all inside of an image: between four, each has the same shares."""
    n, left, top = 2 * reach_u + 1, np.uint64(x - reach_u), np.uint64(y - reach_v)
    u, v = x - np.floor(x), y - np.floor(y)
    for j in range(2 * reach_v + 1):
        row = top + np.uint64(j)
        below = row + np.uint64(1)
        for i in range(n):
            column = left + np.uint64(i)
            after = column + np.uint64(1)
            upper = (1.0 - u) * image[row, column] + u * image[row, after]
            lower = (1.0 - u) * image[below, column] + u * image[below, after]
            out[j * n + i] = (1.0 - v) * upper + v * lower


@helper
def sample(image, x, y, a, b, c, d, reach_u, reach_v, out):
    """Write the values at x + a i + b j, y + c i + d j for |i| <= reach_u, |j| <= reach_v, by rows.

    out[(j + reach_v) * (2 reach_u + 1) + i + reach_u]
    """
    height, width = image.shape
    margin_x = abs(a) * reach_u + abs(b) * reach_v
    margin_y = abs(c) * reach_u + abs(d) * reach_v
    is_inside = margin_x <= x < width - 1 - margin_x and margin_y <= y < height - 1 - margin_y
    if is_inside and a == 1.0 and b == 0.0 and c == 0.0 and d == 1.0:
        _sample_upright(image, x, y, reach_u, reach_v, out)
        return
    k = 0
    for j in range(-reach_v, reach_v + 1):
        for i in range(-reach_u, reach_u + 1):
            u, v = x + a * i + b * j, y + c * i + d * j
            if is_inside:
                # Unsigned: a negative index would have to be looked for in each access.
                left, top = np.int64(u), np.int64(v)
                column, row = np.uint64(left), np.uint64(top)
                after, below = column + np.uint64(1), row + np.uint64(1)
                u, v = u - left, v - top
                upper = (1.0 - u) * image[row, column] + u * image[row, after]
                lower = (1.0 - u) * image[below, column] + u * image[below, after]
                out[k] = (1.0 - v) * upper + v * lower
            else:
                out[k] = value_at(image, u, v)
            k += 1


@kernel(In("u1", 2), In("f8", 2), Out("u1", 3))
def cut_patches(image, pixels, patches):
    """Write the square patches around whole pixels (n, 2) of an image."""
    (height, width), radius = image.shape, patches.shape[1] // 2
    for k in range(len(pixels)):
        u, v = int(pixels[k, 0]) - radius, int(pixels[k, 1]) - radius
        for j in range(patches.shape[1]):
            row = min(max(v + j, 0), height - 1)
            for i in range(patches.shape[2]):
                patches[k, j, i] = image[row, min(max(u + i, 0), width - 1)]
