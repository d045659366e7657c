"""Disparities of pixels: searched for along the row, refined, fitted with the slopes of surfaces.

Patches have a radius of 5 pixels. A strip of the right image is a patch with room for a shift by
4 pixels on either side; a place in it is a shift plus 4.
"""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, helper, kernel, matrix, vector
from gvo.kernels.linear import factorize, substitute
from gvo.kernels.sampling import sample

RADIUS_PX, REACH_PX = 5, 3
"""Half size of the patches, and how far to search on either side of a start, pixels."""
N_RIVALS = 3
"""Further peaks of the coarse correlation that are examined."""
REDUCTION = 4
"""By which images are smaller in the coarse search."""
COARSE_ERROR_PX = REDUCTION + 1
"""Largest error of the coarse search, pixels of the full image."""

# Numba compiles a helper anew for each integer of Python that it is given, not for NumPy's.
_RADIUS = np.int64(RADIUS_PX)
_SIDE = 2 * RADIUS_PX + 1
_N_PIXELS = _SIDE * _SIDE
_MARGIN_PX = REACH_PX + 1
_N_PLACES = 2 * _MARGIN_PX + 1
_STRIP = _SIDE + 2 * _MARGIN_PX
# Lower bound of the energy of a patch or of its gradients, grey values squared: the noise.
_MIN_ENERGY = 50.0
# The coarse search: half size of the patches, and the least correlation.
_COARSE_RADIUS_PX = 2
_COARSE_SIDE = 2 * _COARSE_RADIUS_PX + 1
_MIN_CORRELATION = 0.7
# Steps on either side that belong to the same peak of correlation; and how much lower a second
# peak may be: so much do equal patches differ in the small images.
_PEAK_STEPS = 2
_MAX_GAP = 0.25
# Gauss-Newton steps from the coarse search, and after the parabola through squared differences: the
# last moves by less than 0.01 pixels.
_N_SEARCH_STEPS = np.int64(6)
_N_FINE_STEPS = np.int64(3)
# Steps of the disparity: the largest, that after a parabola, and the last of what is at rest.
_MAX_STEP_PX = 1.5
_MAX_FINE_STEP_PX = 0.5
_MAX_LAST_STEP_PX = 0.3
# Gauss-Newton steps of a disparity with its slopes, the largest slope of a surface, and the least
# width of a left column in the right image.
_N_SLOPE_STEPS = 2
_MAX_SLOPE = 0.5
_MIN_WIDTH = 0.5
# Variance of grey values over that of a disparity, its slopes and a difference of sharpness: the
# prior of a patch that faces the camera and is as sharp on the right.
_PRIORS = np.array([1.0, 100.0, 100.0, 1000.0])
# Largest variance of the difference of matching patches: a share of the patch's variance, plus the
# noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.2
_UNLIKE_NOISE = 18.0
# A rival disparity counts where its difference is at most so many times that of the one found.
_MAX_RIVALRY = 2.0


@helper
def _vertex(before, at, after):
    """Return the place of the vertex of a parabola through three samples, from the middle one."""
    curvature = before - 2.0 * at + after
    return 0.5 * (before - after) / curvature if curvature != 0.0 else 0.0


@helper
def _peak(values, n, best):
    """Return the place of a peak between samples; at the ends that of the sample."""
    if best <= 0 or best >= n - 1:
        return 1.0 * best
    return best + _vertex(values[best - 1], values[best], values[best + 1])


@helper
def _largest(values, n):
    """Return the index of the first of the largest values."""
    best = 0
    for p in range(1, n):
        if values[p] > values[best]:
            best = p
    return best


