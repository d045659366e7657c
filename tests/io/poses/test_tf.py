"""The tf buffer against composition by hand, scipy's Slerp and the rules of tf2."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from gvo.geometry import se3
from gvo.io.bag.reader import TF_TYPE, BagReader
from gvo.io.poses import tf
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.types import Failure, FloatArray
from tests.make import bags
from tests.make.bags import add_transform

seeds = st.integers(min_value=0, max_value=2**32 - 1)
FIRST_NS, LAST_NS = 1_700_000_000_000_000_000, 1_700_000_001_000_000_000


@dataclass(frozen=True, kw_only=True)
class Sample:
    parent: str
    child: str
    stamp_ns: int
    T: FloatArray
    is_static: bool


def random_transform(rng: np.random.Generator) -> FloatArray:
    R = Rotation.random(random_state=np.random.RandomState(rng.integers(2**31))).as_matrix()
    return se3.make_transform(np.asarray(R), 3.0 * rng.normal(size=3))


def random_tree(rng: np.random.Generator) -> list[Sample]:
    """Return the samples of a tree of static and moving frames f0 (the root), f1, ..."""
    samples = []
    for n in range(1, int(rng.integers(2, 9))):
        is_static = bool(rng.integers(2))
        between = rng.integers(FIRST_NS, LAST_NS, size=int(rng.integers(0, 6)))
        stamps = [FIRST_NS] if is_static else sorted({FIRST_NS, LAST_NS, *between.tolist()})
        parent = f"f{rng.integers(n)}"
        samples += [
            Sample(
                parent=parent,
                child=f"f{n}",
                stamp_ns=stamp,
                T=random_transform(rng),
                is_static=is_static,
            )
            for stamp in stamps
        ]
    return samples


def buffer_of(samples: Sequence[Sample]) -> TfBuffer:
    buffer = TfBuffer()
    for s in samples:
        add_transform(buffer, s.parent, s.child, s.stamp_ns, s.T, is_static=s.is_static)
    return buffer


def found(answer: FloatArray | Failure) -> FloatArray:
    assert not isinstance(answer, Failure), answer.reason
    return answer


def reason_of(answer: object) -> str:
    assert isinstance(answer, Failure)
    assert "\n" not in answer.reason
    return answer.reason


def three(rng: np.random.Generator, buffer: TfBuffer) -> tuple[str, str, str, int]:
    a, b, c = rng.choice(buffer.frames, size=3)
    return str(a), str(b), str(c), int(rng.integers(FIRST_NS, LAST_NS + 1))


def moving(*stamps_s: float, parent: str = "a", child: str = "b") -> TfBuffer:
    """Return a buffer with one edge, whose x coordinate is the stamp in seconds."""
    buffer = TfBuffer()
    for stamp in stamps_s:
        add_transform(buffer, parent, child, round(stamp * 1e9), shift(stamp))
    return buffer


def shift(x: float) -> FloatArray:
    return se3.make_transform(np.eye(3), np.array([x, 0.0, 0.0]))


def x_of(buffer: TfBuffer, target: str, source: str, stamp_s: float) -> float:
    return float(found(buffer.lookup(target, source, round(stamp_s * 1e9)))[0, 3])


@given(seed=seeds)
def test_the_root_and_a_frame_are_joined_by_slerp_and_lines_edge_by_edge(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = random_tree(rng)
    stamp = int(rng.integers(FIRST_NS, LAST_NS + 1))
    frame, T = samples[-1].child, np.eye(4)
    while frame != "f0":
        edge = [s for s in samples if s.child == frame]
        T = by_scipy(edge, stamp) @ T
        frame = edge[0].parent
    answer = found(buffer_of(samples).lookup("f0", samples[-1].child, stamp))
    np.testing.assert_allclose(answer, T, rtol=0, atol=1e-7)


def by_scipy(edge: Sequence[Sample], stamp_ns: int) -> FloatArray:
    if edge[0].is_static:
        return edge[-1].T
    elapsed = [(s.stamp_ns - FIRST_NS) / 1e9 for s in edge]
    at = (stamp_ns - FIRST_NS) / 1e9
    slerp = Slerp(elapsed, Rotation.from_matrix(np.array([s.T[:3, :3] for s in edge])))
    t = [np.interp(at, elapsed, [s.T[axis, 3] for s in edge]) for axis in range(3)]
    return se3.make_transform(np.asarray(slerp(at).as_matrix()), np.array(t))


@given(seed=seeds)
def test_many_stamps_at_once_give_what_single_ones_give(seed: int) -> None:
    rng = np.random.default_rng(seed)
    buffer = buffer_of(random_tree(rng))
    a, b, _, _ = three(rng, buffer)
    stamps = rng.integers(FIRST_NS - 10**8, LAST_NS + 10**8, size=20)
    T, is_known = buffer.lookup_many(a, b, stamps)
    for n, stamp in enumerate(stamps):
        single = buffer.lookup(a, b, int(stamp))
        assert bool(is_known[n]) is not isinstance(single, Failure)
        expected = np.full((4, 4), np.nan) if isinstance(single, Failure) else single
        np.testing.assert_allclose(T[n], expected, rtol=0, atol=1e-12)


@given(seed=seeds)
def test_the_stamps_between_two_frames_are_of_the_moving_edges_of_the_chain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = random_tree(rng)
    buffer = buffer_of(samples)
    a, b, _, _ = three(rng, buffer)
    chain = buffer.chain(a, b)
    assert not isinstance(chain, Failure)
    steps = {frozenset(step) for step in pairwise(chain)}
    on_the_way = [s for s in samples if frozenset((s.parent, s.child)) in steps and not s.is_static]
    assert chain[0] == a
    assert chain[-1] == b
    assert buffer.edge_stamps_ns(a, b).tolist() == sorted({s.stamp_ns for s in on_the_way})


def test_nothing_is_extrapolated_and_the_answer_names_the_known_range() -> None:
    buffer = moving(1.0, 2.5)
    add_transform(buffer, "b", "c", 0, shift(1.0), is_static=True)
    for stamp in (999_999_999, 2_500_000_001):
        reason = reason_of(buffer.lookup("c", "a", stamp))
        assert "1.000000000 to 2.500000000 s" in reason
        assert "a <- b is known" in reason
    assert "not at 2.500000001 s" in reason
    assert x_of(buffer, "a", "c", 2.5) == 3.5


def test_of_two_transforms_with_one_stamp_the_later_counts() -> None:
    buffer = moving(1.0, 2.0, 3.0)
    found(buffer.lookup("a", "b", 2 * 10**9))
    add_transform(buffer, "a", "b", 2 * 10**9, shift(7.0))
    assert x_of(buffer, "a", "b", 2.0) == 7.0
    assert x_of(buffer, "a", "b", 1.5) == 4.0
    assert buffer.edge_stamps_ns("a", "b").tolist() == [10**9, 2 * 10**9, 3 * 10**9]


@pytest.mark.parametrize("is_static", [True, False])
def test_a_loop_is_named_and_does_not_hang(is_static: bool) -> None:
    buffer = TfBuffer()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a"), ("c", "d")):
        add_transform(buffer, parent, child, 5, np.eye(4), is_static=is_static)
    assert "loop: " in reason_of(buffer.lookup("d", "a", 5))
    assert "a <- " in reason_of(buffer.chain("d", "b"))
    assert not buffer.lookup_many("d", "a", np.array([5]))[1].any()


def test_a_child_that_changes_its_parent_is_followed() -> None:
    """As tf2: each transform has its own parent, and one counts until another parent's comes."""
    buffer = moving(1.0, 2.0, parent="a", child="cup")
    for stamp_s in (4.0, 5.0):
        add_transform(buffer, "hand", "cup", round(stamp_s * 1e9), shift(10.0 * stamp_s))
    add_transform(buffer, "a", "hand", 0, shift(100.0), is_static=True)
    answers = [x_of(buffer, "a", "cup", stamp_s) for stamp_s in (1.5, 2.0, 3.0, 4.0, 4.5)]
    np.testing.assert_allclose(answers, [1.5, 2.0, 2.0, 140.0, 145.0], atol=1e-12)
    T, is_known = buffer.lookup_many("a", "cup", np.array([45, 15, 60, 0]) * 10**8)
    assert is_known.tolist() == [True, True, False, False]
    np.testing.assert_allclose(T[:2, 0, 3], [145.0, 1.5])
    assert buffer.chain("a", "cup") == ("a", "hand", "cup")
    assert buffer.edge_stamps_ns("a", "cup").tolist() == [n * 10**9 for n in (1, 2, 4, 5)]
    assert "cup has the parents a and hand" in " ".join(buffer.notes)
    assert buffer.lookup_many("a", "cup", np.empty(0, dtype=np.int64))[0].shape == (0, 4, 4)


