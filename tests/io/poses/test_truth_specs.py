"""How poses inside of a bag are named."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import TrajectoryError
from gvo.io.poses.ground_truth import FileTruth, TfTruth, TopicTruth, parse_bag_truth, parse_truth

names = st.text("abcxyz_019", min_size=1, max_size=8)


@given(names, names)
def test_a_chain_of_tf_is_two_frames_with_or_without_a_slash(parent: str, child: str) -> None:
    if parent == child:
        child += "x"
    for text in (f"tf:{parent}:{child}", f"tf:/{parent}:/{child}"):
        assert parse_truth(text) == TfTruth(parent=parent, child=child)


@given(names)
def test_a_topic_has_a_slash_or_is_called_one(name: str) -> None:
    assert parse_bag_truth(name) == parse_truth(f"topic:{name}") == TopicTruth(name=name)
    slashed = TopicTruth(name=f"/{name}/pose")
    assert parse_truth(f"/{name}/pose") == parse_truth(f"topic:/{name}/pose") == slashed


def test_a_file_that_exists_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tf:map:base"
    path.touch()
    assert parse_truth(str(path)) == FileTruth(path=path)
    monkeypatch.chdir(tmp_path)
    assert parse_truth("tf:map:base") == FileTruth(path=Path("tf:map:base"))
    path.unlink()
    assert parse_truth("tf:map:base") == TfTruth(parent="map", child="base")


@pytest.mark.parametrize("text", ["tf:map", "tf:map:", "tf::base", "tf:a:b:c", "tf:a:a", "tf:/:b"])
def test_a_chain_of_anything_but_two_frames_is_refused(text: str) -> None:
    with pytest.raises(TrajectoryError, match="expected two frames, as in tf:map:base_link"):
        parse_truth(text)


@pytest.mark.parametrize("text", ["truth.missing.txt", "no/such/truth.csv", "tff:a:b"])
def test_anything_else_is_a_missing_file(text: str) -> None:
    with pytest.raises(TrajectoryError, match=r"no such file; expected .*tf:PARENT:CHILD.*topic:"):
        parse_truth(text)


@pytest.mark.parametrize("text", ["topic:", "topic:/", "/"])
def test_a_topic_without_a_name_is_refused(text: str) -> None:
    with pytest.raises(TrajectoryError, match="names no topic"):
        parse_bag_truth(text)
