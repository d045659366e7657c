"""The rows of a PNG, out of their filters (PNG specification, third edition, chapter 9)."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel

_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)


@helper
def _nearest(left, above, corner):
    """Return which of three is nearest to left + above - corner, the first of them in a tie.

    Left and above lie on both sides of the corner, or one of them is nearest: two comparisons tell.
    """
    limit = 3 * corner - (left + above)
    low, high = min(left, above), max(left, above)
    if limit <= low:
        return high
    return low if limit >= high else corner


@kernel(In("u1", 2), "i8", Out("u1", 2), returns="b1")
def unfilter(filtered, n_pixel, rows):
    """Write rows of bytes out of filtered ones, each behind its filter; False: there is none such.

    The first row is what is above the image, zeros. A byte is what its filter left, plus what that
    predicts from the bytes n_pixel to the left, above, and above to the left, modulo 256.
    """
    n_columns = rows.shape[1] // n_pixel
    for j in range(len(filtered)):
        kind = filtered[j, 0]
        if kind > _PAETH:
            return False
        for first in range(n_pixel):
            left, corner = np.int64(0), np.int64(0)
            if kind == _NONE:
                for column in range(n_columns):
                    i = first + column * n_pixel
                    rows[j + 1, i] = filtered[j, i + 1]
            elif kind == _SUB:
                for column in range(n_columns):
                    i = first + column * n_pixel
                    left = (filtered[j, i + 1] + left) & 255
                    rows[j + 1, i] = left
            elif kind == _UP:
                for column in range(n_columns):
                    i = first + column * n_pixel
                    rows[j + 1, i] = (filtered[j, i + 1] + rows[j, i]) & 255
            elif kind == _AVERAGE:
                for column in range(n_columns):
                    i = first + column * n_pixel
                    above = np.int64(rows[j, i])
                    left = (filtered[j, i + 1] + ((left + above) >> 1)) & 255
                    rows[j + 1, i] = left
            else:
                for column in range(n_columns):
                    i = first + column * n_pixel
                    above = np.int64(rows[j, i])
                    left = (filtered[j, i + 1] + _nearest(left, above, corner)) & 255
                    rows[j + 1, i] = left
                    corner = above
    return True
