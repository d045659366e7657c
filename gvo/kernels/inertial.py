"""Preintegration: what an IMU measured between two frames, added up."""

from __future__ import annotations

from gvo.kernels.jit import In, Out, kernel, vector
from gvo.kernels.motion import move_right


@kernel(In("f8", 1), In("f8", 2), Out("f8", 2), Out("f8", 1))
def preintegrate(durations_s, values, T, velocity):
    """Move T (4, 4) and a velocity (3,) in its outer axes by what was measured (Forster 2017).

    Rows of `values` are the mean angular velocity and acceleration, in the axes of T, of durations
    that follow each other. A turn is constant within each, an acceleration as turned in its middle:
    v' = v + R exp(w t / 2) a t, p' = p + (v + v') t / 2.
    """
    half = vector(6)
    for i in range(3, 6):
        half[i] = 0.0
    for k in range(len(durations_s)):
        t = durations_s[k]
        for i in range(3):
            half[i] = 0.5 * t * values[k, i]
        move_right(T, half)
        for i in range(3):
            turned = T[i, 0] * values[k, 3] + T[i, 1] * values[k, 4] + T[i, 2] * values[k, 5]
            T[i, 3] += t * (velocity[i] + 0.5 * t * turned)
            velocity[i] += t * turned
        move_right(T, half)
