"""Keypoints: budget, spread, border, descriptors, order of preference."""

from typing import Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.config import FeaturesConfig
from gvo.frontend.features import (
    FeatureExtractor,
    Features,
    PlaceIndex,
    choose_spread,
    describe_pixels,
)
from gvo.frontend.matching import descriptor_distances
from gvo.types import ImageArray

Kind = Literal["orb", "sift", "fast", "gftt"]
KINDS: list[Kind] = ["orb", "sift", "fast", "gftt"]


def blobs(seed: int = 0, n: int = 500, size: tuple[int, int] = (240, 320)) -> ImageArray:
    """Draw grey discs, smoothed a little, on a grey ground."""
    rng = np.random.default_rng(seed)
    image = np.full(size, 120, dtype=np.uint8)
    for u, v, radius, grey in zip(
        rng.integers(0, size[1], n),
        rng.integers(0, size[0], n),
        rng.integers(2, 9, n),
        rng.integers(0, 256, n),
        strict=True,
    ):
        cv2.circle(image, (int(u), int(v)), int(radius), int(grey), -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def extract(image: ImageArray, kind: Kind = "orb", **changes: object) -> Features:
    values = {"kind": kind, "n_features": 200, "n_octaves": 1, "cell_size_px": 40} | changes
    return FeatureExtractor(FeaturesConfig.model_validate(values)).extract(image)


@pytest.mark.parametrize("kind", KINDS)
def test_keypoints_keep_to_the_budget_and_inside_the_image(kind: Kind) -> None:
    features = extract(blobs(), kind)
    assert 195 <= len(features) <= 200
    assert len(features.keypoints) == len(features.octaves) == len(features.descriptors)
    assert features.keypoints.min() >= 0
    assert np.all(features.keypoints <= [319, 239])
    if kind == "sift":
        assert features.descriptors.dtype == np.float32
        assert features.descriptors.shape[1] == 128
    else:
        assert features.descriptors.dtype == np.uint8
        assert features.descriptors.shape[1] == 32


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_without_texture_gives_no_features(kind: Kind) -> None:
    features = extract(np.full((240, 320), 90, dtype=np.uint8), kind)
    assert len(features) == 0
    assert features.keypoints.shape == (0, 2)
    assert features.octaves.shape == (0,)
    assert features.descriptors.shape == ((0, 128) if kind == "sift" else (0, 32))
    assert features.descriptors.dtype == (np.float32 if kind == "sift" else np.uint8)


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_too_small_for_a_descriptor_gives_no_error(kind: Kind) -> None:
    assert len(extract(blobs(size=(20, 24)), kind)) < 200


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_image_gives_the_same_features(kind: Kind) -> None:
    extractor = FeatureExtractor(FeaturesConfig(kind=kind, n_features=200))
    first = extractor.extract(blobs(0))
    extractor.extract(blobs(1))
    again = extractor.extract(blobs(0))
    assert first.keypoints.tobytes() == again.keypoints.tobytes()
    assert first.descriptors.tobytes() == again.descriptors.tobytes()


def test_a_crowded_corner_does_not_take_the_whole_budget() -> None:
    image = np.full((240, 320), 120, dtype=np.uint8)
    image[:80, :80] = blobs(0, 200, (80, 80))
    # The rest of the image is fainter by half.
    image[80:, 80:] = (120 + (blobs(1, 150)[80:, 80:].astype(float) - 120) / 2).astype(np.uint8)
    features = extract(image, "fast", n_features=100)
    assert len(features) == 100
    in_rest = np.all(features.keypoints >= 80, axis=1)
    assert in_rest.mean() > 0.5  # by strength alone: a fifth


def test_cells_of_a_very_wide_image_are_told_apart() -> None:
    # A million cells: these two would share their number, counted in sixteen bits.
    pixels = np.array([[4, 4], [4, 8 * 128 + 4]])
    chosen = choose_spread(pixels, np.array([2.0, 1.0]), cell_size_px=8, n_chosen=2)
    weak = np.vstack([pixels[:1] + 1, pixels])
    alone = choose_spread(weak, np.array([1.5, 2.0, 1.0]), cell_size_px=8, n_chosen=2)
    assert (chosen.tolist(), alone.tolist()) == ([0, 1], [1, 2])


def test_faint_images_are_tried_with_the_low_threshold() -> None:
    faint = (120 + (blobs().astype(float) - 120) / 10).astype(np.uint8)
    for kind in KINDS[::2]:
        assert len(extract(faint, kind, fast_threshold=40)) > 20


@pytest.mark.parametrize("kind", ["orb", "fast", "gftt"])
def test_upright_descriptors_do_not_depend_on_detected_angles(kind: Kind) -> None:
    image = blobs()
    features = extract(image, kind, upright=True)
    orb = cv2.ORB_create(nlevels=1, edgeThreshold=19)  # type: ignore[attr-defined]
    points = [
        cv2.KeyPoint(float(u), float(v), 31.0, 0.0, 0.0, 0) for u, v in features.keypoints[:20]
    ]
    found, expected = orb.compute(image, points)
    assert len(found) == 20
    np.testing.assert_array_equal(features.descriptors[:20], expected)


def test_turned_images_are_described_alike_without_upright() -> None:
    image = blobs(size=(240, 240))
    turned = np.ascontiguousarray(np.rot90(image))
    for upright in (False, True):
        first = extract(image, upright=upright)
        second = extract(turned, upright=upright)
        # rot90 maps (u, v) to (v, 239 - u).
        places = np.stack([first.keypoints[:, 1], 239 - first.keypoints[:, 0]], axis=1)
        gaps = np.linalg.norm(places[:, None] - second.keypoints[None], axis=2)
        i, j = np.nonzero(gaps < 0.5)
        pairs = np.stack([i, j], axis=1)
        distances = descriptor_distances(first.descriptors, second.descriptors, pairs)
        assert len(distances) > 50
        assert (np.median(distances) > 0.3) == upright


@pytest.mark.parametrize("kind", KINDS)
def test_octaves_count_from_the_finest_level(kind: Kind) -> None:
    octaves = extract(blobs(), kind, n_octaves=4, scale_factor=1.3).octaves
    assert octaves.min() >= -1
    assert octaves.max() < 10


def flipped(descriptors: NDArray[np.uint8], n_bits: int, seed: int) -> NDArray[np.uint8]:
    """Change so many bits of each descriptor."""
    rng = np.random.default_rng(seed)
    bits = np.unpackbits(descriptors, axis=1)
    for row in bits:
        row[rng.choice(len(row), n_bits, replace=False)] ^= 1
    return np.packbits(bits, axis=1)


def made_up(seed: int, n: int = 200) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (n, 32), dtype=np.uint8)


