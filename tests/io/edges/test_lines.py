"""JSON lines: what they mean, and that no line brings anything but ValueError."""

import json
import os
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.edges.lines import Request, format_estimate, parse_line, read_lines
from gvo.types import Edge, Estimate, PosePrior, PositionPrior, Rejected, Status

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


def parsed(**content: object) -> Request:
    return parse_line(json.dumps({"id": "b", "stamp_ns": 7, **content}))


def edge_of(**noise: object) -> Edge:
    (edge,) = parsed(reference="a", pose=[0, 0, 1, 0, 0, 0, 1], **noise).edges
    return edge


@given(seeds)
def test_an_edge_holds_the_numbers_of_the_line(seed: int) -> None:
    T, pose, covariance = random_numbers(seed)
    upper = [float(v) for v in covariance[UPPER]]
    request = parsed(reference="a", pose=pose, covariance=upper)
    assert (request.frame_id, request.stamp_ns) == ("b", 7)
    assert request.edges[0].reference_id == "a"
    np.testing.assert_allclose(request.edges[0].T_reference_frame, T, atol=1e-12)
    np.testing.assert_allclose(request.edges[0].covariance, covariance)


def test_sigmas_are_standard_deviations_rotation_first() -> None:
    edge = edge_of(sigmas=[0.1, 0.2, 0.3, 1, 2, 3])
    np.testing.assert_allclose(edge.covariance, np.diag([0.01, 0.04, 0.09, 1.0, 4.0, 9.0]))


def test_a_prior_is_a_pose_or_a_position_in_the_world() -> None:
    pose = parsed(prior={"pose": [1, 2, 3, 0, 0, 0, 1]}).prior
    assert isinstance(pose, PosePrior)
    np.testing.assert_allclose(pose.covariance, np.diag([1e-4] * 3 + [1e-2] * 3))
    position = parsed(prior={"position": [1, 2, 3], "covariance": [1, 0.5, 0, 1, 0, 1]}).prior
    assert isinstance(position, PositionPrior)
    assert position.covariance[0, 1] == position.covariance[1, 0] == 0.5


def test_json_may_hold_several_edges_and_a_prior() -> None:
    edge = {"reference": 1, "pose": [0, 0, 1, 0, 0, 0, 1]}
    prior = {"position": [1, 2, 3]}
    content = {"id": 3, "stamp_ns": 5, "edges": [edge, edge | {"kernel": "dcs"}], "prior": prior}
    request = parse_line(json.dumps(content))
    assert [e.kernel for e in request.edges] == [None, "dcs"]
    assert isinstance(request.prior, PositionPrior)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("nonsense", "not JSON"),
        ("[]", "must be an object"),
        ('{"id": "", "stamp_ns": 5}', "id must be a text"),
        ('{"id": 1, "stamp_ns": 99999999999999999999}', "whole number of nanoseconds"),
        ('{"id": 1, "reference": 2, "pose": [1,2,3,0,0,0,2]}', "length 2"),
        ('{"id": 1, "reference": 2, "pose": [1,2,3,0,0,0,NaN]}', "length nan"),
        ('{"id": 1, "reference": 2, "pose": [0,0,0,0,0,0,1], "sigmas": [1]}', "needs 6 numbers"),
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
        parse_line(line)


@given(seeds)
def test_answers_hold_the_estimate_without_loss(seed: int) -> None:
    T, pose, covariance = random_numbers(seed)
    estimate = Estimate(
        stamp_ns=17, T_world_frame=T, covariance=covariance, status=Status.OK, frame_id="b, c"
    )
    refusal = Rejected(frame_id="b, c", stamp_ns=17, reason='it is "wrong"', reference_id="a")
    by_json: dict[str, Any] = json.loads(format_estimate(estimate, [refusal]))
    assert [by_json[key] for key in ("id", "stamp_ns", "status")] == ["b, c", 17, "ok"]
    assert by_json["rejected"] == [str(refusal)]
    np.testing.assert_array_equal(by_json["covariance"], covariance[UPPER])
    sign = np.sign(np.dot(by_json["pose"][3:], pose[3:]))
    np.testing.assert_allclose(by_json["pose"][3:], sign * np.array(pose[3:]), atol=1e-12)


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
