"""What was found in the frame itself: keypoints, their disparities or depths."""

from __future__ import annotations

import numpy as np

from gvo._trace import Event
from gvo.config import Config, DepthConfig, FeaturesConfig, StereoConfig
from gvo.diagnostics.explain.values import DepthStep, KeypointStep, Sorting, StereoStep
from gvo.diagnostics.explain.watch import WatchedFrame
from gvo.frontend.features import FeatureExtractor, Features
from gvo.frontend.klt import image_of
from gvo.frontend.matching import best_ratios
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.stereo.matching import candidate_pairs
from gvo.frontend.tracking import detect_corners
from gvo.geometry.camera import StereoCamera
from gvo.types import BoolArray, DepthArray, FloatArray, ImageArray, IntArray, RgbdFrame

# A budget that no image fills.
_UNLIMITED = 20_000


def find_event(events: list[Event], name: str) -> Event | None:
    """Return the first event of a name."""
    return next((event for event in events if event.name == name), None)


def explain_keypoints(watch: WatchedFrame, config: Config) -> KeypointStep:
    """Return the keypoints within the budget, and those without one."""
    image = image_of(watch.frame)
    corners = find_event(watch.events, "klt.corners")
    if corners is not None:
        unlimited = config.klt.model_copy(update={"n_corners": _UNLIMITED})
        return KeypointStep(
            detected=detect_corners(image, unlimited),
            kept=corners.values["corners"],
            cell_size_px=config.klt.cell_size_px,
            budget=config.klt.n_corners,
        )
    features = _features(watch)
    return KeypointStep(
        detected=_detect_all(image, config.features),
        kept=features.keypoints,
        cell_size_px=config.features.cell_size_px,
        budget=config.features.n_features,
    )


def _features(watch: WatchedFrame) -> Features:
    for event in watch.events:
        if event.name == "descriptor.stereo":
            left: Features = event.values["features"][0]
            return left
        if event.name == "descriptor.depth":
            features: Features = event.values["features"]
            return features
    raise ValueError("the front-end did not tell of its keypoints")


def _detect_all(image: ImageArray, config: FeaturesConfig) -> FloatArray:
    """Detect by the threshold that filled the budget, or else by the lower one."""
    found = np.zeros((0, 2))
    for threshold in (config.fast_threshold, min(config.low_fast_threshold, config.fast_threshold)):
        unlimited = config.model_copy(
            update={
                "n_features": _UNLIMITED,
                "fast_threshold": threshold,
                "low_fast_threshold": threshold,
            }
        )
        found = FeatureExtractor(unlimited).extract(image).keypoints
        if len(found) >= config.n_features:
            break
    return found


def explain_stereo(watch: WatchedFrame, camera: StereoCamera, config: Config) -> StereoStep | None:
    """Return the stereo matches and why the others are none; None for RGB-D."""
    if isinstance(watch.frame, RgbdFrame):
        return None
    event = find_event(watch.events, "descriptor.stereo")
    if event is None:
        pixels, partners, disparities, sorting = _corners(watch, config)
    else:
        pixels, partners, disparities, sorting = _matches(event, watch, camera, config)
    return StereoStep(
        pixels=pixels,
        partners=partners,
        disparities=disparities,
        sorting=sorting,
        min_disparity_px=float(camera.depth_to_disparity(config.stereo.max_depth_m)),
        max_disparity_px=float(camera.depth_to_disparity(config.stereo.min_depth_m)),
    )


_Matches = tuple[FloatArray, FloatArray, FloatArray, Sorting]


def _corners(watch: WatchedFrame, config: Config) -> _Matches:
    """Sort the corners of `KltFrontend` by its tests."""
    final = find_event(watch.events, "klt.corners")
    searched = find_event(watch.events, "corners.searched")
    if final is None or searched is None:
        raise ValueError("the front-end did not tell of its corners")
    pixels, disparities = final.values["corners"], final.values["disparities"]
    is_placed = np.isfinite(disparities)
    sorting = Sorting.by(
        {
            "coarse correlation too weak": searched.values["is_found"],
            "patch leaves an image": is_placed,
            "no rest of the steps": searched.values["is_at_rest"],
            "left and right unlike": searched.values["are_reliable"],
            "depth out of range": final.values["is_valid"],
        },
        len(pixels),
    )
    shown = np.where(is_placed, disparities, searched.values["rough"])
    partners = np.column_stack([pixels[:, 0] - shown, pixels[:, 1] + watch.row_offset_px])
    return pixels, partners, disparities, sorting


