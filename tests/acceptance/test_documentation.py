"""What the documentation shows is run: code, commands, the list of parameters."""

import doctest
import importlib
import re
import shlex
import shutil
from functools import partial
from pathlib import Path

import pytest
from distributed import LocalCluster

import gvo
from gvo.config import Config, describe_configuration
from gvo.runs.demo import write_robot_bag
from tests.conftest import Command, write_drive, write_room

pytestmark = pytest.mark.acceptance

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MODULES = [
    path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
    for path in sorted((ROOT / "gvo").rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


TUTORIALS = ("README.md", "index.md")


def blocks(language: str) -> list[tuple[str, str]]:
    return [
        (page.name, block)
        for page in PAGES
        for block in re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)
    ]


def text_of(tutorial: str) -> list[str]:
    """Return the lines of a page that is typed from its first to its last."""
    return [line for page, text in blocks("sh") if page == tutorial for line in text.splitlines()]


def commands() -> list[tuple[str, list[str]]]:
    """Return the commands of each block; none of a block whose commands another one has, too."""
    found: list[tuple[str, list[str]]] = []
    for page, text in blocks("sh"):
        if page in TUTORIALS:  # typed from their first lines to their last, see below
            continue
        lines = [line for line in text.splitlines() if line.startswith("gvo ")]
        # A word in capitals, or a variable of the shell, stands for a file of the reader's own.
        lines = [
            line
            for line in lines
            if not any(word.isupper() or word.startswith("$") for word in shlex.split(line))
        ]
        if not any({*lines} <= {*others} for _, others in found):
            found = [each for each in found if not {*each[1]} <= {*lines}] + [(page, lines)]
    return found


@pytest.fixture(scope="session")
def drive_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a drive with as few frames as the commands name."""
    path = tmp_path_factory.mktemp("bags") / "drive.mcap"
    return write_drive(path, n_frames=12, scale=0.25)


@pytest.fixture(scope="session")
def room_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a walk as short."""
    path = tmp_path_factory.mktemp("bags") / "room.bag"
    return write_room(path, n_frames=8, scale=0.25)


@pytest.fixture
def clone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, drive_bag: Path) -> Path:
    """Return a working folder as the README's first command leaves it, with a shorter drive."""
    folder = tmp_path / "gvo-demo"
    folder.mkdir()
    shutil.copy(drive_bag, folder / "drive.mcap")
    write_robot_bag(true_poses(drive_bag), folder / "robot.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def workplace(clone: Path, room_bag: Path) -> Path:
    """Return a working folder with the recordings that the documentation names."""
    for name in ("drive.mcap", "robot.mcap"):
        shutil.copy(clone / "gvo-demo" / name, clone / name)
    shutil.copy(room_bag, clone / "room.bag")
    (shown,) = (block for page, block in blocks("yaml") if page == "live.md")
    (clone / "stereo.yaml").write_text(shown)
    return clone


def true_poses(bag: Path) -> gvo.Trajectory:
    truth = gvo.open_recording(bag).ground_truth()
    assert truth is not None
    return truth


def test_the_list_of_parameters_is_up_to_date() -> None:
    page = (ROOT / "docs/configuration.md").read_text()
    assert describe_configuration(Config()) in page


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


@pytest.mark.usefixtures("undrawn_reports", "workers_in_this_process")
@pytest.mark.parametrize(("page", "code"), blocks("python"))
def test_python_in_the_documentation_runs(workplace: Path, page: str, code: str) -> None:
    exec(compile(code, page, "exec"), {"__name__": "__main__"})


@pytest.fixture
def page_that_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `gvo view` end where it would wait for its reader."""
    monkeypatch.setattr("gvo.viz.view.page.Page.wait", lambda *_: True)


@pytest.fixture
def undrawn_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave reports empty: to draw takes long."""
    for name in ("write_run_report", "write_comparison_report"):
        monkeypatch.setattr(f"gvo.viz.report.{name}", lambda path, *_, **__: Path(path).touch())


@pytest.fixture
def undrawn_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the plots of runs and of comparisons empty, which the tutorials draw."""
    name = "gvo.viz.plots.plot_trajectories"
    monkeypatch.setattr(name, lambda path, *_, **__: Path(path).touch())


@pytest.fixture
def workers_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let batches start no processes; what they write is the same."""
    near = partial(LocalCluster, processes=False, dashboard_address="127.0.0.1:0")
    monkeypatch.setattr("gvo.batch.engine.LocalCluster", lambda **_: near(n_workers=1))


@pytest.mark.usefixtures("page_that_ends", "clone", "undrawn_reports", "workers_in_this_process")
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_works_line_by_line_after_the_demo(command: Command, name: str) -> None:
    lines = {page: text_of(page) for page in TUTORIALS}
    assert len(lines[name]) >= 5
    if name != TUTORIALS[0]:  # what is typed in both is typed once
        lines[name] = [line for line in lines[name] if line not in lines[TUTORIALS[0]]]
    for line in lines[name]:
        program, *words = shlex.split(line)
        if program == "pip":
            assert re.fullmatch(r"pip install '\.\[[a-z]+\]'", line)
            continue
        answer = command(*words)
        assert (program, answer.code) == ("gvo", 0), f"{line}: {answer.err}"


@pytest.mark.usefixtures(
    "page_that_ends", "undrawn_reports", "undrawn_plots", "workers_in_this_process"
)
@pytest.mark.parametrize(("page", "lines"), commands())
def test_commands_in_the_documentation_run(
    workplace: Path, command: Command, page: str, lines: list[str]
) -> None:
    for line in lines:
        answer = command(*shlex.split(line)[1:])
        assert answer.code == 0, f"{page}: {line}: {answer.err}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_the_reference_has_every_public_name() -> None:
    page = (ROOT / "docs/api.md").read_text()
    shown = re.findall(r"^\.\. auto\w+:: (?:gvo\.)?(\w+)(?:\(\))?$", page, re.MULTILINE)
    assert {*dir(gvo)} - {"__version__", *shown} == set()
