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


# Rows of numbers that the search works on: three of each product, their sums, scores, the largest
# scores of three rows, and which are peaks.
_PRODUCTS, _SUMS, _SCORES, _TOPS, _PEAKS, N_ROWS = 0, 9, 12, 15, 16, 17


@helper
def _write_products(image, row, rows, first):
    """Write gx gx, gx gy, gy gy of a row of Sobel's gradients, each over its neighbours."""
    above, below = row - 1, row + 1
    # From the left neighbour on: a negative index would have to be looked for in each access.
    for i in range(image.shape[1] - 2):
        a, b, c = image[above, i], image[above, i + 1], image[above, i + 2]
        d, e = image[row, i], image[row, i + 2]
        f, g, h = image[below, i], image[below, i + 1], image[below, i + 2]
        # Whole numbers, and their sums, are exact.
        along = np.float32(np.int32(c) + h - a - f + 2 * (np.int32(e) - d))
        across = np.float32(np.int32(f) + h - a - c + 2 * (np.int32(g) - b))
        rows[first, i + 1], rows[first + 1, i + 1] = along * along, along * across
        rows[first + 2, i + 1] = across * across


@helper
def _write_scores(rows, scores):
    """Write the smaller eigenvalues of the sums over a row of 3 x 3 pixels."""
    for m in range(3):
        for i in range(len(scores)):
            rows[_SUMS + m, i] = rows[m, i] + rows[3 + m, i] + rows[6 + m, i]
    xx, xy, yy = rows[_SUMS], rows[_SUMS + 1], rows[_SUMS + 2]
    for i in range(len(scores) - 2):
        a = _HALF * (xx[i] + xx[i + 1] + xx[i + 2])
        b = xy[i] + xy[i + 1] + xy[i + 2]
        c = _HALF * (yy[i] + yy[i + 1] + yy[i + 2])
        scores[i + 1] = _UNIT * ((a + c) - np.sqrt((a - c) * (a - c) + b * b))


@helper
def _mark_peaks(rows, at):
    """Mark which scores of the middle one of three rows are no smaller than those around."""
    before, middle, after = rows[_SCORES], rows[_SCORES + 1], rows[_SCORES + 2]
    tops, peaks = rows[_TOPS], rows[_PEAKS]
    for i in range(len(at)):
        tops[i] = max(max(before[i], middle[i]), after[i])
    for i in range(len(at) - 2):
        top = max(max(tops[i], tops[i + 1]), tops[i + 2])
        peaks[i + 1] = (at[i + 1] == top) & (at[i + 1] > _MIN_EIGENVALUE)


@kernel(In("u1", 2), "i8", "i8", Out("f4", 2), Out("i8", 2), Out("f4", 2))
def find_corners(half, border, spacing_px, rows, places, scores):
    """Find the corners of an image that is halved: at most one in each cell.

    The score of a pixel is the smaller eigenvalue of the covariance of its gradients (Shi, Tomasi
    1994, doi:10.1109/CVPR.1994.323794), by sums over 3 x 3 pixels. Of the local maxima in a cell of
    so many pixels of the full image the best one counts, of equal ones the last. For each cell
    write its score, and its place v * width + u in the halved image, not at the border; -1: none.
    Works on `rows`, `N_ROWS` of the width of the image.
    """
    height, width = half.shape
    for m in range(len(rows)):
        for u in range(width):
            rows[m, u] = 0.0
    for row in range(places.shape[0]):
        for column in range(places.shape[1]):
            places[row, column], scores[row, column] = -1, 0.0
    for j in range(1, height - 1):
        _write_products(half, j, rows, _PRODUCTS + 3 * (j % 3))
        if j < 3:
            continue
        # Three rows of products are one of scores, three of which tell maxima in their middle.
        _write_scores(rows, rows[_SCORES + (j - 1) % 3])
        v = j - 2
        if v < border or v >= height - border:
            continue
        at = rows[_SCORES + v % 3]
        _mark_peaks(rows, at)
        for u in range(border, width - border):
            if rows[_PEAKS, u] != 0.0:
                column, row = REDUCTION * u // spacing_px, REDUCTION * v // spacing_px
                if at[u] >= scores[row, column]:
                    places[row, column], scores[row, column] = v * width + u, at[u]


@kernel(
    *(In("f8", 2), In("i8", 1), "i8", "i8", Out("i8", 2), Out("i8", 1), Out("i8", 1)),
    returns="i8",
)
def spread(pixels, order, cell_size_px, n_wanted, n_in_cell, ranks, chosen):
    """Choose pixels (n, 2), spread over an image; return their number.

    The first of each cell in this order, then the second of each, and so on, up to the number
    wanted. Write their indices, sorted, besides how many are in each cell, and how many of its own
    cell come before each of n.
    """
    for row in range(n_in_cell.shape[0]):
        for column in range(n_in_cell.shape[1]):
            n_in_cell[row, column] = 0
    for i in range(len(order)):
        k = order[i]
        column, row = int(pixels[k, 0] // cell_size_px), int(pixels[k, 1] // cell_size_px)
        ranks[k] = n_in_cell[row, column]
        n_in_cell[row, column] += 1
    n_rounds, n_left, n_of_round = 0, n_wanted, 1
    while n_of_round > 0:
        n_of_round = 0
        for k in range(len(ranks)):
            n_of_round += ranks[k] == n_rounds
        if n_of_round > n_left:
            break
        n_left -= n_of_round
        n_rounds += 1
    # Of the round that there is no room for, the first.
    for i in range(len(order)):
        k = order[i]
        if ranks[k] == n_rounds and n_left > 0:
            ranks[k] = -1
            n_left -= 1
    n = 0
    for k in range(len(pixels)):
        if ranks[k] < n_rounds:
            chosen[n] = k
            n += 1
    return n