@helper
def _correlate(left, right, column, row, n_steps, patch, work, scores):
    """Write the normalized correlations of a patch at disparities n_steps .. 0.

    -1 where the place is left of the right image. Sums of all places grow side by side.
    """
    (height, width), n_pixels, mean = left.shape, _COARSE_SIDE**2, 0.0
    strip, totals, squares, products = work[0], work[1], work[2], work[3]
    for m in range(len(strip)):
        totals[m], squares[m], products[m] = 0.0, 0.0, 0.0
    for j in range(_COARSE_SIDE):
        y = min(max(row + j - _COARSE_RADIUS_PX, 0), height - 1)
        for i in range(_COARSE_SIDE):
            patch[j, i] = left[y, min(max(column + i - _COARSE_RADIUS_PX, 0), width - 1)]
            mean += patch[j, i] / n_pixels
    energy = 0.0
    for j in range(_COARSE_SIDE):
        for i in range(_COARSE_SIDE):
            patch[j, i] -= mean
            energy += patch[j, i] * patch[j, i]
    energy = max(energy, _MIN_ENERGY)
    first = column - n_steps - _COARSE_RADIUS_PX
    for j in range(_COARSE_SIDE):
        y = min(max(row + j - _COARSE_RADIUS_PX, 0), height - 1)
        for m in range(n_steps + _COARSE_SIDE):
            strip[m] = right[y, min(max(first + m, 0), width - 1)]
        for m in range(n_steps + _COARSE_SIDE):
            # Whole numbers: these sums are exact in any order.
            totals[m] += strip[m]
            squares[m] += strip[m] * strip[m]
        for i in range(_COARSE_SIDE):
            value = patch[j, i]
            for step in range(n_steps + 1):
                products[step] += value * strip[step + i]
    for step in range(n_steps + 1):
        total, sum_of_squares = 0.0, 0.0
        for i in range(_COARSE_SIDE):
            total += totals[step + i]
            sum_of_squares += squares[step + i]
        other = max(sum_of_squares - total * total / n_pixels, _MIN_ENERGY)
        is_within = column - n_steps + step >= 0
        scores[step] = products[step] / np.sqrt(energy * other) if is_within else -1.0