def _matches(event: Event, watch: WatchedFrame, camera: StereoCamera, config: Config) -> _Matches:
    """Sort the keypoints of `DescriptorFrontend` by its tests."""
    left, right = event.values["features"]
    pairs, n = event.values["pairs"], len(left)
    candidates = find_event(watch.events, "stereo.candidates")
    tried = np.zeros((0, 2), np.int64) if candidates is None else candidates.values["pairs"]
    distances = np.zeros(0) if candidates is None else candidates.values["distances"]
    best = best_candidates(tried, distances, n)
    is_fitted, is_in_range = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    is_fitted[pairs[:, 0]] = event.values["is_fitted"]
    is_in_range[pairs[:, 0]] = event.values["is_in_range"]
    is_matched = have(pairs, n)
    tests = {
        "row": _have_rows(left, right, config.stereo),
        "range": have(candidate_pairs(left, right, camera, config.stereo), n),
        "octave": have(tried, n),
        **distance_tests(
            tried,
            distances,
            n,
            max_distance=config.stereo.max_distance,
            max_ratio=config.stereo.max_ratio,
        ),
        "reciprocity": is_matched,
        "sub-pixel": is_fitted,
        "depth out of range": is_in_range,
    }
    disparities = np.full(n, np.nan)
    disparities[pairs[:, 0]] = event.values["disparities"]
    partners = np.full((n, 2), np.nan)
    partners[best >= 0] = right.keypoints[best[best >= 0]]
    partners[pairs[:, 0]] = right.keypoints[pairs[:, 1]]
    measured = np.isfinite(disparities)
    partners[measured, 0] = left.keypoints[measured, 0] - disparities[measured]
    return left.keypoints, partners, disparities, Sorting.by(tests, n)


def have(pairs: IntArray, n: int) -> BoolArray:
    """Tell which of n first members are in a pair."""
    return np.asarray(np.bincount(pairs[:, 0], minlength=n) > 0)


def best_candidates(pairs: IntArray, distances: FloatArray, n: int) -> IntArray:
    """Return the second member of the best pair of each of n first members; -1 without."""
    best = np.full(n, -1, dtype=np.int64)
    worst_first = np.argsort(-distances, kind="stable")
    best[pairs[worst_first, 0]] = pairs[worst_first, 1]
    return best


def distance_tests(
    pairs: IntArray, distances: FloatArray, n: int, *, max_distance: float, max_ratio: float
) -> dict[str, BoolArray]:
    """Tell which of n first members have a candidate that is near, and one that stands out."""
    tests = {"descriptor distance": have(pairs[distances <= max_distance], n)}
    if max_ratio < 1.0:
        tests["ratio"] = best_ratios(pairs[:, 0], distances, n) <= max_ratio
    return tests


def _have_rows(left: Features, right: Features, config: StereoConfig) -> BoolArray:
    """Tell which keypoints have any in the right image on about their row."""
    if len(right) == 0:
        return np.zeros(len(left), dtype=np.bool_)
    differences = left.keypoints[:, 1:] - right.keypoints[:, 1]
    return np.asarray((np.abs(differences) <= config.row_tolerance_px).any(axis=1))


def explain_depth(watch: WatchedFrame, config: Config) -> DepthStep | None:
    """Return the depth at the keypoints and why some have none; None for stereo."""
    frame = watch.frame
    if not isinstance(frame, RgbdFrame):
        return None
    corners = find_event(watch.events, "klt.corners")
    pixels = _features(watch).keypoints if corners is None else corners.values["corners"]
    depths, is_valid = sample_depth(frame.depth, pixels, config.depth)
    height, width = frame.depth.shape
    grid = np.column_stack([axis.ravel() for axis in np.mgrid[:height, :width][::-1]])
    return DepthStep(
        pixels=pixels,
        depths=depths,
        sorting=sort_depths(depths, is_valid, config.depth),
        depth=frame.depth,
        pixel_sorting=_sort_pixels(frame.depth, grid.astype(np.float64), config.depth),
    )


def _sort_pixels(depth: DepthArray, grid: FloatArray, config: DepthConfig) -> Sorting:
    return sort_depths(*sample_depth(depth, grid, config), config)


def sort_depths(depths: FloatArray, is_valid: BoolArray, config: DepthConfig) -> Sorting:
    """Sort what `sample_depth` gave by its tests."""
    return Sorting.by(depth_tests(depths, is_valid, config), len(depths))


def depth_tests(
    depths: FloatArray, is_valid: BoolArray, config: DepthConfig
) -> dict[str, BoolArray]:
    """Tell which depths pass each of the tests of `sample_depth`."""
    with np.errstate(invalid="ignore"):
        is_in_range = (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
    return {
        "depth unknown": np.isfinite(depths),
        "depth out of range": is_in_range,
        "depth edge": is_valid,
    }
