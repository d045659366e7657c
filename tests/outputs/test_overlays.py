"""Matches drawn over images."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.outputs.image_files import encode_jpeg
from gvo.outputs.overlays import INLIER_COLOUR, OUTLIER_COLOUR, draw_matches

_GREY = np.random.default_rng(0).integers(60, 120, (80, 120), dtype=np.uint8)
_pixels = st.tuples(st.floats(-30, 150), st.floats(-30, 110))
_matches = st.lists(st.tuples(_pixels, _pixels, st.booleans()), max_size=6)


def _draw(matches: list[tuple[tuple[float, float], tuple[float, float], bool]]) -> np.ndarray:
    return draw_matches(
        _GREY,
        np.array([m[0] for m in matches], dtype=np.float64).reshape(-1, 2),
        np.array([m[1] for m in matches], dtype=np.float64).reshape(-1, 2),
        np.array([m[2] for m in matches], dtype=np.bool_),
    )


def _plain() -> np.ndarray:
    return np.repeat(_GREY[:, :, np.newaxis], 3, axis=2)


@pytest.mark.parametrize(
    ("is_inlier", "colour"), [(True, INLIER_COLOUR), (False, OUTLIER_COLOUR)], ids=["in", "out"]
)
def test_a_match_is_drawn_in_its_colour_from_where_it_was_to_where_it_is(
    is_inlier: bool, colour: tuple[int, ...]
) -> None:
    picture = _draw([((20.0, 30.0), (60.0, 30.0), is_inlier)])
    # Edges are softened: the image shines through a little.
    np.testing.assert_allclose(picture[30, [24, 40, 60]], [colour] * 3, atol=16)
    changed_rows, changed_columns = np.nonzero((picture != _plain()).any(axis=2))
    assert (changed_columns.min(), changed_columns.max()) <= (20, 66)
    assert changed_columns.min() >= 18
    # The mark is at the end, where the point is now.
    assert np.ptp(changed_rows[changed_columns < 50]) < np.ptp(changed_rows[changed_columns > 50])


@settings(deadline=None)
@given(matches=_matches)
def test_nothing_is_drawn_away_from_the_matches(
    matches: list[tuple[tuple[float, float], tuple[float, float], bool]],
) -> None:
    picture = _draw(matches)
    changed = np.argwhere((picture != _plain()).any(axis=2))[:, ::-1]
    distances = [np.full(len(changed), np.inf)]
    for start, end, _ in matches:
        along = np.linspace(start, end, 300)
        distances.append(np.linalg.norm(changed[:, np.newaxis] - along, axis=2).min(axis=1))
    assert (np.min(distances, axis=0) < 7).all()


def test_matches_without_a_place_are_left_out_and_far_ones_do_no_harm() -> None:
    sound = ((20.0, 30.0), (60.0, 35.0), True)
    broken = [((np.nan, 1.0), (5.0, 5.0), True), ((5.0, 5.0), (np.inf, 5.0), False)]
    far = [((1e9, -1e9), (1.1e9, -1e9), True)]
    np.testing.assert_array_equal(_draw([sound, *broken, *far]), _draw([sound]))


def test_the_image_is_left_as_it_was_and_shown_where_nothing_matches() -> None:
    before = _GREY.copy()
    np.testing.assert_array_equal(_draw([]), _plain())
    _draw([((20.0, 30.0), (60.0, 35.0), False)])
    np.testing.assert_array_equal(_GREY, before)


def test_text_stands_in_the_upper_left_corner() -> None:
    nothing = np.zeros((0, 2))
    picture = draw_matches(
        _GREY,
        nothing,
        nothing,
        np.zeros(0, dtype=np.bool_),
        lines=["ok: 1", "\N{GREEK SMALL LETTER TAU}"],
    )
    assert picture[:40, :50].max() > 200
    np.testing.assert_array_equal(picture[45:], _plain()[45:])


def test_a_coloured_image_and_unequal_counts_are_refused() -> None:
    pixels, inliers = np.zeros((2, 2)), np.zeros(2, dtype=np.bool_)
    with pytest.raises(ValueError, match="grey image and 2 matches"):
        draw_matches(_plain(), pixels, pixels, inliers)
    with pytest.raises(ValueError, match="grey image and 2 matches"):
        draw_matches(_GREY, pixels, pixels[:1], inliers)


def test_a_jpeg_shows_the_picture() -> None:
    smooth = cv2.GaussianBlur(_draw([((20.0, 30.0), (60.0, 35.0), True)]), (0, 0), 3)
    data = encode_jpeg(np.asarray(smooth, dtype=np.uint8))
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    np.testing.assert_allclose(decoded.astype(float), smooth.astype(float), atol=12)
