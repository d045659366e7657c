"""Linear algebra of a few unknowns, in place."""

from __future__ import annotations

import numpy as np

from gvo.kernels.jit import helper


@helper
def clear(H, g):
    """Write zeros into normal equations."""
    for i in range(len(g)):
        g[i] = 0.0
        for j in range(len(g)):
            H[i, j] = 0.0


@helper
def dot(a, b):
    """Return the inner product."""
    value = 0.0
    for i in range(len(a)):
        value += a[i] * b[i]
    return value


@helper
def copy(A, out):
    """Write a matrix into another one, as much of it as that holds."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = A[i, j]


@helper
def factorize(A):
    """Overwrite the lower triangle of A by its Cholesky factor; False: not positive definite."""
    for j in range(len(A)):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        if not pivot > 0.0:
            return False
        A[j, j] = np.sqrt(pivot)
        for i in range(j + 1, len(A)):
            value = A[i, j]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            A[i, j] = value / A[j, j]
    return True


@helper
def substitute(L, b):
    """Overwrite b by the solution x of L L^T x = b."""
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@helper
def solve(A, b):
    """Overwrite b by the solution x of A x = b, and A; False: not definite, or not finite."""
    if not factorize(A):
        return False
    substitute(A, b)
    return dot(b, b) < np.inf


@helper
def invert(A, inverse):
    """Write the inverse of A, which is overwritten; False: not positive definite."""
    if not factorize(A):
        return False
    for j in range(len(A)):
        for i in range(len(A)):
            inverse[j, i] = 1.0 if i == j else 0.0
        # Symmetric: a row is the column.
        substitute(A, inverse[j])
    return True
