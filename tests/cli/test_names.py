"""Names that a recording holds, made to order a terminal about: shown escaped, by all commands."""

import dataclasses
import html
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from gvo._text import visible
from gvo.io.bag.reader import BagReader, typestore
from tests.conftest import Command, line_of_poses

# Escape sequences (of one and of two characters), a bell, marks that turn the direction of
# writing, line ends, and markup of HTML, Matplotlib and Rich.
EVIL = "e\x1b[31m\x9b2J\x07\u202e\u2066\r\n\u2028<b>&$x_{$[/red]\x7fe"
FILE = EVIL.replace("/", "")
TEXTS = (".html", ".json", ".csv", ".txt", ".yaml")


def renamed(message: Any) -> Any:
    """Return a message with other names of frames."""
    if hasattr(message, "transforms"):
        return dataclasses.replace(message, transforms=[*map(renamed, message.transforms)])
    header = dataclasses.replace(message.header, frame_id=f"{EVIL}{message.header.frame_id}")
    changes = {"child_frame_id": f"{EVIL}c"} if hasattr(message, "child_frame_id") else {}
    return dataclasses.replace(message, header=header, **changes)


@pytest.fixture(scope="module")
def evil_bag(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evil") / FILE
    reader, store = BagReader(drive_bag), typestore(is_ros1=False)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for message in reader.messages([topic.name for topic in reader.topics]):
            name, type_ = message.topic.name, message.topic.type
            if name not in connections:
                evil = name if name.startswith("/tf") else f"/{EVIL}{name}"
                connections[name] = writer.add_connection(evil, type_, typestore=store)
            data = store.serialize_cdr(renamed(message.decode()), type_)
            writer.write(connections[name], message.log_time_ns, data)
    return folder


def texts(folder: Path) -> Iterator[str]:
    """Yield the names of all files, and what those of text hold."""
    for path in sorted(folder.rglob("*")):
        yield str(path.relative_to(folder))
        if path.suffix in TEXTS and path.name != "results.csv":  # it holds the paths themselves
            yield path.read_bytes().decode("utf-8")


@pytest.mark.parametrize(
    "words",
    [
        ("check", "{bag}"),
        ("run", "{bag}", "--frame", EVIL),
        ("run", "{bag}", "--left", "/nothing"),
        ("convert", "{bag}", "o", "--layout", "euroc"),
        ("smooth", "{bag}"),
        ("compare", "{bag}", "{bag}#/nothing"),
        ("run", "{bag}", "--no-report", "--duration", "0.1", "--bag", "o.mcap"),
        pytest.param(("explain", "{bag}", "--frame", "1"), marks=pytest.mark.acceptance),
    ],
    ids=lambda words: words[0],
)
def test_names_are_shown_escaped(
    command: Command, evil_bag: Path, here: Path, words: tuple[str, ...]
) -> None:
    answer = command(*(word.replace("{bag}", str(evil_bag)) for word in words))
    shown = answer.out + answer.err
    assert answer.code in (0, 2, 3)
    assert words[0] in ("explain", "convert", "compare", "smooth") or "1b[31m" in shown
    for text in (shown, *texts(here)):
        assert all(line.isprintable() for line in text.split("\n"))
    lines = [] if words[0] == "check" else shown.split("\n")  # which breaks long lines at blanks
    for line in lines:
        assert "<b>&$" not in line or "u2066" in line  # the names have line ends between them


def test_a_report_and_a_summary_name_the_recording_without_harm(
    command: Command, evil_bag: Path, tmp_path: Path
) -> None:
    answer = command("run", evil_bag, "--duration", "0.2", "--out", tmp_path)
    assert visible(EVIL) in answer.out
    for text in (answer.out + answer.err, *texts(tmp_path)):
        assert all(line.isprintable() for line in text.split("\n"))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert html.escape(visible(EVIL)) in page
    assert "<b>&" not in page
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["recording"] == FILE


def test_names_of_files_are_shown_escaped(command: Command, tmp_path: Path) -> None:
    path = line_of_poses(tmp_path / f"{FILE}.txt")
    page = tmp_path / "page.html"
    for words in (
        ("compare", path, path, "--report", page),
        ("smooth", path, "--out", tmp_path / "out"),
        ("check", path),
        ("config", "--config", path),
    ):
        answer = command(*words)
        assert visible(FILE) in answer.out + answer.err
        assert (answer.out + answer.err).replace("\n", "").isprintable()
    assert all(line.isprintable() for line in page.read_text(encoding="utf-8").split("\n"))


def test_a_bar_shows_a_name_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gvo.cli import terminal
    from gvo.types import Progress

    monkeypatch.setattr(terminal, "is_shown", lambda: True)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    update: Callable[[Progress], None]
    with terminal.progress("a\x9b[/red]b") as update:
        update(Progress(n_done=1, n_total=2, n_tracked=1))
    assert "a\\x9b[/red]b" in capsys.readouterr().err
