"""The page in the browser: a recording that is tracked, or a running camera.

It needs viser (the extra `view`), which is imported when a page is served.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gvo.errors import missing_extra

if TYPE_CHECKING:
    from gvo.trajectory.trajectory import Trajectory
    from gvo.viz.view.live import LivePlayer
    from gvo.viz.view.page import Page
    from gvo.viz.view.player import Player


def serve(
    player: Player | LivePlayer,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    truth: Trajectory | None = None,
) -> Page:
    """Serve the page of a recording that is tracked, or of a run that goes on elsewhere.

    Parameters
    ----------
    player : Player or LivePlayer
        Closing the page does not close it. One that has shown nothing shows its first frame.
    host : str
        Address to bind to; 0.0.0.0 lets everyone on the network steer the page.
    port : int
        Where it is taken, the next free one is used (see `Page.note`); 0: any.
    truth : Trajectory, optional
        Of the camera, in any world; drawn beside the estimates.

    Raises
    ------
    ConfigurationError
        Without viser, or where no port can be had.
    """
    try:
        import viser  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise missing_extra("the page in the browser needs viser", "view") from error
    from gvo.viz.view.page import Page

    return Page(player, host=host, port=port, truth=truth)
