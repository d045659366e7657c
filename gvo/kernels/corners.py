"""Corners: found in an image, and chosen so that they are spread over it."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel

REDUCTION = 2
"""Corners are found at half resolution, at a quarter of the cost: a patch need not be centred on
its corner exactly, as it is tracked and measured wherever it is."""

# Smallest eigenvalue of a corner's gradient covariance, grey in [0, 1]: below it noise is tracked.
_MIN_EIGENVALUE = np.float32(1e-4)
# Of sums over 3 x 3 pixels of products of Sobel's gradients, which are 4 times those of grey in
# [0, 255].
_UNIT = np.float32(1.0 / (4.0 * 3.0 * 255.0) ** 2)
_HALF = np.float32(0.5)


@helper
def _write_products(image, row, products):
    """Write gx gx, gx gy, gy gy of a row of Sobel's gradients, each over its neighbours."""
    above, below = row - 1, row + 1
    # From the left neighbour on: a negative index would have to be looked for in each access.
    for i in range(image.shape[1] - 2):
        a, b, c = image[above, i], image[above, i + 1], image[above, i + 2]
        d, e = image[row, i], image[row, i + 2]
        f, g, h = image[below, i], image[below, i + 1], image[below, i + 2]
        # Whole numbers, and their sums, are exact.
        along = np.float32((c + h) - (a + f) + 2 * (np.int32(e) - d))
        across = np.float32((f + h) - (a + c) + 2 * (np.int32(g) - b))
        products[0, i + 1], products[1, i + 1] = along * along, along * across
        products[2, i + 1] = across * across


@helper
def _write_scores(products, sums, scores):
    """Write the smaller eigenvalues of the sums over a row of 3 x 3 pixels."""
    for m in range(3):
        for i in range(len(scores)):
            sums[m, i] = products[0, m, i] + products[1, m, i] + products[2, m, i]
    for i in range(len(scores) - 2):
        a = _HALF * (sums[0, i] + sums[0, i + 1] + sums[0, i + 2])
        b = sums[1, i] + sums[1, i + 1] + sums[1, i + 2]
        c = _HALF * (sums[2, i] + sums[2, i + 1] + sums[2, i + 2])
        scores[i + 1] = _UNIT * ((a + c) - np.sqrt((a - c) * (a - c) + b * b))


@helper
def _mark_peaks(rows, at, tops, is_peak):
    """Write which scores of the middle one of three rows are no smaller than those around."""
    for i in range(len(at)):
        tops[i] = max(max(rows[0, i], rows[1, i]), rows[2, i])
    for i in range(len(at) - 2):
        top = max(max(tops[i], tops[i + 1]), tops[i + 2])
        is_peak[i + 1] = (at[i + 1] == top) & (at[i + 1] > _MIN_EIGENVALUE)


@kernel(In("u1", 2), "i8", "i8", Out("f8", 2), Out("f4", 1))
def find_corners(half, border, spacing_px, pixels, scores):
    """Write the corners of an image that is halved: at most one in each cell; return their number.

    The score of a pixel is the smaller eigenvalue of the covariance of its gradients (Shi, Tomasi
    1994, doi:10.1109/CVPR.1994.323794), by sums over 3 x 3 pixels. Of the local maxima in a cell of
    so many pixels of the full image the best one counts, of equal ones the last. Whole pixels of
    the full image (u, v), by rows, not at the border, and their scores.
    """
    height, width = half.shape
    n_columns = REDUCTION * width // spacing_px + 1
    best = np.full((REDUCTION * height // spacing_px + 1) * n_columns, -1)
    places, found, n_found = np.empty(half.size, np.int64), np.empty(half.size, np.float32), 0
    products, sums = np.zeros((3, 3, width), np.float32), np.zeros((3, width), np.float32)
    rows, tops = np.zeros((3, width), np.float32), np.empty(width, np.float32)
    is_peak = np.empty(width, np.bool_)
    for j in range(1, height - 1):
        _write_products(half, j, products[j % 3])
        if j < 3:
            continue
        # Three rows of products are one of scores, three of which tell maxima in their middle.
        _write_scores(products, sums, rows[(j - 1) % 3])
        v = j - 2
        if v < border or v >= height - border:
            continue
        at = rows[v % 3]
        _mark_peaks(rows, at, tops, is_peak)
        for u in range(border, width - border):
            if is_peak[u]:
                column, row = REDUCTION * u // spacing_px, REDUCTION * v // spacing_px
                cell = row * n_columns + column
                if best[cell] < 0 or at[u] >= found[best[cell]]:
                    best[cell] = n_found
                places[n_found], found[n_found] = v * width + u, at[u]
                n_found += 1
    n = 0
    for k in range(n_found):
        u, v = REDUCTION * (places[k] % width), REDUCTION * (places[k] // width)
        if best[v // spacing_px * n_columns + u // spacing_px] == k:
            pixels[n, 0], pixels[n, 1], scores[n] = u, v, found[k]
            n += 1
    return n


@kernel(In("f8", 2), In("i8", 1), "i8", "i8", "i8", Out("i8", 1))
def spread(pixels, order, width, cell_size_px, n_wanted, chosen):
    """Choose pixels (n, 2) of an image of this width, spread over it; return their number.

    The first of each cell in this order, then the second of each, and so on, up to the number
    wanted. Write their indices, sorted.
    """
    n_columns, last_row = (width - 1) // cell_size_px + 1, 0
    for k in range(len(pixels)):
        last_row = max(last_row, int(pixels[k, 1] // cell_size_px))
    n_before = np.zeros((last_row + 1) * n_columns, np.int64)
    ranks, n_of_rank = np.empty(len(pixels), np.int64), np.zeros(len(pixels) + 1, np.int64)
    for k in order:
        column, row = int(pixels[k, 0] // cell_size_px), int(pixels[k, 1] // cell_size_px)
        ranks[k] = n_before[row * n_columns + column]
        n_before[row * n_columns + column] += 1
        n_of_rank[ranks[k]] += 1
    n_rounds, n_left = 0, n_wanted
    while 0 < n_of_rank[n_rounds] <= n_left:
        n_left -= n_of_rank[n_rounds]
        n_rounds += 1
    # Of the round that there is no room for, the first.
    for k in order:
        if ranks[k] == n_rounds and n_left > 0:
            ranks[k] = -1
            n_left -= 1
    n = 0
    for k in range(len(pixels)):
        if ranks[k] < n_rounds:
            chosen[n] = k
            n += 1
    return n
