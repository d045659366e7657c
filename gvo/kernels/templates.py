"""Square patches of a reference image, aligned with another one.

Inverse compositional (Baker, Matthews 2004, doi:10.1023/B:VISI.0000011205.11775.fd): gradients and
Hessians are those of the reference, computed once. Means are subtracted, so that a difference of
exposure has no effect.
"""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import In, Out, kernel, vector
from gvo.kernels.sampling import sample

RADIUS_PX = 4
"""Half size of the patches, pixels."""

# An integer of NumPy: for one of Python the helper would be compiled anew.
_RADIUS = np.int64(RADIUS_PX)
_SIDE = 2 * RADIUS_PX + 1
_N_PIXELS = _SIDE * _SIDE
# Variance of a gradient that is noise, grey values squared: keeps flat patches from dividing by
# nothing.
_NOISE = 1.0
# So many steps; as many again where the last of them moved a patch by more than this.
_N_STEPS = 2
_MOVING_PX = 0.03
# A step moves a patch by at most so much, along each of its axes; it is at rest below so much.
_MAX_STEP_PX = 1.0
_MAX_LAST_STEP_PX = 0.2
# Largest variance of the difference of matching patches: a share of the patch's variance, plus the
# noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.5
_UNLIKE_NOISE = 25.0


@kernel(In("u1", 3), Out("f4", 2), Out("f4", 3), Out("f8", 2))
def prepare(patches, values, gradients, inverses):
    """Prepare patches that are one pixel wider on all sides.

    Write grey values (n, s * s) and gradients G along rows and columns (n, 2, s * s), less their
    means, and the inverse (00, 01, 11) of the Hessian H = G G' + noise with the variance of the
    values, (n, 4). Gradients are half the difference of the pixels on either side.
    """
    for k in range(len(patches)):
        patch = patches[k]
        mean, mean_u, mean_v, m = 0.0, 0.0, 0.0, 0
        for j in range(1, _SIDE + 1):
            for i in range(1, _SIDE + 1):
                value = 1.0 * patch[j, i]
                along = 0.5 * (1.0 * patch[j, i + 1] - patch[j, i - 1])
                across = 0.5 * (1.0 * patch[j + 1, i] - patch[j - 1, i])
                values[k, m], gradients[k, 0, m], gradients[k, 1, m] = value, along, across
                mean += value / _N_PIXELS
                mean_u += along / _N_PIXELS
                mean_v += across / _N_PIXELS
                m += 1
        h_uu, h_uv, h_vv, variance = _NOISE, 0.0, _NOISE, 0.0
        for m in range(_N_PIXELS):
            value = values[k, m] - mean
            along, across = gradients[k, 0, m] - mean_u, gradients[k, 1, m] - mean_v
            values[k, m], gradients[k, 0, m], gradients[k, 1, m] = value, along, across
            h_uu += along * along
            h_uv += along * across
            h_vv += across * across
            variance += value * value / _N_PIXELS
        determinant = h_uu * h_vv - h_uv * h_uv
        inverses[k, 0], inverses[k, 1] = h_vv / determinant, -h_uv / determinant
        inverses[k, 2], inverses[k, 3] = h_uu / determinant, variance


@kernel(
    *(In("u1", 2), In("f4", 2), In("f4", 3), In("f8", 2), In("i8", 1), In("f8", 3)),
    *(Out("f8", 2), Out("b1", 1)),
)
def align(image, values, gradients, inverses, indices, warps, pixels, is_found):
    """Move pixels (m, 2) to where the patches of these indices are in an image.

    Warps W (m, 2, 2) are the derivatives of the image's pixels by those of the patch. A step takes
    W H^-1 G d off a pixel: d is the difference between the image at the pixel + W (i, j), |i| and
    |j| <= radius, and the patch. Write which are found: not what does not come to rest, or is
    unlike its patch, by the variance of d without (G d)' H^-1 G d, which the step explains.
    """
    seen = vector(_N_PIXELS)
    for k in range(len(indices)):
        p, warp = indices[k], warps[k]
        u, v, moved, unlike = pixels[k, 0], pixels[k, 1], np.inf, np.inf
        for n in range(2 * _N_STEPS):
            if n == _N_STEPS and moved <= _MOVING_PX:
                break
            sample(
                *(image, u, v, warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]),
                *(_RADIUS, _RADIUS, seen),
            )
            total, squares, pull_u, pull_v = 0.0, 0.0, 0.0, 0.0
            for m in range(_N_PIXELS):
                difference = seen[m] - values[p, m]
                total += difference
                squares += difference * difference
                pull_u += gradients[p, 0, m] * difference
                pull_v += gradients[p, 1, m] * difference
            step_u = inverses[p, 0] * pull_u + inverses[p, 1] * pull_v
            step_v = inverses[p, 1] * pull_u + inverses[p, 2] * pull_v
            # What the step explains of the difference is gone.
            explained = pull_u * step_u + pull_v * step_v
            unlike = (squares - total * total / _N_PIXELS - explained) / _N_PIXELS
            step_u = min(max(step_u, -_MAX_STEP_PX), _MAX_STEP_PX)
            step_v = min(max(step_v, -_MAX_STEP_PX), _MAX_STEP_PX)
            du = warp[0, 0] * step_u + warp[0, 1] * step_v
            dv = warp[1, 0] * step_u + warp[1, 1] * step_v
            u, v, moved = u - du, v - dv, np.hypot(du, dv)
        pixels[k, 0], pixels[k, 1] = u, v
        is_alike = unlike <= _MAX_UNLIKE * inverses[p, 3] + _UNLIKE_NOISE
        is_found[k] = is_alike and moved < _MAX_LAST_STEP_PX