def test_where_a_second_parent_tears_the_tree_it_is_named() -> None:
    buffer = moving(1.0)
    for parent in ("b", "tower"):
        add_transform(buffer, parent, "eye", 0, shift(1.0), is_static=True)
    reason = reason_of(buffer.lookup("a", "eye", 10**9))
    assert "that of eye at tower; eye has the parents b and tower" in reason
    assert "parents" not in reason_of(buffer.lookup("a", "b", 10**10))


def test_a_child_both_static_and_moving_moves() -> None:
    buffer = moving(1.0, 2.0)
    add_transform(buffer, "a", "b", 0, shift(9.0), is_static=True)
    assert x_of(buffer, "a", "b", 1.5) == 1.5
    assert not buffer.lookup("a", "b", 0)
    assert "b published as static and as moving" in buffer.notes[0]


# Recordings


def test_topics_of_static_transforms_are_known_by_their_name(tmp_path: Path) -> None:
    bag = [
        bags.tf("/robot/tf_static", "base", "/cam", shift(1.0), 5),
        bags.tf("/tf", "/odom", "base", shift(0.0), 7),
        bags.tf("/tf", "odom", "base", shift(2.0), 9),
    ]
    buffer = read_tf(BagReader(bags.write(tmp_path / "tf.bag", bag)))
    assert buffer.frames == ("base", "cam", "odom")
    assert buffer.edge_stamps_ns("odom", "cam").tolist() == [7, 9]
    assert found(buffer.lookup("odom", "cam", 8))[0, 3] == 2.0


