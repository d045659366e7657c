"""Images: exposure, blur, texture, and frames that cannot be used."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import cv2
import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.limits import MAX_BLUR_PX, lost, measured, unknown
from gvo.diagnostics.check.sampling import Sample
from gvo.frontend.tracking import detect_corners
from gvo.types import (
    DepthArray,
    FaultyFrame,
    FloatArray,
    Frame,
    ImageArray,
    RgbdFrame,
    StereoFrame,
)

_BLACK, _WHITE = 2, 253
# Scales at which the gradients are compared, pixels; the weakest edge, grey per pixel times eight
# (the sum of Sobel's weights).
_FINE_PX, _COARSE_PX = 1.0, 2.0
_MIN_GRADIENT = 8.0
_MIN_EDGES = 20
# Share of the local maxima of the gradient that are taken for edges of things.
_STRONG_SHARE = 0.3
# Of corners that are found again: a window that hardly slides along an edge.
_WINDOW = (15, 15)
_N_TRACK_LEVELS = 4
_MAX_RETURN_PX = 0.5
# Share and number of last rows of one value that make an image torn.
_MIN_TORN_SHARE = 0.05
_MIN_TORN_ROWS = 4


def check_usable(samples: Sequence[Sample]) -> Finding:
    """Return the share of the sampled frames that odometry cannot use, with the first reason."""
    frames = [frame for sample in samples for frame in (sample.first, sample.second)]
    looked_at = [frame for frame in frames if frame is not None]
    if not looked_at:
        return unknown("frames that cannot be used", "no frame to look at")
    faulty = [frame for frame in looked_at if isinstance(frame, FaultyFrame)]
    fix = faulty[0].reason if faulty else ""
    return lost("frames that cannot be used", len(faulty), len(looked_at), fix=fix)


def check_images(samples: Sequence[Sample], config: Config) -> Iterator[Finding]:
    """Yield the findings on the grey images of the samples, of both cameras of a stereo pair."""
    usable = [sample for sample in samples if _grey_images(sample.first)]
    pairs = [sample for sample in usable if _grey_images(sample.second)]
    if not usable:
        return
    is_stereo = isinstance(usable[0].first, StereoFrame)
    for index, name in enumerate(("left", "right") if is_stereo else ("colour",)):
        images = [_grey_images(sample.first)[index] for sample in usable]
        moving = [
            (_grey_images(sample.first)[index], _grey_images(sample.second)[index])
            for sample in pairs
        ]
        yield from _check_exposure(name, images)
        yield from _check_sharpness(name, images)
        mask = getattr(usable[0].first, ("mask", "right_mask")[index])
        yield from _check_texture(name, images, moving, config, mask)
        if moving:
            yield check_frozen(name, moving)
        yield _check_torn(name, images)
    if is_stereo:
        means = np.array([[image.mean() for image in _grey_images(s.first)] for s in usable]) + 1.0
        yield measured("left/right: brightness ratio", float(np.median(means[:, 0] / means[:, 1])))


def _grey_images(frame: Frame | FaultyFrame | None) -> tuple[ImageArray, ...]:
    if isinstance(frame, StereoFrame):
        return (frame.left, frame.right)
    return (frame.image,) if isinstance(frame, RgbdFrame) else ()


def blur_sigma_px(image: ImageArray) -> float:
    """Estimate the blur of an image: sigma of a Gaussian, pixels; NaN without edges.

    At a step edge the gradient of an image smoothed by sigma s falls with
    1 / sqrt(s^2 + blur^2), whatever the contrast. So the blur follows from the ratio of the
    gradients at two scales: here the median over the strong local maxima of the gradient.

    References
    ----------
    S. Zhuo, T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44(9),
    2011, doi:10.1016/j.patcog.2011.03.009.
    """
    fine, coarse = _gradients(image, _FINE_PX), _gradients(image, _COARSE_PX)
    is_maximum = coarse == np.asarray(cv2.dilate(coarse, np.ones((5, 5), np.uint8)))
    is_maximum &= coarse > _MIN_GRADIENT
    if np.count_nonzero(is_maximum) < _MIN_EDGES:
        return math.nan
    strong = np.quantile(coarse[is_maximum], 1.0 - _STRONG_SHARE)
    is_edge = is_maximum & (coarse >= strong)
    ratio = float(np.median((fine[is_edge] / coarse[is_edge]) ** 2))
    # ratio = (coarse^2 + blur^2) / (fine^2 + blur^2)
    numerator = max(_COARSE_PX**2 - ratio * _FINE_PX**2, 0.0)
    return math.sqrt(numerator / max(ratio - 1.0, 1e-3))


def _gradients(image: ImageArray, sigma_px: float) -> FloatArray:
    """Return the size of the gradient of a smoothed image."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px)
    along_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3)
    along_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    return np.asarray(cv2.magnitude(along_u, along_v))


