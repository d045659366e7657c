"""Lines of CSV and JSON: what they mean, and that no line brings anything but ValueError."""

import csv
import json
import os
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.edges.lines import (
    CSV_HEADER,
    LineFormat,
    Request,
    detect_format,
    format_error,
    format_estimate,
    is_header,
    parse_csv,
    parse_json,
    parse_line,
    read_lines,
)
from gvo.io.edges.pose_streams import StepSigma
from gvo.types import Estimate, PosePrior, PositionPrior, Rejected, Status

seeds = st.integers(0, 2**32 - 1)
UPPER = np.triu_indices(6)


def random_numbers(seed: int) -> tuple[np.ndarray, list[float], np.ndarray]:
    """Return a pose, its seven numbers, and a covariance."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng)
    t = rng.normal(size=3)
    A = rng.normal(size=(6, 6))
    pose = [float(v) for v in (*t, *rotation.as_quat())]
    return se3.make_transform(np.asarray(rotation.as_matrix()), t), pose, A @ A.T + np.eye(6)


def assert_same(first: Request, second: Request) -> None:
    assert str(first.frame_id) == str(second.frame_id)
    assert first.stamp_ns == second.stamp_ns
    assert len(first.edges) == len(second.edges)
    for a, b in zip(first.edges, second.edges, strict=True):
        np.testing.assert_array_equal(a.T_reference_frame, b.T_reference_frame)
        np.testing.assert_array_equal(a.covariance, b.covariance)


@given(seeds)
def test_both_formats_say_the_same(seed: int) -> None:
    T, pose, covariance = random_numbers(seed)
    upper = [float(v) for v in covariance[UPPER]]
    by_csv = parse_csv(",".join(["b", "7", "a", *map(repr, pose), *map(repr, upper)]))
    content = {"id": "b", "stamp_ns": 7, "reference": "a", "pose": pose, "covariance": upper}
    assert_same(by_csv, parse_json(json.dumps(content)))
    np.testing.assert_allclose(by_csv.edges[0].T_reference_frame, T, atol=1e-12)
    np.testing.assert_allclose(by_csv.edges[0].covariance, covariance)
    assert by_csv.edges[0].reference_id == "a"


def test_sigmas_are_standard_deviations_rotation_first() -> None:
    edge = parse_csv("b,7,a,0,0,1,0,0,0,1,0.1,0.2,0.3,1,2,3").edges[0]
    np.testing.assert_allclose(edge.covariance, np.diag([0.01, 0.04, 0.09, 1.0, 4.0, 9.0]))


def test_without_noise_an_edge_gets_that_of_its_motion() -> None:
    edge = parse_csv("b,7,a,0,0,1,0,0,0,1").edges[0]
    expected = StepSigma().covariance(edge.T_reference_frame)
    np.testing.assert_array_equal(edge.covariance, expected)


def test_an_empty_reference_is_the_world() -> None:
    request = parse_csv("b,7,,1,2,3,0,0,0,1")
    assert isinstance(request.prior, PosePrior)
    assert request.edges == ()
    position = parse_csv("b,,,1,2,3,0.1,0.2,0.3")
    assert position.stamp_ns is None
    assert isinstance(position.prior, PositionPrior)
    np.testing.assert_allclose(position.prior.covariance, np.diag([0.01, 0.04, 0.09]))
    full = parse_csv("b,,,1,2,3,1,0.5,0,1,0,1").prior
    assert isinstance(full, PositionPrior)
    assert full.covariance[0, 1] == full.covariance[1, 0] == 0.5


def test_keyframes_are_kept_and_released() -> None:
    assert parse_csv("keep,b").keep is True
    assert parse_csv("release,b").keep is False
    assert parse_json('{"id": "b", "keep": false}').keep is False
    assert parse_json('{"id": "b"}').keep is None


def test_json_may_hold_several_edges_and_a_prior() -> None:
    edge = {"reference": 1, "pose": [0, 0, 1, 0, 0, 0, 1]}
    prior = {"position": [1, 2, 3]}
    content = {"id": 3, "stamp_ns": 5, "edges": [edge, edge | {"kernel": "dcs"}], "prior": prior}
    request = parse_json(json.dumps(content))
    assert [e.kernel for e in request.edges] == [None, "dcs"]
    assert isinstance(request.prior, PositionPrior)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("a", "at least an id and a stamp"),
        (",5", "id must be a text"),
        ("a,0.5", "whole number of nanoseconds"),
        ("a,99999999999999999999", "whole number of nanoseconds"),
        ("a,5,b", "pose needs 7 numbers .*, got 0"),
        ("a,5,b,1,2", "pose needs"),
        ("a,5,b,1,2,3,0,0,0,2", "length 2"),
        ("a,5,b,1,2,3,0,0,0,nan", "length nan"),
        ("a,5,b,1,2,3,0,0,0,1,5", "six sigmas|6 sigmas"),
        ("a,5,b,x,2,3,0,0,0,1", "could not convert"),
        ("[]", "at least an id"),
        ("{", "not JSON"),
        ("{}", "id is missing"),
        ('{"id": true}', "text or a whole number"),
        ('{"id": 1, "stamp": 5}', "unknown key 'stamp'"),
        ('{"id": 1, "stamp_ns": 5.0}', "whole number of nanoseconds"),
        ('{"id": 1, "pose": [0,0,0,0,0,0,1]}', "needs a reference"),
        ('{"id": 1, "reference": 2, "pose": 5}', "list of numbers"),
        ('{"id": 1, "reference": 2, "pose": [1]}', "pose needs"),
        ('{"id": 1, "reference": 2, "pose": [0,0,0,0,0,0,1], "kernel": "l1"}', "kernel"),
        ('{"id": 1, "edges": 5}', "list of objects"),
        ('{"id": 1, "edges": [5]}', "must be an object"),
        ('{"id": 1, "prior": {}}', "a pose or a position"),
        ('{"id": 1, "prior": {"position": [1, 2]}}', "needs 3 numbers"),
        ('{"id": 1, "keep": 1}', "true or false"),
        ('{"id": 1, "keep": "yes"}', "true or false"),
    ],
)
def test_a_malformed_line_says_what_is_wrong(line: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_line(line, detect_format(line))


_json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=8)
        | st.dictionaries(
            st.sampled_from(["id", "stamp_ns", "reference", "pose", "edges", "prior", "sigmas"]),
            inner,
        )
    ),
    max_leaves=20,
)


@given(st.text() | _json_values.map(json.dumps) | st.lists(st.floats() | st.integers()).map(str))
def test_no_line_brings_anything_but_value_error(line: str) -> None:
    formats: tuple[LineFormat, ...] = ("csv", "json")
    for line_format in formats:
        try:
            parse_line(line.replace("\n", " "), line_format)
        except ValueError as error:
            assert str(error)  # noqa: PT017 - a reason is told


@given(seeds)
def test_answers_hold_the_estimate_without_loss(seed: int) -> None:
    T, pose, covariance = random_numbers(seed)
    estimate = Estimate(
        stamp_ns=17, T_world_frame=T, covariance=covariance, status=Status.OK, frame_id="b, c"
    )
    refusal = Rejected(frame_id="b, c", stamp_ns=17, reason='it is "wrong"', reference_id="a")
    by_json: dict[str, Any] = json.loads(format_estimate(estimate, "json", [refusal]))
    row = next(csv.reader([format_estimate(estimate, "csv", [refusal])]))
    assert len(row) == len(CSV_HEADER.split(","))
    assert row[:3] == ["b, c", "17", "ok"]
    assert row[-1] == by_json["rejected"][0] == str(refusal)
    numbers = [float(field) for field in row[3:-1]]
    assert numbers == by_json["pose"] + by_json["covariance"]
    np.testing.assert_array_equal(by_json["covariance"], covariance[UPPER])
    sign = np.sign(np.dot(by_json["pose"][3:], pose[3:]))
    np.testing.assert_allclose(by_json["pose"][3:], sign * np.array(pose[3:]), atol=1e-12)


def test_errors_are_json_in_one_line() -> None:
    assert json.loads(format_error("line 3:\nno")) == {"error": "line 3:\nno"}
    assert "\n" not in format_error("line 3:\nno")


def test_formats_and_headers_are_told_by_the_first_line() -> None:
    assert detect_format(' {"id": 1}') == "json"
    assert detect_format("a,1") == "csv"
    assert is_header("id,stamp_ns,reference")
    assert not is_header("a,0")


def test_lines_come_as_they_are_written_also_without_a_last_line_end() -> None:
    reader, writer = os.pipe()
    lines = read_lines(reader, lambda: None)
    os.write(writer, b"one\ntw")
    assert next(lines) == "one"
    os.write(writer, b"o\n\xff\nthree")
    assert next(lines) == "two"
    os.close(writer)
    assert list(lines) == ["\ufffd", "three"]
    os.close(reader)


def test_waiting_for_a_line_can_be_ended() -> None:
    reader, writer = os.pipe()
    n_checks = 0

    def check() -> None:
        nonlocal n_checks
        n_checks += 1
        if n_checks == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        next(read_lines(reader, check))
    os.close(reader)
    os.close(writer)
