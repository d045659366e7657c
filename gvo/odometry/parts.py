"""Which frames measurements connect."""

from __future__ import annotations

from collections.abc import Iterable


class Parts:
    """The frames of a run, named by their stamps, in connected parts: a union-find.

    A part is named by its first frame. What only a guess connects is in different parts: where one
    of them lies in the other is not known.

    References
    ----------
    R. E. Tarjan, "Efficiency of a good but not linear set union algorithm", J. ACM 22(2), 1975,
    doi:10.1145/321879.321884.
    """

    def __init__(self) -> None:
        self._before: dict[int, int] = {}

    def __contains__(self, stamp_ns: object) -> bool:
        """Tell whether a frame was added."""
        return stamp_ns in self._before

    def add(self, stamp_ns: int, references_ns: Iterable[int] = ()) -> None:
        """Add a frame with those that it was measured from; without any it is a part by itself."""
        self._before.setdefault(stamp_ns, stamp_ns)
        for reference_ns in references_ns:
            self.join(stamp_ns, reference_ns)

    def join(self, first_ns: int, second_ns: int) -> None:
        """Connect the parts of two frames."""
        first, second = sorted((self.of(first_ns), self.of(second_ns)))
        self._before[second] = first

    def of(self, stamp_ns: int) -> int:
        """Return the part of a frame; one that was not added is a part by itself."""
        before, found = self._before, stamp_ns
        while before.get(found, found) != found:
            found = before[found]
        while before.get(stamp_ns, stamp_ns) != found:  # a shorter way for the next question
            before[stamp_ns], stamp_ns = found, before[stamp_ns]
        return found
