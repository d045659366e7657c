"""Events of a computation, recorded and taken apart."""

import numpy as np

from gvo._trace import Trace, note, watched


def recorded() -> Trace:
    with watched() as trace:
        for n, name in enumerate("abacab"):
            note(name, n=n)
    return trace


def numbers(trace: Trace) -> list[int]:
    return [event.values["n"] for event in trace]


def test_nothing_is_recorded_outside_of_a_watched_context() -> None:
    with watched() as trace:
        pass
    note("late")
    assert trace == []


def test_events_are_found_by_name() -> None:
    trace = recorded()
    assert [values["n"] for values in trace.all("a")] == [0, 2, 4]
    assert trace.find("b") == {"n": 1}
    assert trace.find("d") == {}


def test_a_trace_is_cut_before_an_event_and_split_at_events() -> None:
    trace = recorded()
    assert numbers(trace.before("c")) == [0, 1, 2]
    assert numbers(trace.before("d")) == [0, 1, 2, 3, 4, 5]
    assert [numbers(part) for part in trace.split("b")] == [[1, 2, 3, 4], [5]]
    assert trace.split("d") == []


def test_arrays_are_recorded_as_they_were() -> None:
    array = np.zeros(2)
    with watched() as trace:
        note("array", array=array)
    array[:] = 1.0
    assert trace[0].values["array"].tolist() == [0.0, 0.0]


def test_inner_contexts_keep_their_events() -> None:
    with watched() as outer:
        with watched() as inner:
            note("inner")
        note("outer")
    assert [event.name for event in inner] == ["inner"]
    assert [event.name for event in outer] == ["outer"]
