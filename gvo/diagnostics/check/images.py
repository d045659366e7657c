"""Images: exposure, blur, texture, and frames that cannot be used."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding, unknown
from gvo.diagnostics.check.limits import MAX_BLUR_PX, lost, measured
from gvo.diagnostics.check.sampling import Sample
from gvo.frontend.tracking import detect_corners
from gvo.types import (
    BoolArray,
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
_MAX_RETURN_PX = 0.5
_WINDOW = (15, 15)
_N_TRACK_LEVELS = 4
# Share and number of last rows of one value that make an image torn.
_MIN_TORN_SHARE = 0.05
_MIN_TORN_ROWS = 4


def check_usable(samples: Sequence[Sample]) -> Iterator[Finding]:
    """Yield the share of the sampled frames that odometry cannot use, with the first reason."""
    frames = [frame for sample in samples for frame in (sample.first, sample.second)]
    looked_at = [frame for frame in frames if frame is not None]
    faulty = [frame for frame in looked_at if isinstance(frame, FaultyFrame)]
    if not looked_at:
        yield unknown("frames that cannot be used", "no frame to look at")
        return
    fix = faulty[0].reason if faulty else ""
    yield lost("frames that cannot be used", len(faulty), len(looked_at), fix)


def check_images(samples: Sequence[Sample], config: Config) -> Iterator[Finding]:
    """Yield the findings on the grey images of the samples, of both cameras of a stereo pair."""
    usable = [sample for sample in samples if not isinstance(sample.first, FaultyFrame)]
    if not usable:
        return
    is_stereo = isinstance(usable[0].first, StereoFrame)
    for index, name in enumerate(("left", "right") if is_stereo else ("colour",)):
        images = [_grey_images(sample.first)[index] for sample in usable]
        pairs = [
            (_grey_images(sample.first)[index], _grey_images(sample.second)[index])
            for sample in usable
            if sample.second is not None and not isinstance(sample.second, FaultyFrame)
        ]
        yield from _check_exposure(name, images)
        yield from _check_sharpness(name, images)
        yield from _check_texture(name, images, pairs, config)
        yield from _check_transfer(name, images, pairs)
    if is_stereo:
        yield _compare_exposures([_grey_images(sample.first) for sample in usable])


def blur_sigma_px(image: ImageArray) -> float:
    """Estimate the blur of an image: sigma of a Gaussian, pixels.

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


def followed_share(first: ImageArray, second: ImageArray, corners: FloatArray) -> float:
    """Return the share of corners that Lucas-Kanade tracks to the next image and back."""
    if len(corners) == 0:
        return 0.0
    start = corners.astype(np.float32)
    _, is_followed = follow(first, second, start, start, _MAX_RETURN_PX, maxLevel=_N_TRACK_LEVELS)
    return float(np.mean(is_followed))


def follow(
    first: ImageArray,
    second: ImageArray,
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    max_return_px: float,
    **options: Any,  # noqa: ANN401 - of cv2.calcOpticalFlowPyrLK
) -> tuple[NDArray[np.float32], BoolArray]:
    """Track pixels by Lucas-Kanade; tell which are found, and again on the way back."""
    track = partial(cv2.calcOpticalFlowPyrLK, winSize=_WINDOW, **options)
    there, is_there, _ = track(first, second, start, guess.copy())
    back, is_back, _ = track(second, first, there, start.copy())
    is_found = (is_there[:, 0] > 0) & (is_back[:, 0] > 0)
    is_found &= np.linalg.norm(back - start, axis=1) <= max_return_px
    return np.asarray(there), is_found


def n_torn_rows(image: ImageArray) -> int:
    """Count the rows of one grey value at the bottom, as an interrupted transfer leaves them."""
    is_varied = np.flatnonzero(np.any(image != image[-1, -1], axis=1))
    n_rows: int = image.shape[0]
    return n_rows - 1 - int(is_varied[-1]) if len(is_varied) else n_rows


