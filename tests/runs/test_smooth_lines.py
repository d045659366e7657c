"""A stream of lines: one answer to each, whatever they hold, and a folder at the end."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvo
from gvo.errors import RecordingError
from gvo.runs.result import RunResult
from gvo.runs.smooth import smooth_lines


def run(lines: list[str], out: Path) -> tuple[RunResult, list[str]]:
    answers: list[str] = []
    return smooth_lines(iter(lines), answers.append, out, force=True), answers


def request(n: int, *references: int, **more: object) -> str:
    """Return a line of a pose n metres along z, measured from others."""
    edges = [{"reference": r, "pose": [0, 0, n - r, 0, 0, 0, 1]} for r in references]
    return json.dumps({"id": n, "stamp_ns": n * 10**8, "edges": edges, **more})


def test_each_line_is_answered_by_the_causal_estimate(tmp_path: Path) -> None:
    result, answers = run([request(0), *(request(n, n - 1) for n in range(1, 9))], tmp_path)
    assert result.is_complete
    replies = [json.loads(answer) for answer in answers]
    assert [reply["id"] for reply in replies] == list(range(9))
    causal = gvo.read_trajectory(tmp_path / "causal.txt")
    for reply, stamp_ns, T in zip(replies, causal.stamps_ns, causal.T_world_frame, strict=True):
        assert reply["stamp_ns"] == stamp_ns
        np.testing.assert_allclose(reply["pose"][:3], T[:3, 3], atol=1e-8)
        assert reply["status"] == "ok"
        assert reply["rejected"] == []
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 9


def test_a_malformed_line_is_answered_and_the_stream_goes_on(tmp_path: Path) -> None:
    lines = [request(0), "nonsense", request(1, 0), request(1, 0, stamp_ns=5), request(2, 1)]
    lines += [request(0, 1, stamp_ns=10**8 - 5), json.dumps({"id": "new", "keep": True})]
    result, answers = run(lines, tmp_path)
    assert not result.is_complete
    errors = {n: json.loads(a)["error"] for n, a in enumerate(answers) if "error" in json.loads(a)}
    assert set(errors) == {1, 3, 5, 6}
    assert errors[1].startswith("line 2: not JSON")
    assert "in the window with the stamp 100000000" in errors[3]
    assert "needs a stamp" in errors[6]
    assert result.summary["frames"] == 3
    assert "4 lines were not understood" in "\n".join(result.warnings)


def test_a_known_pose_takes_more_edges_and_priors(tmp_path: Path) -> None:
    prior = {"position": [0, 0, 2.5], "sigmas": [1e-3] * 3}
    more = [{"id": 2, "prior": prior}, {"id": 2, "reference": 0, "pose": [0, 0, 2.5, 0, 0, 0, 1]}]
    lines = [request(0), request(1, 0), request(2, 1), *map(json.dumps, more)]
    result, answers = run(lines, tmp_path)
    z = [json.loads(answer)["pose"][2] for answer in answers]
    assert z[2] == pytest.approx(2.0)
    assert 2.3 < z[3] < 2.5
    assert result.summary["window"]["n_priors"] == 1
    assert result.summary["window"]["n_edges"] == 3
    assert result.summary["frames"] == 3


def test_kept_poses_can_be_referred_to_until_they_are_released(tmp_path: Path) -> None:
    lines = [request(0, keep=True), *(request(n, n - 1) for n in range(1, 30))]
    lines += [request(30, 29, 0), json.dumps({"id": 0, "keep": False})]
    lines += [request(n, n - 1) for n in range(31, 40)] + [request(40, 39, 0)]
    answers: list[str] = []
    smooth_lines(iter(lines), answers.append, tmp_path, keyframes="manual")
    assert json.loads(answers[30])["rejected"] == []
    assert len(json.loads(answers[-1])["rejected"]) == 1


def test_the_end_of_the_reader_ends_the_stream(tmp_path: Path) -> None:
    def answer(line: str) -> None:
        if json.loads(line)["id"] == 3:
            raise BrokenPipeError

    lines = [request(0), *(request(n, n - 1) for n in range(1, 9))]
    assert not smooth_lines(iter(lines), answer, tmp_path).is_complete
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 4


def test_a_stream_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="standard input: nothing to smooth"):
        run(["nonsense", ""], tmp_path / "out")
    assert not (tmp_path / "out").exists()


_numbers = st.integers(-3, 3) | st.floats(-5, 5) | st.just(float("nan")) | st.just(1e300)
_edges = st.fixed_dictionaries(
    {
        "reference": st.integers(0, 6),
        "pose": st.tuples(*[_numbers] * 3).map(lambda t: [*t, 0, 0, 0, 1]),
    },
    optional={"sigmas": st.lists(_numbers, min_size=6, max_size=6)},
)
_requests = st.fixed_dictionaries(
    {"id": st.integers(0, 6)},
    optional={
        "stamp_ns": st.integers(0, 10).map(lambda n: n * 10**8),
        "edges": st.lists(_edges, max_size=3),
        "prior": st.fixed_dictionaries({"position": st.tuples(*[_numbers] * 3).map(list)}),
        "keep": st.booleans(),
    },
)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    max_examples=settings().max_examples // 8,  # a run each
)
@given(st.lists(_requests.map(json.dumps) | st.text(max_size=5), max_size=12))
def test_any_stream_is_answered_by_line_in_finite_numbers(tmp_path: Path, lines: list[str]) -> None:
    lines = [request(50), *(line for line in lines if line.strip() and "\n" not in line)]
    result, answers = run(lines, tmp_path)
    assert len(answers) == len(lines)
    for answer in answers:
        reply = json.loads(answer, parse_constant=lambda name: pytest.fail(name))
        assert ("error" in reply) != ("pose" in reply)
    assert result.summary["frames"] == len(gvo.read_trajectory(tmp_path / "raw.txt"))
    assert result.summary["frames"] == len(gvo.read_trajectory(tmp_path / "smoothed.txt"))
