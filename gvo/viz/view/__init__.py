"""A page in the browser: a recording that is tracked while one looks, or a finished run.

Everything here needs viser (`pip install 'gvo[view]'`), which is loaded when a page is asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvo.errors import ConfigurationError

if TYPE_CHECKING:
    from gvo.trajectory.trajectory import Trajectory
    from gvo.viz.view.player import Player
    from gvo.viz.view.server import ViewServer

__all__ = ["serve", "serve_run"]


def serve(
    source: Player | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    truth: Trajectory | None = None,
    name: str = "",
) -> ViewServer:
    """Serve the page of a recording that is tracked, or of a finished run.

    Parameters
    ----------
    source : Player or Path
        The player stays the caller's: closing the page does not close it. Or a run folder.
    host : str
        Address to bind to; 0.0.0.0 lets everyone on the network steer the page.
    port : int
        Where it is taken, the next free one is used (`ViewServer.note` says so); 0: any.
    truth : Trajectory, optional
        Is drawn beside the estimates of a player; a run folder brings its own.
    name : str
        Title of the panel.

    Raises
    ------
    ConfigurationError
        Without viser, or where no port can be had.
    GvoError
        Where the folder holds no run.
    """
    if isinstance(source, str | Path):
        return serve_run(Path(source), host=host, port=port, name=name)
    _need_viser()
    from gvo.viz.view.page import serve_player

    return serve_player(source, host=host, port=port, truth=truth, name=name)


def serve_run(
    folder: Path, *, host: str = "127.0.0.1", port: int = 8080, name: str = ""
) -> ViewServer:
    """Serve the page of a finished run; see `serve`."""
    _need_viser()
    from gvo.viz.view.finished import serve_record

    return serve_record(folder, host=host, port=port, name=name)


def _need_viser() -> None:
    try:
        import viser  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise ConfigurationError("gvo view needs viser: pip install 'gvo[view]'") from error