@kernel(
    *(In("u1", 2), In("u1", 2), In("f8", 2), "f8"),
    *(Out("f8", 1), Out("b1", 1), Out("f8", 2)),
)
def search(left, right, pixels, max_disparity, disparities, is_found, rivals):
    """Find the disparities of whole pixels (n, 2) to a few pixels, by normalized correlation.

    Left and right are of a quarter of the size. Of all steps from the largest disparity to zero the
    first that correlates best is taken, between steps by a parabola. Rivals (n, 3) are what is
    best, and nearly as good, without the peaks before; else NaN.
    """
    height, width = left.shape
    n_steps = min(int(np.ceil(max_disparity / REDUCTION)), width)
    n, scores = n_steps + 1, vector(n_steps + 1)
    patch, work = matrix(_COARSE_SIDE, _COARSE_SIDE), matrix(4, n_steps + _COARSE_SIDE)
    for k in range(len(pixels)):
        column = min(int(pixels[k, 0] // REDUCTION), width - 1)
        row = min(int(pixels[k, 1] // REDUCTION), height - 1)
        _correlate(left, right, column, row, n_steps, patch, work, scores)
        best = _largest(scores, n)
        top = scores[best]
        is_found[k] = top > _MIN_CORRELATION
        disparities[k] = REDUCTION * (n_steps - _peak(scores, n, best))
        for rank in range(N_RIVALS):
            rivals[k, rank] = np.nan
        for rank in range(N_RIVALS):
            for p in range(max(best - _PEAK_STEPS, 0), min(best + _PEAK_STEPS, n_steps) + 1):
                scores[p] = -1.0
            best = _largest(scores, n)
            if not scores[best] > top - _MAX_GAP:
                break
            rivals[k, rank] = REDUCTION * (n_steps - _peak(scores, n, best))


@helper
def _have_room(image, u, v, disparity):
    """Tell whether a pixel has room for a patch in both images; NaN has none."""
    height, width = image.shape
    right, last_u, last_v = u - disparity, width - 1 - RADIUS_PX, height - 1 - RADIUS_PX
    is_in_left = RADIUS_PX <= u <= last_u and RADIUS_PX <= v <= last_v
    return is_in_left and RADIUS_PX <= right <= last_u


@helper
def _weigh(wide, patch, weights):
    """Write a patch and its weights, of one that is a pixel wider on all sides.

    The weights are the gradients along rows, less their mean, over their energy: the sum of their
    products with a difference is the shift that explains it best. Return their sum with the patch.
    """
    mean, energy, at_rest, m, stride = 0.0, 0.0, 0.0, 0, _SIDE + 2
    for j in range(1, _SIDE + 1):
        for i in range(1, _SIDE + 1):
            k = j * stride + i
            patch[m], weights[m] = wide[k], 0.5 * (wide[k + 1] - wide[k - 1])
            mean += weights[m] / _N_PIXELS
            m += 1
    for m in range(_N_PIXELS):
        weights[m] -= mean
        energy += weights[m] * weights[m]
    for m in range(_N_PIXELS):
        weights[m] /= max(energy, _MIN_ENERGY)
        at_rest += weights[m] * patch[m]
    return at_rest


@helper
def _shift_at(weights, at_rest, strip, place):
    """Return the shift that the gradients of a patch see at a whole place of a strip."""
    shift = -at_rest
    for j in range(_SIDE):
        first = j * _STRIP + place
        for i in range(_SIDE):
            shift += weights[j * _SIDE + i] * strip[first + i]
    return shift


@helper
def _follow(weights, at_rest, strip, place, n_steps, max_step):
    """Return the place in a strip after some steps, and the last one: a growth of the disparity.

    Between whole places steps are linear, as the patches are.
    """
    step, known, before, after = 0.0, -1, 0.0, 0.0
    place = min(max(place, 0.0), _N_PLACES - 1.0)
    for _ in range(n_steps):
        whole = min(int(place), _N_PLACES - 2)
        if whole != known:
            known = whole
            before = _shift_at(weights, at_rest, strip, whole)
            after = _shift_at(weights, at_rest, strip, whole + 1)
        step = before + (place - whole) * (after - before)
        step = min(max(step, -max_step), max_step)
        # In this order NaN becomes zero: it is no place. The step tells.
        place = min(max(0.0, place - step), _N_PLACES - 1.0)
    return place, step


@helper
def _nearest(patch, strip, differences):
    """Return the place of the least squared difference less its mean, and whether it is one."""
    for place in range(_N_PLACES):
        total, squares = 0.0, 0.0
        for j in range(_SIDE):
            for i in range(_SIDE):
                difference = strip[j * _STRIP + place + i] - patch[j * _SIDE + i]
                total += difference
                squares += difference * difference
        differences[place] = total * total / _N_PIXELS - squares
    best = _largest(differences, _N_PLACES)
    return _peak(differences, _N_PLACES, best), 0 < best < _N_PLACES - 1


@helper
def _variance(a, b):
    """Return the variance of the difference of two patches."""
    total, squares = 0.0, 0.0
    for m in range(_N_PIXELS):
        difference = a[m] - b[m]
        total += difference
        squares += difference * difference
    return squares / _N_PIXELS - (total / _N_PIXELS) ** 2


@helper
def _fit_plane(wide, patch, right, u, row, basis, H, seen, plane):
    """Fit the disparity of a surface with its slopes: plane (disparity, along, across).

    By Gauss-Newton steps with priors: pixel (i, j) of the patch is seen at the column
    u - disparity + (1 - along) i - across j. The right patch is interpolated, and blurred by that:
    without a parameter for it, the second derivative along rows, edges would look stretched. Write
    the patch seen before the last step. Return whether the surface is not too steep to be seen by
    both cameras, nor too far from where one that faces them would be.
    """
    stride, m, pull, start = _SIDE + 2, 0, vector(4), plane[0]
    p, q, r, s = 0.0, 0.0, 0.0, 0.0
    for j in range(-RADIUS_PX, RADIUS_PX + 1):
        for i in range(-RADIUS_PX, RADIUS_PX + 1):
            k = (j + RADIUS_PX + 1) * stride + i + RADIUS_PX + 1
            along = 0.5 * (wide[k + 1] - wide[k - 1])
            blur = wide[k - 1] - 2.0 * wide[k] + wide[k + 1]
            basis[m, 0], basis[m, 1], basis[m, 2] = along, along * i, along * j
            basis[m, 3] = blur
            p, q = p + along / _N_PIXELS, q + along * i / _N_PIXELS
            r, s = r + along * j / _N_PIXELS, s + blur / _N_PIXELS
            m += 1
    for m in range(_N_PIXELS):
        basis[m, 0], basis[m, 1] = basis[m, 0] - p, basis[m, 1] - q
        basis[m, 2], basis[m, 3] = basis[m, 2] - r, basis[m, 3] - s
    for a in range(4):
        p, q, r, s = 0.0, 0.0, 0.0, 0.0
        for m in range(_N_PIXELS):
            p, q = p + basis[m, a] * basis[m, 0], q + basis[m, a] * basis[m, 1]
            r, s = r + basis[m, a] * basis[m, 2], s + basis[m, a] * basis[m, 3]
        H[a, 0], H[a, 1], H[a, 2], H[a, 3] = p, q, r, s
        H[a, a] += _PRIORS[a]
    factorize(H)
    for _ in range(_N_SLOPE_STEPS):
        sample(
            *(right, u - plane[0], row, 1.0 - plane[1], -plane[2], 0.0, 1.0),
            *(_RADIUS, _RADIUS, seen),
        )
        p, q, r, s = 0.0, -_PRIORS[1] * plane[1], -_PRIORS[2] * plane[2], 0.0
        for m in range(_N_PIXELS):
            unlike = seen[m] - patch[m]
            p, q = p + basis[m, 0] * unlike, q + basis[m, 1] * unlike
            r, s = r + basis[m, 2] * unlike, s + basis[m, 3] * unlike
        pull[0], pull[1], pull[2], pull[3] = p, q, r, s
        substitute(H, pull)
        # Steps are those of the left patch, whose columns are 1 - slope wide in the right image.
        width = (1.0 - plane[1]) / max(1.0 + pull[1], _MIN_WIDTH)
        for a in range(3):
            plane[a] += width * pull[a]
    is_flat = abs(plane[1]) < _MAX_SLOPE and abs(plane[2]) < _MAX_SLOPE
    return is_flat and abs(plane[0] - start) < _MAX_STEP_PX


@helper
def _row_shift(wide, patch, seen):
    """Return the shift across rows that explains the difference of two patches best."""
    stride, mean, energy, product = _SIDE + 2, 0.0, 0.0, 0.0
    for n in range(2):
        m = 0
        for j in range(1, _SIDE + 1):
            for i in range(1, _SIDE + 1):
                k = j * stride + i
                across = 0.5 * (wide[k + stride] - wide[k - stride])
                if n == 0:
                    mean += across / _N_PIXELS
                else:
                    energy += (across - mean) ** 2
                    product += (across - mean) * (patch[m] - seen[m])
                m += 1
    return product / max(energy, _MIN_ENERGY)


@kernel(
    *(
        In("u1", 2),
        In("u1", 2),
        In("f8", 2),
        In("f8", 1),
        In("b1", 1),
        In("f8", 2),
        In("f8", 1),
        "b1",
    ),
    *(Out("f8", 1), Out("f8", 2), Out("b1", 1), Out("f8", 1)),
)
def measure(
    left,
    right,
    corners,
    rough,
    is_found,
    rivals,
    row_offsets_px,
    is_refined,
    disparities,
    slopes,
    is_reliable,
    row_shifts,
):
    """Measure corners (n, 2) of the left image whose disparities are roughly known; see `search`.

    Write disparities (NaN: none), their slopes along rows and columns (n, 2), which are reliable,
    and how far rows of the right image are still off (NaN: not told). At a depth discontinuity
    within a patch no single disparity aligns both parts; and the windows of a house are all alike:
    where two disparities match as well, either may be wrong. What is reliable is measured again
    together with the slopes of its surface. Unless refined, disparities are whole pixels.
    """
    wide, strip = vector((_SIDE + 2) ** 2), vector(_SIDE * _STRIP)
    patch, weights, seen = vector(_N_PIXELS), vector(_N_PIXELS), vector(_N_PIXELS)
    basis, H, plane = matrix(_N_PIXELS, 4), matrix(4, 4), vector(3)
    differences, nothing = vector(_N_PLACES), vector(_N_PIXELS)
    for m in range(_N_PIXELS):
        nothing[m] = 0.0
    for k in range(len(corners)):
        disparities[k], row_shifts[k], is_reliable[k] = np.nan, np.nan, False
        slopes[k, 0], slopes[k, 1] = 0.0, 0.0
        u, v = corners[k, 0], corners[k, 1]
        if not (is_found[k] and _have_room(left, u, v, rough[k])):
            continue
        row, first_unlike = v + row_offsets_px[k], np.inf
        sample(left, u, v, 1.0, 0.0, 0.0, 1.0, RADIUS_PX + 1, RADIUS_PX + 1, wide)
        at_rest = _weigh(wide, patch, weights)
        limit = _MAX_UNLIKE * _variance(patch, nothing) + _UNLIKE_NOISE
        for rank in range(1 + N_RIVALS):
            start = rough[k] if rank == 0 else rivals[k, rank - 1]
            if rank > 0 and not (is_reliable[k] and _have_room(left, u, v, start)):
                continue
            # At whole columns nothing is interpolated twice.
            column = np.floor(u - start)
            reach = RADIUS_PX + _MARGIN_PX
            sample(right, column, row, 1.0, 0.0, 0.0, 1.0, reach, _RADIUS, strip)
            if is_refined:
                place = u - start - column + _MARGIN_PX
                place, step = _follow(weights, at_rest, strip, place, _N_SEARCH_STEPS, _MAX_STEP_PX)
                disparity = u - column - (place - _MARGIN_PX)
                is_at_rest = abs(disparity - start) < REACH_PX and abs(step) < _MAX_LAST_STEP_PX
            else:
                place, is_at_rest = _nearest(patch, strip, differences)
                disparity = np.rint(u - column - (place - _MARGIN_PX))
            sample(right, u - disparity, row, 1.0, 0.0, 0.0, 1.0, _RADIUS, _RADIUS, seen)
            unlike = _variance(seen, patch) if is_at_rest else np.inf
            if rank == 0:
                disparities[k], first_unlike = disparity, unlike
                is_reliable[k] = unlike <= limit
            elif abs(disparity - disparities[k]) > COARSE_ERROR_PX:
                # A second minimum at the same disparity is no rival.
                is_rival = unlike <= limit and unlike <= _MAX_RIVALRY * first_unlike + _UNLIKE_NOISE
                is_reliable[k] = not is_rival
        if not is_reliable[k]:
            continue
        if is_refined:
            plane[0], plane[1], plane[2] = disparities[k], 0.0, 0.0
            is_reliable[k] = _fit_plane(wide, patch, right, u, row, basis, H, seen, plane)
            disparities[k], slopes[k, 0], slopes[k, 1] = plane[0], plane[1], plane[2]
        else:
            sample(
                *(right, u - disparities[k], row, 1.0, 0.0, 0.0, 1.0),
                *(_RADIUS, _RADIUS, seen),
            )
        if is_reliable[k]:
            row_shifts[k] = _row_shift(wide, patch, seen)


@kernel(
    *(In("u1", 2), In("u1", 2), In("f8", 2), In("f8", 1), In("f8", 2), In("f8", 1), "i8"),
    *(Out("f8", 1), Out("b1", 1)),
)
def follow(left, right, pixels, predicted, slopes, row_offsets_px, n_steps, disparities, is_valid):
    """Measure the disparities of pixels (n, 2) from predictions that are right to a pixel or two.

    By Gauss-Newton steps; patches of the right image are sampled as those of surfaces of these
    slopes (n, 2). Write NaN without room, and which come to rest within reach.
    """
    wide, strip = vector((_SIDE + 2) ** 2), vector(_SIDE * _STRIP)
    patch, weights, reach = vector(_N_PIXELS), vector(_N_PIXELS), RADIUS_PX + _MARGIN_PX
    for k in range(len(pixels)):
        disparities[k], is_valid[k] = np.nan, False
        u, v, start = pixels[k, 0], pixels[k, 1], predicted[k]
        if not _have_room(left, u, v, start):
            continue
        sample(left, u, v, 1.0, 0.0, 0.0, 1.0, RADIUS_PX + 1, RADIUS_PX + 1, wide)
        along, across = slopes[k, 0], slopes[k, 1]
        sample(
            *(right, u - start, v + row_offsets_px[k], 1.0 - along, -across, 0.0, 1.0),
            *(reach, _RADIUS, strip),
        )
        at_rest = _weigh(wide, patch, weights)
        place, step = _follow(weights, at_rest, strip, 1.0 * _MARGIN_PX, n_steps, _MAX_STEP_PX)
        shift = (1.0 - along) * (place - _MARGIN_PX)
        disparities[k] = start - shift
        is_valid[k] = abs(shift) < REACH_PX and abs(step) < _MAX_LAST_STEP_PX


@kernel(
    *(In("u1", 2), In("u1", 2), In("f8", 2), In("f8", 1), In("f8", 1), "b1"),
    *(Out("f8", 1), Out("b1", 1)),
)
def search_near(left, right, pixels, predicted, row_offsets_px, is_refined, disparities, is_valid):
    """Measure the disparities of pixels (n, 2) near predicted ones, wherever they match best.

    The least squared difference, by a parabola through it and its neighbours, and by Gauss-Newton
    steps, which remove the bias of the parabola towards the weaker texture. Write NaN without room,
    and which are no end of the search. Unless refined, disparities are whole pixels.
    """
    wide, strip = vector((_SIDE + 2) ** 2), vector(_SIDE * _STRIP)
    patch, weights, reach = vector(_N_PIXELS), vector(_N_PIXELS), RADIUS_PX + _MARGIN_PX
    differences = vector(_N_PLACES)
    for k in range(len(pixels)):
        disparities[k], is_valid[k] = np.nan, False
        u, v, start = pixels[k, 0], pixels[k, 1], predicted[k]
        if not _have_room(left, u, v, start):
            continue
        column, row = np.floor(u - start), v + row_offsets_px[k]
        sample(left, u, v, 1.0, 0.0, 0.0, 1.0, RADIUS_PX + 1, RADIUS_PX + 1, wide)
        sample(right, column, row, 1.0, 0.0, 0.0, 1.0, reach, _RADIUS, strip)
        at_rest = _weigh(wide, patch, weights)
        place, is_valid[k] = _nearest(patch, strip, differences)
        if is_refined:
            place = _follow(weights, at_rest, strip, place, _N_FINE_STEPS, _MAX_FINE_STEP_PX)[0]
        disparities[k] = u - column - (place - _MARGIN_PX)
        if not is_refined:
            disparities[k] = np.rint(disparities[k])