def check_frozen(name: str, pairs: Sequence[tuple[ImageArray | DepthArray, ...]]) -> Finding:
    """Count the images that equal the one before."""
    n_frozen = sum(np.array_equal(before, now, equal_nan=True) for before, now in pairs)
    how = " are the same as the one before"
    return lost(f"{name}: frozen images", n_frozen, len(pairs), how)


def _check_exposure(name: str, images: Sequence[ImageArray]) -> Iterator[Finding]:
    yield measured(f"{name}: brightness", float(np.median([image.mean() for image in images])))
    black = float(np.median([np.mean(image <= _BLACK) for image in images]))
    white = float(np.median([np.mean(image >= _WHITE) for image in images]))
    text = f"{black:.1%} black, {white:.1%} white"
    yield measured(f"{name}: clipped pixels", max(black, white), text=text)


def _check_sharpness(name: str, images: Sequence[ImageArray]) -> Iterator[Finding]:
    blurs = np.array([blur_sigma_px(image) for image in images])
    known = blurs[np.isfinite(blurs)]
    if len(known) == 0:
        yield unknown(f"{name}: blur", "no edges")
        return
    text = f"{np.median(known):.2f} px, {np.mean(known > MAX_BLUR_PX):.0%} of frames above"
    yield measured(f"{name}: blur", float(np.median(known)), text=text)


def _check_texture(
    name: str,
    images: Sequence[ImageArray],
    pairs: Sequence[tuple[ImageArray, ImageArray]],
    config: Config,
    mask: ImageArray | None,
) -> Iterator[Finding]:
    detect = partial(detect_corners, n_corners=config.klt.n_corners, mask=mask)
    counts = [len(detect(image)) for image in images]
    yield measured(
        f"{name}: corners",
        float(np.median(counts)),
        fault_low=config.ransac.min_inliers,
        text=f"{np.median(counts):.0f} median, {min(counts)} least of {config.klt.n_corners}",
    )
    if not pairs:
        yield unknown(f"{name}: corners found again", "no two consecutive frames")
        return
    share = float(np.median([_followed_share(pair, detect(pair[0])) for pair in pairs]))
    yield measured(f"{name}: corners found again", share, text=f"{share:.0%} in the next frame")


def _followed_share(images: tuple[ImageArray, ImageArray], corners: FloatArray) -> float:
    """Return the share of corners that Lucas-Kanade tracks to the next image and back."""
    start = corners.astype(np.float32)
    if len(start) == 0:
        return 0.0
    track = partial(cv2.calcOpticalFlowPyrLK, winSize=_WINDOW, maxLevel=_N_TRACK_LEVELS)
    there, is_there, _ = track(*images, start, start.copy())
    back, is_back, _ = track(*images[::-1], there, start.copy())
    is_found = (is_there[:, 0] > 0) & (is_back[:, 0] > 0)
    is_found &= np.linalg.norm(back - start, axis=1) <= _MAX_RETURN_PX
    return float(np.mean(is_found))


def _check_torn(name: str, images: Sequence[ImageArray]) -> Finding:
    """Count the images that an interrupted transfer ends in rows of one grey value."""
    torn = np.array([n_torn_rows(image) for image in images])
    # Rectification leaves a border without pixels, the same in all images.
    limit = max(_MIN_TORN_ROWS, _MIN_TORN_SHARE * images[0].shape[0])
    n_torn = int(np.count_nonzero(torn - torn.min() > limit))
    return lost(f"{name}: torn images", n_torn, len(images), " end in rows of one value")


def n_torn_rows(image: ImageArray) -> int:
    """Count the rows of one grey value at the bottom."""
    is_varied = np.flatnonzero(np.any(image != image[-1, -1], axis=1))
    n_rows: int = image.shape[0]
    return n_rows - 1 - int(is_varied[-1]) if len(is_varied) else n_rows
