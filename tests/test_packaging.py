"""What builds the package elsewhere says what the README, the metadata and .ci/run say."""

import fnmatch
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
CI = (ROOT / ".ci/run").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
DOCKER = ROOT / "scripts/docker/Dockerfile"


def two_commands() -> list[str]:
    block = re.search(r"^```\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    assert block is not None
    clone, *commands = block[1].splitlines()
    assert clone.startswith("git clone <this repository> ")
    return commands


def jobs() -> dict[str, Any]:
    text = (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text)["jobs"])


def lines_of(job: str) -> list[str]:
    return [line for step in jobs()[job]["steps"] for line in step.get("run", "").splitlines()]


def pythons() -> list[str]:
    found = [re.fullmatch(r".* :: (3\.\d+)", line) for line in PROJECT["classifiers"]]
    return [match[1] for match in found if match]


def test_the_workflow_runs_the_two_commands_of_the_readme_on_all_systems() -> None:
    assert lines_of("readme") == two_commands()
    matrix = jobs()["readme"]["strategy"]["matrix"]
    assert matrix["python"] == pythons()
    systems = {name.split("-")[0] for name in matrix["os"]}
    named = {line for line in PROJECT["classifiers"] if line.startswith("Operating System")}
    assert systems == {"ubuntu", "macos"}
    assert named == {"Operating System :: MacOS", "Operating System :: POSIX :: Linux"}


def test_the_workflow_checks_what_ci_checks() -> None:
    block = re.search(r"<<'LINT' &\n(.*?)^LINT$", CI, re.DOTALL | re.MULTILINE)
    assert block is not None
    install, *checks = lines_of("checks")
    assert checks == block[1].splitlines()
    assert install in CI.splitlines()


def test_the_workflow_builds_a_wheel_with_every_extra_of_users_and_audits_it() -> None:
    lines = lines_of("package")
    extras = set(PROJECT["optional-dependencies"]) - {"test", "test-all", "dev", "docs"}
    (installed,) = [set(found.split(",")) for found in re.findall(r"\[(.*?)\]", "".join(lines))]
    assert installed == extras
    assert any("pip wheel" in line for line in lines)
    assert lines[-1].endswith("pip-audit")


def docker_steps() -> list[tuple[str, str]]:
    """Return instruction and arguments of each line of the Dockerfile."""
    lines = [line for line in DOCKER.read_text().splitlines() if line and line[0] != "#"]
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in lines)]


def arguments(name: str) -> list[str]:
    """Return the arguments of every such instruction of the Dockerfile."""
    return [rest for found, rest in docker_steps() if found == name]


def copied() -> list[str]:
    return [source for rest in arguments("COPY") for source in rest.split()[:-1]]


def test_the_image_holds_what_the_package_is_built_from() -> None:
    ignored = (DOCKER.parent / "Dockerfile.dockerignore").read_text().splitlines()
    assert [path for path in copied() if not (ROOT / path).exists()] == []
    assert {line.removeprefix("!") for line in ignored if line.startswith("!")} == {*copied()}
    assert {"pyproject.toml", PROJECT["readme"], "LICENSE", "gvo"} == {*copied()}
    assert fnmatch.filter(copied(), ignored[0]) == copied()


def test_the_image_runs_the_command_as_no_root_on_a_folder_of_data() -> None:
    assert re.fullmatch(r"python:(3\.\d+)-slim", arguments("FROM")[0])[1] in pythons()  # type: ignore[index]
    (entry,) = [yaml.safe_load(rest) for rest in arguments("ENTRYPOINT")]
    assert entry == [*PROJECT["scripts"]]
    (user,) = arguments("USER")
    assert user != "root"
    assert any(f"useradd --create-home {user}" in rest for rest in arguments("RUN"))
    assert arguments("VOLUME") == [arguments("WORKDIR")[-1]] == ["/data"]
    assert [name for name, _ in docker_steps()][-1] == "ENTRYPOINT"


@pytest.mark.parametrize("page", ["README.md", "docs/installation.md"])
def test_every_extra_that_a_page_names_is_there(page: str) -> None:
    named = re.findall(r"pip install (?:-e )?'\.\[(.*?)\]'", (ROOT / page).read_text())
    extras = {extra for names in named for extra in names.split(",")}
    assert extras
    assert extras <= set(PROJECT["optional-dependencies"])
