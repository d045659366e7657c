"""Matches drawn over images."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import FaultyFrame, FrameResult, RelativePose, RgbdFrame, Status, StereoFrame
from gvo.viz.overlay import (
    FOOTER_PX,
    HEADER_PX,
    INLIER_COLOUR,
    OUTLIER_COLOUR,
    DepthScale,
    compose_faulty,
    compose_overlay,
    draw_matches,
    table,
)
from tests.make.results import estimate_at, result_of

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


@given(matches=_matches)
def test_nothing_is_drawn_away_from_the_matches(
    matches: list[tuple[tuple[float, float], tuple[float, float], bool]],
) -> None:
    changed = np.argwhere((_draw(matches) != _plain()).any(axis=2))[:, ::-1]
    distances = [np.full(len(changed), np.inf)]
    for start, end, _ in matches:
        along = np.linspace(start, end, 300)
        distances.append(np.linalg.norm(changed[:, np.newaxis] - along, axis=2).min(axis=1))
    assert (np.min(distances, axis=0) < 7).all()


def test_matches_without_a_place_are_left_out_and_far_ones_do_no_harm() -> None:
    sound = ((20.0, 30.0), (60.0, 35.0), True)
    broken = [((np.nan, 1.0), (5.0, 5.0), True), ((5.0, 5.0), (np.inf, 5.0), False)]
    far = [((1e9, -1e9), (1.1e9, -1e9), True)]
    before = _GREY.copy()
    np.testing.assert_array_equal(_draw([sound, *broken, *far]), _draw([sound]))
    np.testing.assert_array_equal(_GREY, before)


_STEREO = StereoCamera(fx=600, fy=600, cx=320, cy=120, width=640, height=240, baseline=0.5)
_RGBD = PinholeCamera(fx=500, fy=500, cx=320, cy=240, width=640, height=480)


def _result(
    pixels: list[tuple[float, float]], depths_m: list[float], *, status: Status = Status.OK
) -> FrameResult:
    """Return what a frame gave whose points did not move in the image; all are inliers."""
    points = np.zeros((len(depths_m), 3))
    points[:, 2] = depths_m
    registration = RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        matches=np.zeros((len(pixels), 2), dtype=np.int64),
        inliers=np.ones(len(pixels), dtype=np.bool_),
        pixels_reference=np.array(pixels).reshape(-1, 2),
        pixels_current=np.array(pixels).reshape(-1, 2),
        points_current=points,
    )
    return result_of(
        estimate_at(10**18),
        status=status,
        n_matches=len(pixels),
        n_inliers=len(pixels),
        registration=registration,
        stage_ms={"read": 4.0, "window": 1.0},
    )


def _pair() -> StereoFrame:
    black = np.zeros((240, 640), dtype=np.uint8)
    return StereoFrame(stamp_ns=10**18, left=black, right=black)


def _is_coloured(picture: np.ndarray) -> np.ndarray:
    return np.asarray(np.ptp(picture.astype(int), axis=2) > 20)


def test_the_disparity_is_drawn_from_the_left_to_the_right_image_in_the_colour_of_depth() -> None:
    # 600 px * 0.5 m / 5 m = 60 px
    picture = compose_overlay(_pair(), _result([(400.0, 120.0)], [5.0]), _STEREO)
    stereo = picture[HEADER_PX + 240 : HEADER_PX + 480]
    rows, columns = np.nonzero(_is_coloured(stereo))
    assert (abs(rows - 120) <= 2).all()
    assert (columns.min(), columns.max()) == pytest.approx((340, 402), abs=1)
    scale = DepthScale.of(_STEREO)
    expected = table()[scale.levels(np.array([5.0]))][0]
    np.testing.assert_array_equal(stereo[120, 400], expected)
    np.testing.assert_allclose(stereo[120, 370].astype(int), expected, atol=24)


@pytest.mark.parametrize("max_width", [640, 1280])
def test_all_pictures_of_a_camera_have_one_even_size(max_width: int) -> None:
    faulty = FaultyFrame(stamp_ns=1, reason="image_0/000001.png: " + "cannot be read, " * 40)
    for camera in (_STEREO, _RGBD):
        shape = compose_faulty(faulty, camera, max_width=max_width).shape
        assert shape[0] % 2 == shape[1] % 2 == 0
        assert 640 <= shape[1] <= max_width
        depth = np.full((camera.height, camera.width), np.nan, dtype=np.float32)
        image = np.zeros(depth.shape, dtype=np.uint8)
        frame = RgbdFrame(stamp_ns=1, image=image, depth=depth)
        seen = _pair() if camera is _STEREO else frame
        for result in (_result([], []), _result([(1.0, 1.0)], [2.0])):
            assert compose_overlay(seen, result, camera, max_width=max_width).shape == shape


def test_depth_has_the_colours_of_the_bar_and_what_is_unknown_is_dark() -> None:
    depth = np.full((480, 640), 2.0, dtype=np.float32)
    depth[:, :320] = np.nan
    depth[240:, 320:] = 0.5
    frame = RgbdFrame(stamp_ns=1, image=np.zeros((480, 640), dtype=np.uint8), depth=depth)
    picture = compose_overlay(frame, _result([(600.0, 60.0)], [2.0]), _RGBD, max_width=1280)
    panel = picture[HEADER_PX : HEADER_PX + 480, 640:]
    assert panel[300, 100].max() < 32
    middle = picture[-FOOTER_PX + 6, 640:]
    far, near = panel[120, 500], panel[400, 500]
    places = [int(np.flatnonzero((middle == colour).all(axis=1))[0]) for colour in (near, far)]
    # the bar is logarithmic from 0.4 m to 8 m
    left, right = np.flatnonzero(_is_coloured(middle[np.newaxis])[0])[[0, -1]]
    shares = (np.array(places) - left) / (right - left)
    np.testing.assert_allclose(shares, np.log([0.5 / 0.4, 2.0 / 0.4]) / np.log(20.0), atol=0.02)
    np.testing.assert_array_equal(panel[60, 600], (255, 255, 255))
