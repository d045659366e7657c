"""Rectangles as a camera sees them: the nearest at each pixel, and where in its texture.

Forms (n_rows, n, 3) give for each rectangle what is linear in the pixel, a u + b v + c. They are
those of one pose, or have a row for each row of the image. The atlas of textures is
`gvo.io.synthetic.textures.TextureAtlas`.
"""

from __future__ import annotations

from math import ceil, floor, sqrt

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel

_ROOT_TWO = np.float32(sqrt(2.0))
_SMALLEST = np.float32(1e-9)  # 1/z
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)


@helper
def _span(sides, v, width):
    """Return the first and the last column of a row where all forms (m, 3) are not negative."""
    lower, upper = 0.0, width - 1.0
    for k in range(len(sides)):
        slope = sides[k, 0]
        if slope == 0.0:
            slope = 1e-300  # all of the row, or nothing
        bound = -(sides[k, 1] * v + sides[k, 2]) / slope
        if slope > 0.0:
            lower = max(lower, bound)
        else:
            upper = min(upper, bound)
    return ceil(min(lower, float(width))), floor(max(upper, -1.0))


@kernel(In("f8", 3), In("f8", 4), "i8", Out("i2", 3), Out("f8", 1))
def write_spans(inverse_depth, inside, width, spans, reach):
    """Write in which columns of rows rectangles are, (n, height, 2), and their largest 1/z."""
    n, height = spans.shape[0], spans.shape[1]
    for k in range(n):
        reach[k] = 0.0
        for v in range(height):
            row = v * len(inside) // height
            first, last = _span(inside[row, k], v, width)
            spans[k, v, 0], spans[k, v, 1] = first, last
            if first <= last:
                slope = inverse_depth[row, k, 0]
                at_left = inverse_depth[row, k, 1] * v + inverse_depth[row, k, 2]
                reach[k] = max(reach[k], at_left + max(slope * first, slope * last))


@helper
def _value(form, u, v):
    """Return a form at a pixel, rounded as images of it are."""
    return np.float32(form[1] * v + form[2]) + np.float32(form[0] * u)


@helper
def _is_opaque(form_s, form_t, u, v, value, scale, cut, masks):
    """Tell whether the texture of a cut-out is opaque at a pixel."""
    depth, last = _ONE / value, cut[1] - 1
    x = floor(np.float64(_value(form_s, u, v) * depth * scale)) & last
    y = floor(np.float64(_value(form_t, u, v) * depth * scale)) & last
    return masks[cut[0] + y * cut[1] + x]


@kernel(
    *[In("i8", 1), In("i2", 3), In("f8", 3), In("f8", 3), In("f8", 3), In("i8", 2), In("b1", 1)],
    "i8",
    Out("f4", 2),
    Out("i2", 2),
)
def write_visible(
    order, spans, inverse_depth, texels_s, texels_t, cuts, masks, size, nearest, visible
):
    """Draw rectangles in an order: enter the largest 1/z and whose it is.

    `cuts` (n, 2) tell where in `masks` the mask of a texture begins, and its size; 0: it has none.
    """
    height = len(nearest)
    for k in order:
        n = cuts[k, 1]
        scale = np.float32(n / size)
        for v in range(height):
            row = v * len(inverse_depth) // height
            form = inverse_depth[row, k]
            first, last = spans[k, v, 0], spans[k, v, 1] + 1
            nearest_row, visible_row = nearest[v, first:last], visible[v, first:last]
            for i in range(len(nearest_row)):
                u = first + i
                value = _value(form, u, v)
                if value > nearest_row[i] and (
                    n == 0
                    or _is_opaque(
                        texels_s[row, k], texels_t[row, k], u, v, value, scale, cuts[k], masks
                    )
                ):
                    nearest_row[i], visible_row[i] = value, k


@helper
def _place(form, slopes, u, v, depth, size, starts):
    """Return where in the atlas, along one axis, a texture shows what is seen at a pixel."""
    a, b, c = np.float32(form[0]), np.float32(form[1]), np.float32(form[2])
    texel = (a * u + b * v + c) * depth
    footprint = max(abs(a - texel * slopes[0]), abs(b - texel * slopes[1])) * depth
    exponent = int(np.float32(footprint * _ROOT_TWO).view(np.int32) >> 23) - 127
    level = min(max(exponent, 0), len(starts) - 1)
    wrapped = texel - np.float32(floor(np.float64(texel * (_ONE / size)))) * size
    return wrapped / np.float32(1 << level) + starts[level]


@kernel(
    *[In("i2", 1), In("f4", 2), In("f8", 3), In("f8", 3), In("f8", 3), In("f4", 2), In("f4", 1)],
    "i8",
    "i8",
    Out("f4", 2),
    Out("f4", 1),
)
def write_places(
    visible,
    pixels,
    inverse_depth,
    texels_s,
    texels_t,
    corners,
    starts,
    size,
    height,
    places,
    depths,
):
    """Write where in the atlas the colour of samples is, (2, m), and their depths; 0: nothing.

    Samples are at `pixels` (2, m), (u, v). Level i of a texture begins at `starts`, next to
    its corner.
    """
    for i in range(len(visible)):
        k, u, v = visible[i], pixels[0, i], pixels[1, i]
        if k < 0:
            depths[i], places[0, i], places[1, i] = 0.0, 0.0, 0.0
            continue
        row = floor(np.float64(v + _HALF)) * len(inverse_depth) // height
        form = inverse_depth[row, k]
        a, b, c = np.float32(form[0]), np.float32(form[1]), np.float32(form[2])
        depth = _ONE / max(a * u + b * v + c, _SMALLEST)
        across = np.float32(size)
        x = _place(texels_s[row, k], (a, b), u, v, depth, across, starts)
        y = _place(texels_t[row, k], (a, b), u, v, depth, across, starts)
        depths[i], places[0, i], places[1, i] = depth, x + corners[k, 0], y + corners[k, 1]