def check_frozen(name: str, pairs: Sequence[tuple[ImageArray | DepthArray, ...]]) -> Finding:
    """Count the images that equal the one before."""
    n_frozen = sum(np.array_equal(before, now, equal_nan=True) for before, now in pairs)
    fix = f"the driver repeats {name} images: record at the camera's own rate"
    how = " are the same as the one before"
    return lost(f"{name}: frozen images", n_frozen, len(pairs), fix, how)


def _check_exposure(name: str, images: Sequence[ImageArray]) -> Iterator[Finding]:
    brightness = float(np.median([image.mean() for image in images]))
    yield measured("brightness", brightness, stream=name)
    black = float(np.median([np.mean(image <= _BLACK) for image in images]))
    white = float(np.median([np.mean(image >= _WHITE) for image in images]))
    yield measured(
        "clipped pixels",
        max(black, white),
        stream=name,
        text=f"{black:.1%} black, {white:.1%} white",
        fix=f"{'longer' if black > white else 'shorter'} exposure: clipped pixels hold no corners",
    )


def _check_sharpness(name: str, images: Sequence[ImageArray]) -> Iterator[Finding]:
    blurs = np.array([blur_sigma_px(image) for image in images])
    known = blurs[np.isfinite(blurs)]
    if len(known) == 0:
        yield unknown(f"{name}: blur", "no edges")
        return
    share = float(np.mean(known > MAX_BLUR_PX))
    yield measured(
        "blur",
        float(np.median(known)),
        stream=name,
        text=f"{np.median(known):.2f} px, {share:.0%} of frames above",
    )


def _check_texture(
    name: str, images: Sequence[ImageArray], pairs: Sequence[tuple[ImageArray, ...]], config: Config
) -> Iterator[Finding]:
    counts = [len(detect_corners(image, config.klt.n_corners)) for image in images]
    yield measured(
        "corners",
        float(np.median(counts)),
        stream=name,
        fault_low=config.ransac.min_inliers,
        text=f"{np.median(counts):.0f} median, {min(counts)} least of {config.klt.n_corners}",
    )
    if not pairs:
        yield unknown(f"{name}: corners found again", "no two consecutive frames")
        return
    shares = [
        followed_share(first, second, detect_corners(first, config.klt.n_corners))
        for first, second in pairs
    ]
    yield measured(
        "corners found again",
        float(np.median(shares)),
        stream=name,
        text=f"{np.median(shares):.0%} in the next frame",
    )


def _check_transfer(
    name: str, images: Sequence[ImageArray], pairs: Sequence[tuple[ImageArray, ...]]
) -> Iterator[Finding]:
    if pairs:
        yield check_frozen(name, pairs)
    torn = np.array([n_torn_rows(image) for image in images])
    # Rectification leaves a border without pixels, the same in all images.
    limit = max(_MIN_TORN_ROWS, _MIN_TORN_SHARE * images[0].shape[0])
    n_torn = int(np.count_nonzero(torn - torn.min() > limit))
    fix = "transfers break off: lower rate or size, another cable or port"
    how = " end in rows of one value"
    yield lost(f"{name}: torn images", n_torn, len(images), fix, how)


def _compare_exposures(pairs: Sequence[tuple[ImageArray, ...]]) -> Finding:
    ratios = [(left.mean() + 1.0) / (right.mean() + 1.0) for left, right in pairs]
    ratio = float(np.median(ratios))
    return measured("brightness ratio", ratio, stream="left/right")


def _gradients(image: ImageArray, sigma_px: float) -> FloatArray:
    """Return the size of the gradient of a smoothed image."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px)
    along_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3)
    along_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    return np.asarray(cv2.magnitude(along_u, along_v))


def _grey_images(frame: Frame | FaultyFrame | None) -> tuple[ImageArray, ...]:
    if isinstance(frame, StereoFrame):
        return (frame.left, frame.right)
    return (frame.image,) if isinstance(frame, RgbdFrame) else ()
