"""What the Rerun viewer shows where, when a file is opened.

`rerun` is imported with this module: import it where a file is written, no earlier.
"""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

CLOUD: Final = "world/cloud"
OVERLAY: Final = "overlay"
COUNTS: Final = "counts"
MILLISECONDS: Final = "milliseconds"
CHI2: Final = "chi2"
STATUS: Final = "status"
CONFIGURATION: Final = "configuration"

STAMP: Final = "stamp"
FRAME: Final = "frame"


def make_layout() -> rrb.Blueprint:
    """Return the scene, and beside it the overlay, the numbers and the log."""
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin=OVERLAY, name="Matches"),
        rrb.TextDocumentView(origin=CONFIGURATION, name="Configuration"),
    )
    beside = rrb.Vertical(
        pictures,
        rrb.TimeSeriesView(origin=COUNTS, name="Counts"),
        rrb.Tabs(
            rrb.TimeSeriesView(origin=MILLISECONDS, name="Milliseconds"),
            rrb.TimeSeriesView(origin=CHI2, name="Chi-square of the edges"),
        ),
        rrb.TextLogView(origin=STATUS, name="Status"),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(_scene(), beside, column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene() -> rrb.Spatial3DView:
    """Return the view of the world; of the keyframes' points, all that came so far are shown."""
    so_far = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (STAMP, FRAME)
        ]
    )
    return rrb.Spatial3DView(origin="world", name="Scene", overrides={CLOUD: so_far})
