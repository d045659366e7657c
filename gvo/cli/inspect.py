"""The commands that look into a recording: explain, view."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from gvo.cli import options as opt
from gvo.cli.terminal import Work, progress, say, warn
from gvo.errors import ConfigurationError, GvoError

if TYPE_CHECKING:
    from gvo.io.recording import Source
    from gvo.trajectory.trajectory import Trajectory

_DEFAULT_PORT = 8080
# How often the page looks for signals.
_SIGNALS_S = 0.1


def explain(
    recordings: opt.Recordings,
    frame: Annotated[
        int, Option("--frame", min=0, metavar="N", help="Number of the frame, from 0.")
    ],
    *,
    out: opt.Out = None,
    force: opt.Force = False,
    start: opt.Start = 0.0,
    every: opt.Every = 1,
    parameters: opt.Parameters,
    options: opt.Options,
) -> None:
    """Draw how one frame becomes a pose, step by step."""
    from gvo.diagnostics.explain import explain_frame
    from gvo.io.excerpt import make_excerpt
    from gvo.viz.explanation import write_explanation

    excerpt = make_excerpt(start, None, every)
    out = opt.new_folder(out, recordings[0], what=f"-frame-{frame}", force=force)
    source = opt.open_source(recordings, parameters, options)
    with progress(source.info.name) as show:
        found = explain_frame(source, frame, config=parameters, excerpt=excerpt, on_progress=show)
        written = write_explanation(found, out)
    for path in written:
        say(path)


def view(
    recordings: Annotated[
        list[Path],
        Argument(metavar="RECORDING...", help="Bags, or a data-set folder."),
    ],
    *,
    host: Annotated[
        str, Option(metavar="ADDRESS", help="Address to listen on; 0.0.0.0 lets all machines in.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(min=0, max=65535, help="Port; 0 takes a free one.")] = (
        _DEFAULT_PORT
    ),
    config: opt.ConfigFile = None,
    set_: opt.Settings = None,
    options: opt.Options,
) -> None:
    """Watch odometry in the browser and change its parameters."""
    from gvo.viz.view import serve
    from gvo.viz.view.player import Player

    for path in recordings:
        if (path / "frames.csv").is_file():
            raise ConfigurationError(
                f"{path}: is a run, not a recording; open {path / 'report.html'} to look at it "
                "(gvo run --rerun FILE writes it for Rerun)"
            )
    with Work() as work, ExitStack() as stack:
        reopen = partial(opt.open_source, recordings, options=options)
        player = stack.enter_context(Player(reopen, opt.load(config, set_)))
        truth = _find_truth(player.source)
        server = stack.enter_context(serve(player, host=host, port=port, truth=truth))
        warn([server.note] if server.note else [])
        server.play_when_opened()
        say(server.url)
        say(f"{recordings[0].name} plays when a browser opens this address; Ctrl-C ends")
        while not server.wait(_SIGNALS_S):
            work.check()


def _find_truth(source: Source) -> Trajectory | None:
    """Return the ground truth that the recording itself holds, if any."""
    from gvo.io.poses.inputs import recorded_truth
    from gvo.types import Failure

    try:
        truth = recorded_truth(source)
    except GvoError as error:
        warn([f"no ground truth: {error}"])
        return None
    return None if isinstance(truth, Failure) else truth.trajectory
