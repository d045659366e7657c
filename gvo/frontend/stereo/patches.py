"""Square patches of the left image, and strips of the right one to search for them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.kernels import sampling
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Half size of the patches that are compared between left and right, and how many columns are
# searched on either side of a start.
PATCH_RADIUS_PX = 5
SEARCH_RADIUS_PX = 3
# Lower bound of the gradient energy of a patch, grey values squared: the noise.
_MIN_ENERGY = 50.0
# Variance of grey values over that of a disparity, its slopes and a difference of sharpness: the
# prior of a patch that faces the camera and is as sharp on the right.
_PRIORS = np.array([1.0, 100.0, 100.0, 1000.0], dtype=np.float32)
# Largest variance of the difference of matching patches: a share of the patch's variance, plus the
# noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.2
_UNLIKE_NOISE = 18.0
# A rival disparity counts where its difference is at most so many times that of the one found.
_MAX_RIVALRY = 2.0


def sample_patches(
    image: ImageArray,
    u: FloatArray,
    v: FloatArray,
    radius_u: int,
    radius_v: int,
    *,
    slopes: FloatArray | None = None,
) -> NDArray[np.float32]:
    """Return patches around pixels, interpolated.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        Its border pixels are replicated.
    u, v : ndarray of float64, shape (n,)
        Column and row of the centre of each patch.
    radius_u, radius_v : int
        Pixels on either side.
    slopes : ndarray of float64, shape (n, 2), optional
        Columns shrink by the first share, and rows are shifted to the left by the second, as
        those of a right image whose disparities grow by so much per pixel.

    Returns
    -------
    ndarray of float32, shape (n, 2 * radius_v + 1, 2 * radius_u + 1)
    """
    shape = len(u), 2 * radius_v + 1, 2 * radius_u + 1
    if len(u) == 0:  # refused by OpenCV
        return np.zeros(shape, dtype=np.float32)
    steps = steps_around(radius_u, radius_v)
    columns = u.astype(np.float32)[:, np.newaxis] + steps[0]
    if slopes is not None:
        columns -= slopes.astype(np.float32) @ steps
    patches = cv2.remap(
        image,
        columns,
        v.astype(np.float32)[:, np.newaxis] + steps[1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return patches.astype(np.float32).reshape(shape)


@lru_cache(maxsize=32)
def steps_around(radius_u: int, radius_v: int) -> NDArray[np.float32]:
    """Return the offsets (u, v) of the pixels of a patch from its centre, row by row, (2, n)."""
    v, u = np.mgrid[-radius_v : radius_v + 1, -radius_u : radius_u + 1].astype(np.float32)
    return np.stack([u.ravel(), v.ravel()])


def cut_patches(image: ImageArray, pixels: FloatArray, radius: int) -> NDArray[np.uint8]:
    """Return patches around whole pixels (n, 2) of an image, whose border is replicated.

    Returns
    -------
    ndarray of uint8, shape (n, 2 * radius + 1, 2 * radius + 1)
    """
    patches = np.empty((len(pixels), 2 * radius + 1, 2 * radius + 1), np.uint8)
    sampling.cut_patches(np.ascontiguousarray(image), np.ascontiguousarray(pixels), patches)
    return patches


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Patches of the left image, prepared for inverse compositional alignment.

    The gradients are those of the left patches, computed once; their mean is subtracted, so that
    a difference of exposure has no effect.

    References
    ----------
    S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd.
    """

    weights: NDArray[np.float32]
    at_rest: NDArray[np.float32]

    @classmethod
    def of(cls, wide: NDArray[np.float32]) -> Patches:
        """Prepare patches (n, s, s + 2), which are one column wider on either side."""
        n, height, width = len(wide), wide.shape[1], wide.shape[2] - 2
        gradients = (0.5 * (wide[:, :, 2:] - wide[:, :, :-2])).reshape(n, height * width)
        gradients -= gradients.mean(axis=1, keepdims=True)
        energies = np.einsum("ni,ni->n", gradients, gradients)[:, np.newaxis]
        gradients /= np.maximum(energies, np.float32(_MIN_ENERGY))
        weights = gradients.reshape(n, height, width)
        return cls(weights=weights, at_rest=np.einsum("nij,nij->n", weights, wide[:, :, 1:-1]))

    def take(self, chosen: IntArray) -> Patches:
        """Select patches by index, with repetitions."""
        return Patches(self.weights[chosen], self.at_rest[chosen])

    def descend(
        self, strips: NDArray[np.float32], places: FloatArray, *, n_steps: int, max_step: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the places in strips (n, s, m) after some steps, and the last steps.

        A step is a growth of the disparity; places are clipped to the strips. Between whole places
        steps are linear, as the patches are.
        """
        steps = correlate_rows(self.weights, strips)
        steps -= self.at_rest[:, np.newaxis]
        n, n_places = steps.shape
        firsts, flat = n_places * np.arange(n), steps.ravel()
        step = np.zeros(n)
        places = np.minimum(np.maximum(places, 0.0), n_places - 1.0)
        for _ in range(n_steps):
            whole = np.minimum(places.astype(np.int64), n_places - 2)
            before, after = flat[firsts + whole], flat[firsts + whole + 1]
            step = before + (places - whole) * (after - before)
            step = np.minimum(np.maximum(step, -max_step), max_step)
            places = np.minimum(np.maximum(places - step, 0.0), n_places - 1.0)
        return places, step


@dataclass(frozen=True, slots=True, eq=False)
class SlantedPatches:
    """Patches of the left image, prepared for steps of the disparity and of its slopes.

    On a slanted surface, such as the road, the disparity is linear in the pixel. A common one for
    a whole patch is wrong by tenths of a pixel where the texture is uneven. The right patch is
    interpolated, and blurred by that: without a parameter for it, edges would look stretched.
    """

    values: NDArray[np.float32]
    basis: NDArray[np.float32]
    inverses: NDArray[np.float32]

    @classmethod
    def of(cls, wide: NDArray[np.float32]) -> SlantedPatches:
        """Prepare patches (n, s + 2, s + 2), which are one pixel wider on all sides."""
        n, size = len(wide), wide.shape[1] - 2
        steps = steps_around(size // 2, size // 2)
        before, values, after = (wide[:, 1:-1, k : k + size] for k in range(3))
        along = (0.5 * (after - before)).reshape(n, 1, size**2)
        blur = (before - 2.0 * values + after).reshape(n, 1, size**2)
        basis = np.concatenate([along, along * steps[0], along * steps[1], blur], axis=1)
        basis -= basis.mean(axis=2, keepdims=True)
        squares = np.matmul(basis, np.swapaxes(basis, 1, 2)) + np.diag(_PRIORS)
        return cls(values, basis, np.linalg.inv(squares))

    def step(self, right: NDArray[np.float32], slopes: FloatArray) -> NDArray[np.float32]:
        """Return the changes of the disparity and its slopes, shape (n, 3).

        Parameters
        ----------
        right : ndarray of float32, shape (n, s, s)
            Patches of the right image at the present ones.
        slopes : ndarray of float64, shape (n, 2)
            The present ones.
        """
        differences = (right - self.values).reshape(len(right), self.basis.shape[2], 1)
        pulls = np.matmul(self.basis, differences)
        pulls[:, 1:3, 0] -= _PRIORS[1:3] * slopes
        changes: NDArray[np.float32] = np.matmul(self.inverses, pulls)
        return changes[:, :3, 0]


def correlate_rows(
    patches: NDArray[np.float32], strips: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the sums of products of patches with all places along wider strips.

    Parameters
    ----------
    patches : ndarray of float32, shape (n, s, s)
    strips : ndarray of float32, shape (n, s, m)

    Returns
    -------
    ndarray of float32, shape (n, m - s + 1)
    """
    size, n_places = patches.shape[2], strips.shape[2] - patches.shape[2] + 1
    # Products of all columns of a patch and its strip, summed along diagonals: a sixth of the time
    # of a loop over the pixels.
    products: NDArray[np.float32] = np.matmul(np.swapaxes(patches, 1, 2), strips)
    sums = products[:, 0, :n_places].copy()
    for column in range(1, size):
        sums += products[:, column, column : column + n_places]
    return sums


def squared_differences(
    patches: NDArray[np.float32], strips: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the sums of squared differences less their mean, shape (n, places)."""
    size = patches.shape[2]
    n_places = strips.shape[2] - size + 1
    sums = np.empty((len(patches), n_places), dtype=np.float32)
    for place in range(n_places):
        difference = (strips[:, :, place : place + size] - patches).reshape(len(patches), size**2)
        squares = np.einsum("ni,ni->n", difference, difference)
        sums[:, place] = squares - difference.sum(axis=1) ** 2 / difference.shape[1]
    return sums


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Likeness:
    """How well patches of left and right match.

    Parameters
    ----------
    unlike : ndarray of float32, shape (n,)
        Variance of the difference, grey values squared; infinite without a disparity.
    limits : ndarray of float32, shape (n,)
        Largest variance of a match.
    """

    unlike: NDArray[np.floating]
    limits: NDArray[np.floating]

    @classmethod
    def of(cls, left: NDArray[np.float32], right: NDArray[np.float32]) -> Likeness:
        """Compare patches, shape (n, s, s)."""
        limits = _MAX_UNLIKE * _variances(left) + _UNLIKE_NOISE
        return cls(unlike=_variances(right - left), limits=limits)

    @property
    def are_alike(self) -> BoolArray:
        """Whether left and right match.

        At a depth discontinuity within a patch no single disparity aligns both parts: the
        disparity is that of neither surface. The error stays with the corner from frame to frame,
        so that no residual shows it, and motions accumulate it.
        """
        return np.asarray(self.unlike <= self.limits)

    def where(self, are_there: BoolArray) -> Likeness:
        """Set the variance to infinity where there is no disparity."""
        unlike = np.where(are_there, self.unlike, np.float32(np.inf))
        return Likeness(unlike=unlike, limits=self.limits)

    def select(self, chosen: IntArray) -> Likeness:
        """Select pixels by index."""
        return Likeness(unlike=self.unlike[chosen], limits=self.limits[chosen])

    def rivals(self, found: Likeness) -> BoolArray:
        """Tell where these disparities match as well as those that were found.

        The windows of a house are all alike; side by side along a row, the depth is any of
        several, and mostly wrong.
        """
        return self.are_alike & (self.unlike <= _MAX_RIVALRY * found.unlike + _UNLIKE_NOISE)


def _variances(patches: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the variances of patches, shape (n,), in a third of the time of `ndarray.var`."""
    n, height, width = patches.shape
    flat = patches.reshape(n, height * width)
    centred = flat - (np.add.reduce(flat, axis=1) / flat.shape[1])[:, np.newaxis]
    return np.asarray(np.einsum("ni,ni->n", centred, centred) / flat.shape[1])
