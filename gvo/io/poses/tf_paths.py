"""Paths through a tree of named frames, and what to say where there is none."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from gvo.types import Failure

_N_LISTED = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePath:
    """The edges between two frames, each named by its child.

    Parameters
    ----------
    from_target, from_source : tuple of str
        The children on the way up from either frame, the common ancestor left out.
    ancestor : str
        Where both meet.
    """

    from_target: tuple[str, ...]
    from_source: tuple[str, ...]
    ancestor: str

    @property
    def children(self) -> tuple[str, ...]:
        """The children of all edges."""
        return self.from_target + self.from_source

    @property
    def names(self) -> tuple[str, ...]:
        """All frames from target to source."""
        return (*self.from_target, self.ancestor, *reversed(self.from_source))


def bare(name: str) -> str:
    """Return the name of a frame without a leading slash."""
    return name.removeprefix("/")


def find_path(parents: Mapping[str, str], target: str, source: str) -> FramePath | Failure:
    """Find the path between two frames by their lowest common ancestor.

    Parameters
    ----------
    parents : mapping of str to str
        The parent of each child.
    target, source : str

    Returns
    -------
    FramePath or Failure
        The failure names the roots of both trees, or a loop.
    """
    above_target, above_source = _upwards(parents, target), _upwards(parents, source)
    for way in (above_target, above_source):
        if way[-1] in parents:
            loop = [*way[way.index(parents[way[-1]]) :], parents[way[-1]]]
            return Failure(reason=f"tf holds a loop: {' <- '.join(loop)}")
    ranks = {name: rank for rank, name in enumerate(above_source)}
    for rank, name in enumerate(above_target):
        if name in ranks:
            return FramePath(
                from_target=tuple(above_target[:rank]),
                from_source=tuple(above_source[: ranks[name]]),
                ancestor=name,
            )
    return Failure(
        reason=f"tf does not connect {target} and {source}: the tree of {target} ends at "
        f"{above_target[-1]}, that of {source} at {above_source[-1]}"
    )


def _upwards(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return a frame and its ancestors, up to the root or to where a loop closes."""
    way = {frame: None}  # keeps the order, and tells quickly what it holds
    while (parent := parents.get(frame)) is not None and parent not in way:
        way[parent] = None
        frame = parent
    return list(way)


def ancestors(edges: Iterable[tuple[str, str]], frames: Iterable[str]) -> set[str]:
    """Return frames and all their ancestors.

    Parameters
    ----------
    edges : iterable of (parent, child)
        A child may have several parents.
    frames : iterable of str
    """
    parents: dict[str, set[str]] = {}
    for parent, child in edges:
        parents.setdefault(child, set()).add(parent)
    found: set[str] = set()
    ahead = set(frames)
    while ahead:
        found |= ahead
        ahead = {parent for child in ahead for parent in parents.get(child, ())} - found
    return found


def describe_unknown(name: str, frames: Sequence[str]) -> str:
    """Return one line about a frame that is not known."""
    if not frames:
        return f"tf holds no frame {name}: it is empty"
    close = get_close_matches(name, frames, n=3, cutoff=0.5)
    nearest = f" (the nearest: {', '.join(close)})" if close else ""
    return f"tf holds no frame {name}{nearest}; it holds {list_names(frames)}"


def list_names(names: Collection[str]) -> str:
    """Return the first names in one line, and how many more there are."""
    n_more = len(names) - _N_LISTED
    return ", ".join(list(names)[:_N_LISTED]) + (f" and {n_more} more" if n_more > 0 else "")