def test_a_place_is_found_among_others_by_what_is_left_of_its_descriptors() -> None:
    index = PlaceIndex()
    for seed in range(60):
        index.add(made_up(seed))
    assert len(index) == 60
    # A third of the points is seen again, an eighth of their bits has changed.
    seen = np.concatenate([flipped(made_up(17)[:66], 32, 0), made_up(1000, 134)])
    scores = index.scores(seen)
    assert scores.shape == (60,)
    assert scores.argmax() == 17
    assert scores[17] > 3.0 * np.delete(scores, 17).max()
    assert index.scores(made_up(17))[17] == pytest.approx(1.0)


def test_what_all_places_show_tells_none_of_them() -> None:
    index, common = PlaceIndex(), made_up(0, 100)
    for seed in range(40):
        index.add(np.concatenate([common, made_up(seed + 1, 100)]))
    scores = index.scores(np.concatenate([common, made_up(5, 100)]))
    assert scores.argmax() == 4
    assert np.delete(scores, 4).max() < 0.1


def test_a_view_without_points_and_an_empty_index_have_no_scores() -> None:
    index, nothing = PlaceIndex(), np.zeros((0, 32), dtype=np.uint8)
    assert index.scores(made_up(0)).shape == (0,)
    index.add(nothing)
    index.add(made_up(0))
    assert index.scores(nothing).tolist() == [0.0, 0.0]
    assert index.scores(made_up(0)).tolist() == pytest.approx([0.0, 1.0])


def test_places_of_sift_are_found_too() -> None:
    index = PlaceIndex()
    images = [blobs(seed) for seed in range(12)]
    for image in images:
        index.add(extract(image, "sift").descriptors)
    noise = np.random.default_rng(0).normal(0.0, 2.0, images[3].shape)
    again = np.clip(images[3] + noise, 0, 255).astype(np.uint8)
    assert index.scores(extract(again, "sift").descriptors).argmax() == 3


def test_pixels_are_described_alike_when_the_image_is_turned_or_enlarged() -> None:
    image, pixels = blobs(), np.array([[100.0, 100.0], [160.5, 120.0], [2.0, 100.0]])
    first = describe_pixels(image, pixels)
    assert first.shape == (3, 32)
    height, width = image.shape
    turned = np.ascontiguousarray(np.rot90(image, -1))
    again = describe_pixels(turned, np.column_stack([height - 1 - pixels[:, 1], pixels[:, 0]]))
    large = np.asarray(cv2.resize(image, (2 * width, 2 * height)), dtype=np.uint8)
    wide = describe_pixels(large, 2.0 * pixels + 0.5, 2.0)
    for other in (again, wide):
        assert np.bitwise_count(first[:2] ^ other[:2]).sum(axis=1).max() < 64
        assert np.bitwise_count(first[0] ^ other[1]).sum() > 80


def test_nothing_has_no_descriptors() -> None:
    assert describe_pixels(blobs(), np.zeros((0, 2))).shape == (0, 32)