def turned(stamp_ns: int, *quaternion_xyzw: float) -> bags.Message:
    """Return a message whose quaternion need not be of length one."""
    topic, type_, log_time_ns, message = bags.tf("/tf", "a", "b", np.eye(4), stamp_ns)
    for axis, value in zip("xyzw", quaternion_xyzw, strict=True):
        setattr(message.transforms[0].transform.rotation, axis, value)  # type: ignore[attr-defined]
    return topic, type_, log_time_ns, message


def test_messages_that_hold_no_transform_are_counted_and_left_out(tmp_path: Path) -> None:
    bag = [
        bags.tf("/tf", "a", "b", shift(0.0), 1),
        bags.tf("/tf", "a", "b", shift(np.nan), 2),
        turned(3, 0.0, 0.0, 0.0, 0.0),
        turned(4, 0.5, 0.5, 0.5, 0.6),
        bags.tf("/tf", "b", "b", shift(0.0), 5),
        bags.tf("/tf", "", "b", shift(0.0), 6),
    ]
    buffer = read_tf(BagReader(bags.write(tmp_path / "tf.bag", bag)))
    assert buffer.notes == [
        "tf: 5 transforms were refused; the first: a -> b at 0.000000002 s: the numbers are not "
        "finite"
    ]
    assert buffer.edge_stamps_ns("a", "b").tolist() == [1]


def test_a_long_tf_is_kept_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tf, "N_KEPT_WHOLE", 10)
    edges = [("base", "cam"), ("base", "wheel"), ("wheel", "rim")]
    items = [(*edge, n) for n in range(10) for edge in edges]
    # found only when the others are many already: what came before must not be lost
    items += [("odom", "base", n) for n in range(10)]
    items += [("map", "odom", 50 - n) for n in range(50)]
    items.insert(0, ("map", "odom", 0))
    messages = [
        ("/tf", TF_TYPE, log_time_ns, bags.tf("/tf", parent, child, shift(1.0), stamp_ns)[3])
        for log_time_ns, (parent, child, stamp_ns) in enumerate(items)
    ]
    reader = BagReader(bags.write(tmp_path / "tf.bag", messages))
    buffer = read_tf(reader, frames=("/cam", "base"))
    assert found(buffer.lookup("map", "cam", 0))[0, 3] == 3.0
    assert buffer.edge_stamps_ns("odom", "base").tolist() == list(range(10))
    assert len(buffer) == 10 + 10 + 51
    assert "rim" in buffer.frames
    assert len(read_tf(reader)) == len(items)
