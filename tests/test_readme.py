"""What the pages name of gvo is there: commands, options, and what the comparison claims."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
from typer.main import get_command

import gvo
from gvo.cli.main import app
from gvo.io.recording import Sensor
from gvo.trajectory.evaluation import Consistency

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def commands() -> dict[str, set[str]]:
    """Return each command with its options."""
    group = get_command(app)
    return {
        name: {"--help", "-h"}.union(*([*p.opts, *p.secondary_opts] for p in command.params))
        for name, command in getattr(group, "commands").items()  # noqa: B009 - untyped
    }


COMMANDS = commands()


def spans(page: Path) -> list[str]:
    """Return what stands between back-ticks within the sentences of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]


def unknown(span: str) -> list[str]:
    """Return what gvo has not of a command line within a sentence."""
    found = re.match(r"gvo ([a-z][\w-]*)(.*)", span)
    if found is None:
        return []
    if found[1] not in COMMANDS:
        return [found[1]]
    return sorted({*re.findall(r"(?<!\S)--?[a-zA-Z][\w-]*", found[2])} - COMMANDS[found[1]])


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name
)
def test_commands_and_options_within_sentences_are_there(page: Path) -> None:
    assert [span for span in spans(page) if unknown(span)] == []


def compared() -> dict[str, tuple[str, str]]:
    """Return the comparison with others: what each has, and what gvo has."""
    section = README.partition("\n## Beside others\n")[2].partition("\n## ")[0]
    row = re.compile(r"^\| \[(.+?)\]\(https://github\.com/\S+/\S+\) \| (.+) \| (.+) \|$", re.M)
    rows = {name: (theirs, ours) for name, theirs, ours in row.findall(section)}
    assert len(rows) == section.count("\n| [")
    return rows


def claims(cell: str) -> set[str]:
    return {*re.split(r"[,;] ", cell)}


def test_the_readme_compares_gvo_with_others_in_both_directions() -> None:
    rows = compared()
    assert {"ORB-SLAM3", "RTAB-Map", "KISS-ICP", "evo"} <= {*rows}
    for theirs, ours in rows.values():
        assert claims(theirs)
        assert claims(ours)
        assert not claims(theirs) & claims(ours)


def takes(*words: str) -> Callable[[], bool]:
    """Return whether gvo needs nothing of such a name to be installed."""
    return lambda: not any(word in need for need in PROJECT["dependencies"] for word in words)


def has(*names: str) -> Callable[[], bool]:
    """Return whether commands, public names and files are there."""

    def is_there(name: str) -> bool:
        if "/" in name:
            return (ROOT / name).exists()
        return name in COMMANDS or name in gvo.__all__

    return lambda: all(map(is_there, names))


EVIDENCE: dict[str, Callable[[], bool]] = {
    "covariances of its poses": lambda: "covariance" in gvo.Estimate.__dataclass_fields__,
    "estimated covariances": lambda: "covariance" in gvo.Estimate.__dataclass_fields__,
    "one `pip install`": lambda: "&& pip install . &&" in README,
    "bags without ROS": takes("rclpy", "rospy"),
    "bags and live topics without an installation of ROS 2": has("live", "gvo/live/dds.py"),
    "a licence without copyleft": lambda: PROJECT["license"] == "MIT",
    "a frame explained step by step": has("explain"),
    "cameras": has("StereoFrame", "RgbdFrame"),
    "a smoother (it takes KISS-ICP's poses)": has(
        "SlidingWindow", "smooth", "scripts/smooth_pose_stream.py"
    ),
    "no GPU needed": takes("torch", "cuda", "cupy"),
    "odometry itself": has("run", "Odometry"),
    "covariances compared with errors": lambda: hasattr(Consistency, "mean_nees"),
    "KITTI's segment errors": lambda: "segments_m" in gvo.Evaluation.__dataclass_fields__,
}
"""What shows a claim of the comparison."""


def test_what_the_readme_claims_of_gvo_beside_others_is_there() -> None:
    claimed = set().union(*(claims(ours) for _, ours in compared().values()))
    assert claimed == {*EVIDENCE}
    assert [claim for claim in sorted(claimed) if not EVIDENCE[claim]()] == []


def test_what_the_readme_says_that_gvo_has_not_is_not_there() -> None:
    assert "it has no IMU, no monocular mode and no maps that\nare kept" in README
    assert get_args(Sensor) == ("stereo", "rgbd")
    assert not any(re.search("I(?:mu|MU)|Mono|Lidar|LiDAR", name) for name in gvo.__all__)


@pytest.mark.parametrize("page", ["README.md", "docs/installation.md"])
def test_every_extra_that_a_page_names_is_there(page: str) -> None:
    named = re.findall(r"pip install (?:-e )?'\.\[(.*?)\]'", (ROOT / page).read_text())
    extras = {extra for names in named for extra in names.split(",")}
    assert extras
    assert extras <= set(PROJECT["optional-dependencies"])
