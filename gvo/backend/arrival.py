"""A pose on its way into a window."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from gvo.backend.factors import Measurement
from gvo.types import Edge, FrameId, PosePrior, Prior, Rejected

# Of a first pose without a prior, which defines the world: radians and metres.
ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))


@dataclass(slots=True, kw_only=True)
class Arrival:
    """A pose on its way into the window, with what is usable of its measurements.

    `T_world_references` are the poses of the references at that moment, by their names;
    `T_world_after` those of the pose and of them once it is in the graph, by their keys. `anchor`
    and `coasting` hold the pose where the measurements do not; they are none themselves.
    """

    frame_id: FrameId
    key: int
    stamp_ns: int
    T_world_start: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    T_world_references: dict[FrameId, gtsam.Pose3] = field(default_factory=dict)
    T_world_after: dict[int, gtsam.Pose3] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    anchor: PosePrior | None = None
    coasting: Edge | None = None
    is_origin: bool = False

    @property
    def is_measured(self) -> bool:
        """Tell whether a measurement ties the pose, or it is the origin."""
        return bool(self.measurements or self.priors or self.is_origin)
