"""The map of a run: its graph, the places in it, and which of its parts measurements connect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Generic

from gvo.backend.window import SlidingWindow
from gvo.config import Config
from gvo.frontend.protocol import ObservationsT, Recognizer
from gvo.geometry.edges import inverse, then
from gvo.odometry.chain import RawStep
from gvo.odometry.graph import RunGraph
from gvo.odometry.keyframes import Keyframes
from gvo.odometry.loops import LoopDetector
from gvo.odometry.parts import Parts
from gvo.odometry.path import source_ns
from gvo.types import Edge, Estimate, FloatArray, Loop, SegmentJoin, Status


class Map(Generic[ObservationsT]):
    """Finds places again: after a gap, so that the window goes on there, and to close loops.

    After a gap the frames are a part by themselves, whose place among the others is a guess. It is
    known again when something measured connects both, see `search`. Without loops, only what the
    window holds when a gap begins is kept, until then.

    Parameters
    ----------
    config : Config
    recognizer : Recognizer or None
        Without it nothing is looked for.
    window, keyframes
        What odometry holds of the latest frames.

    Attributes
    ----------
    graph : RunGraph
    segment : int
        The number of the part that the latest measured frame is in.
    variance_factor : float
        Of the covariances of loops to come.
    """

    def __init__(
        self,
        config: Config,
        recognizer: Recognizer | None,
        window: SlidingWindow,
        keyframes: Keyframes[ObservationsT],
    ) -> None:
        self._config, self._recognizer = config, recognizer
        self._window, self._keyframes = window, keyframes
        self._parts = Parts()
        # By the first frame of a part: its number. Only those that frames were registered in.
        self._numbers: dict[int, int] = {}
        self.segment = self._n_segments = 0
        self._part = 0
        # The gap before the current part was too long to go on from a guess.
        self._is_lost = False
        self.variance_factor = 1.0
        self._begin()

    def _begin(self) -> None:
        self.graph = RunGraph(self._config.window, self._parts)
        self._detector = None
        if self._recognizer is not None:
            self._detector = LoopDetector(frontend=self._recognizer, graph=self.graph)
            self.graph.loops = self._detector.loops

    def reconfigure(self, config: Config, recognizer: Recognizer | None) -> None:
        """Go on with another configuration or front-end; without loops before, the map begins."""
        former, self._config, self._recognizer = self._config, config, recognizer
        self.graph.reconfigure(config.window)
        if not former.loops.enabled:
            self._begin()
        elif self._detector is not None and recognizer is not None:
            self._detector.reconfigure(recognizer)

    def forget_places(self) -> None:
        """Search no more places that another front-end has described."""
        if self._detector is not None:
            self._detector.forget_places()

    @property
    def seeks_places(self) -> bool:
        """Tell whether a lost camera looks for places itself."""
        return self._detector is not None and self._config.loops.enabled

    @property
    def unjoined_ns(self) -> list[int]:
        """The keyframes that nothing measured connects with the latest frames."""
        kept_ns = (ns for ns in self._keyframes.stamps_ns if ns in self._parts)
        return [ns for ns in kept_ns if self._parts.of(ns) != self._part]

    @property
    def hidden_ns(self) -> list[int]:
        """Those of them that the guess is too bad for to be registered from it."""
        return self.unjoined_ns if self._is_lost else []

    def follow(self, step: RawStep) -> None:
        """Note that the next frame goes on in the part that its step starts from."""
        if step.reference_ns is not None:
            self._part = self._parts.of(step.reference_ns)

    def search(
        self,
        observations: ObservationsT,
        step: RawStep,
        links: Sequence[Edge],
        *,
        is_keyframe: bool,
    ) -> tuple[Loop, ...] | None:
        """Look for the place of a frame that nothing connects with the keyframes of another part.

        Call it before the window takes the frame.

        Returns
        -------
        tuple of Loop, or None
            The loops that are confirmed, see `joining`; None if nobody had to look.
        """
        unjoined_ns, reference_ns = self.unjoined_ns, step.reference_ns
        is_linked = any(edge.reference_id in unjoined_ns for edge in links)
        if (
            step.registration is None
            or not unjoined_ns
            or is_linked
            or reference_ns not in self._window
        ):
            return None
        if not self._config.loops.enabled and len(self.graph.path) == 0:
            self._begin_with_window()
        T_world_frame = self._window.pose(reference_ns) @ step.T_reference_frame
        return self._look(observations, T_world_frame, is_keyframe=is_keyframe)

    def _begin_with_window(self) -> None:
        """Begin a map with what the window holds."""
        for ns in self._window.poses():
            stamp_ns = int(ns)  # type: ignore[call-overload]
            edges = self._window.edges(stamp_ns)
            self.graph.add_frame(self._window.estimate(stamp_ns), edges, is_place=True)
        if self._detector is not None:
            for stamp_ns in self.unjoined_ns:
                self._detector.keep(self._keyframes[stamp_ns], self._window.pose(stamp_ns))

    def joining(self, loops: Sequence[Loop] | None) -> Edge | None:
        """Return the edge that confirmed loops give to a keyframe of another part in the window."""
        if not loops:
            return None
        loop, path, there = loops[-1], self.graph.path, self._parts.of(loops[-1].reference_ns)
        kept = [ns for ns in self.unjoined_ns if ns in self._window and self._parts.of(ns) == there]
        if not kept:
            return None
        reference_ns = loop.reference_ns
        nearest = min(kept, key=lambda ns: abs(ns - reference_ns))
        if nearest == reference_ns:
            return loop.edge
        ends = sorted((nearest, reference_ns))
        way = path.way(*ends)
        between = Edge(
            reference_id=ends[0], T_reference_frame=way.T, covariance=way.covariance + way.drift
        )
        return then(between if nearest < reference_ns else inverse(between, nearest), loop.edge)

    def add(
        self,
        observations: ObservationsT,
        causal: Estimate,
        found: tuple[Loop, ...] | None,
        anchor: ObservationsT | None,
    ) -> tuple[tuple[SegmentJoin, ...], tuple[Loop, ...]]:
        """Add a frame that the window has taken; return what it joined, and its loops.

        Parameters
        ----------
        observations
            Of the frame.
        causal : Estimate
        found : tuple of Loop, or None
            By `search`.
        anchor : observations, optional
            Of the last registered frame.
        """
        stamp_ns, is_enabled = causal.stamp_ns, self._config.loops.enabled
        edges, is_tied = self._window.edges(stamp_ns), causal.status in (Status.OK, Status.RESUMED)
        before = {self._parts.of(source_ns(edge)): edge for edge in edges}
        self._part = min(before, default=stamp_ns)
        is_keyframe, loops = stamp_ns in self._keyframes.stamps_ns, found
        if is_enabled and loops is None and is_tied:
            loops = self._look(observations, causal.T_world_frame, is_keyframe=is_keyframe)
        is_place = self._detector is not None and stamp_ns in self._detector
        if is_enabled or len(self.graph.path) > 0:
            self.graph.add_frame(causal, edges, is_place=is_place)
        self._parts.add(stamp_ns, before)
        if not edges:
            self._keep_last_seen(anchor)
        self._is_lost = causal.status is Status.LOST or (self._is_lost and bool(self.unjoined_ns))
        if not is_enabled:
            if not self.unjoined_ns and len(self.graph.path) > 0:
                self._begin()
            loops = ()
        elif is_keyframe or is_place:
            self.graph.advance(is_looped=bool(loops))
        return self._note_joins(stamp_ns, before), loops or ()

    def _note_joins(self, stamp_ns: int, before: Mapping[int, Edge]) -> tuple[SegmentJoin, ...]:
        """Return which segments a frame joins; number its part, where it begins one."""
        if not before and self._numbers:
            return ()
        parts = sorted(before) or [stamp_ns]
        numbered = [part for part in parts if part in self._numbers]
        if not numbered:
            self._numbers[parts[0]] = self._n_segments
            self._n_segments += 1
            numbered = parts[:1]
        self.segment = self._numbers[parts[0]] = self._numbers[numbered[0]]
        return tuple(
            SegmentJoin(
                segment=self._numbers[part],
                to_segment=self.segment,
                stamp_ns=stamp_ns,
                reference_ns=source_ns(before[numbered[0]]),
            )
            for part in numbered[1:]
        )

    def _look(
        self, observations: ObservationsT, T_world_frame: FloatArray, *, is_keyframe: bool
    ) -> tuple[Loop, ...]:
        """Return the loops that are confirmed with a frame."""
        if self._detector is None:
            return ()
        self._detector.variance_factor = self.variance_factor
        return self._detector.look(
            observations,
            T_world_frame,
            near=set(self._keyframes.stamps_ns).difference(self.unjoined_ns),
            part=self._part,
            is_keyframe=is_keyframe,
        )

    def _keep_last_seen(self, anchor: ObservationsT | None) -> None:
        """Make the last registered frame a place: it is what a lost camera may see again."""
        if self._detector is None or anchor is None:
            return
        stamp_ns = anchor.stamp_ns
        is_there = stamp_ns in self.graph.path and stamp_ns in self._window
        if is_there and stamp_ns not in self._detector:
            self._detector.keep(anchor, self._window.pose(stamp_ns))
