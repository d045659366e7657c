"""The page in the browser: a recording that is tracked live, a running camera, or a finished run.

It needs viser (the extra `view`), which is imported when a page is served.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvo.errors import missing_extra

if TYPE_CHECKING:
    from gvo.trajectory.trajectory import Trajectory
    from gvo.viz.view.live import LivePlayer
    from gvo.viz.view.player import Player
    from gvo.viz.view.server import ViewServer

__all__ = ["serve"]


def serve(
    source: Player | LivePlayer | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    truth: Trajectory | None = None,
    name: str = "",
) -> ViewServer:
    """Serve the page of a recording that is tracked, of a run that goes on, or of a finished one.

    Parameters
    ----------
    source : Player, LivePlayer or Path
        A player, which closing the page does not close, or a run folder.
    host : str
        Address to bind to; 0.0.0.0 lets everyone on the network steer the page.
    port : int
        Where it is taken, the next free one is used (see `ViewServer.note`); 0: any.
    truth : Trajectory, optional
        Drawn beside the estimates of a player; a run folder has its own.
    name : str
        Title of the panel.

    Raises
    ------
    ConfigurationError
        Without viser, or where no port can be had.
    GvoError
        Where the folder holds no run.
    """
    try:
        import viser  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise missing_extra("the page in the browser needs viser", "view") from error
    if isinstance(source, str | Path):
        from gvo.viz.view.finished import serve_record

        return serve_record(Path(source), host=host, port=port, name=name)
    from gvo.viz.view.page import serve_player

    return serve_player(source, host=host, port=port, truth=truth, name=name)
