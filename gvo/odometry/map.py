"""The map of a run: its graph, the places in it, and which of its parts measurements connect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Generic

from gvo.backend.window import SlidingWindow
from gvo.config import Config
from gvo.frontend.protocol import ObservationsT, Recognizer
from gvo.geometry.edges import inverse, source_ns, then
from gvo.odometry.chain import RawStep
from gvo.odometry.graph import RunGraph
from gvo.odometry.keyframes import Keyframes
from gvo.odometry.loops import LoopDetector
from gvo.types import Edge, Estimate, FloatArray, Loop, SegmentJoin, Status


class Map(Generic[ObservationsT]):
    """Finds places again: after a gap, so that the window goes on there, and to close loops.

    After a gap the frames are a part by themselves, whose place among the others is a guess. It is
    known again when something measured connects both, see `search`. Without loops, only the
    keyframes that the window holds when a gap begins are places, until then.

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
    unjoined_ns : list of int
        The keyframes that nothing measured connects with the latest frames.
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
        self._window, self._keyframes = window, keyframes
        self.graph = RunGraph()
        self.unjoined_ns: list[int] = []
        # By the first frame of a part: its number. Only those that frames were registered in.
        self._numbers: dict[int, int] = {}
        self.segment = self._n_segments = self._part = 0
        # The gap before the current part was too long to go on from a guess.
        self._is_lost = False
        self.variance_factor = 1.0
        self._detector: LoopDetector | None = None
        self._is_enabled = False
        self.reconfigure(config, recognizer)

    def reconfigure(self, config: Config, recognizer: Recognizer | None) -> None:
        """Go on with another configuration or front-end; places are kept with loops alone."""
        was_enabled, self._is_enabled = self._is_enabled, config.loops.enabled
        if recognizer is None:
            self._detector = None
        elif self._detector is None or not was_enabled:
            self._detector = LoopDetector(frontend=recognizer, graph=self.graph)
        else:
            self._detector.reconfigure(recognizer)
        if self._detector is not None and self._is_enabled:
            self.graph.loops = self._detector.loops

    def forget_places(self) -> None:
        """Search no more places that another front-end has described."""
        if self._detector is not None:
            self._detector.forget_places()

    @property
    def seeks_places(self) -> bool:
        """Tell whether a lost camera looks for places itself."""
        return self._detector is not None and self._is_enabled

    @property
    def hidden_ns(self) -> list[int]:
        """The unjoined keyframes that the guess is too bad for to be registered from it."""
        return self.unjoined_ns if self._is_lost else []

    def follow(self, step: RawStep) -> None:
        """Note that the next frame goes on in the part that its step starts from."""
        if step.edge is not None:
            self._note_unjoined(source_ns(step.edge))

    def _note_unjoined(self, stamp_ns: int) -> None:
        self._part = self.graph.parts.of(stamp_ns)
        kept_ns, parts = self._keyframes.kept, self.graph.parts
        self.unjoined_ns = [ns for ns in kept_ns if ns in parts and parts.of(ns) != self._part]

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
        is_linked = any(edge.reference_id in self.unjoined_ns for edge in links)
        if step.edge is None or step.failure is not None or not self.unjoined_ns or is_linked:
            return None
        if not self._is_enabled and self._detector is not None and len(self._detector) == 0:
            for stamp_ns in self.unjoined_ns:
                observed = self._keyframes.kept[stamp_ns].observations
                self._detector.keep(observed, self._window.pose(stamp_ns))
        T_world_frame = self._window.pose(step.edge.reference_id) @ step.edge.T_reference_frame
        return self._look(observations, T_world_frame, is_keyframe=is_keyframe)

    def joining(self, loops: Sequence[Loop] | None) -> Edge | None:
        """Return the edge that confirmed loops give to a keyframe of another part in the window."""
        if not loops:
            return None
        loop, reference_ns, parts = loops[-1], loops[-1].reference_ns, self.graph.parts
        there = parts.of(reference_ns)
        kept = [ns for ns in self.unjoined_ns if ns in self._window and parts.of(ns) == there]
        if not kept:
            return None
        nearest = min(kept, key=lambda ns: abs(ns - reference_ns))
        if nearest == reference_ns:
            return loop.edge
        first, last = sorted((nearest, reference_ns))
        way = self.graph.path.way(first, last)
        between = Edge(
            reference_id=first, T_reference_frame=way.T, covariance=way.covariance + way.drift
        )
        return then(between if first == nearest else inverse(between, nearest), loop.edge)

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
        stamp_ns, edges = causal.stamp_ns, self._window.edges(causal.stamp_ns)
        before = {self.graph.parts.of(source_ns(edge)): edge for edge in edges}
        self._part = min(before, default=stamp_ns)
        is_tied = causal.status in (Status.OK, Status.RESUMED)
        is_keyframe, loops = stamp_ns in self._keyframes, found
        if self._is_enabled and loops is None and is_tied:
            loops = self._look(observations, causal.T_world_frame, is_keyframe=is_keyframe)
        is_place = self._detector is not None and stamp_ns in self._detector
        self.graph.add_frame(causal, edges, is_place=is_place)
        if not edges and anchor is not None:
            self._keep_last_seen(anchor)
        if self._is_lost or not self._is_enabled:
            self._note_unjoined(stamp_ns)
        self._is_lost = causal.status is Status.LOST or (self._is_lost and bool(self.unjoined_ns))
        if self._is_enabled and (is_keyframe or is_place):
            self.graph.advance(is_looped=bool(loops))
        if not self._is_enabled and not self.unjoined_ns:
            self.forget_places()
        return self._note_joins(stamp_ns, before), loops or () if self._is_enabled else ()

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
            near=self._keyframes.kept.keys() - set(self.unjoined_ns),
            part=self._part,
            is_keyframe=is_keyframe,
        )

    def _keep_last_seen(self, anchor: ObservationsT) -> None:
        """Make the last registered frame a place: it is what a lost camera may see again."""
        stamp_ns, detector = anchor.stamp_ns, self._detector
        if detector is None or not self._is_enabled or stamp_ns in detector:
            return
        if stamp_ns in self._window:
            detector.keep(anchor, self._window.pose(stamp_ns))
