"""What the page on the architecture says of the package is so."""

import ast
import importlib
import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs/CONTRIBUTING.md").read_text(encoding="utf-8")
PACKAGES = sorted(path.parent for path in (ROOT / "gvo").rglob("__init__.py"))


def first_line(package: Path) -> str:
    docstring = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8")))
    assert docstring
    return docstring.splitlines()[0]


def test_every_room_stands_on_the_page_with_its_first_line() -> None:
    rooms = dict(re.findall(r"^\| `(gvo[\w.]*)` \| (.*) \|$", PAGE, re.MULTILINE))
    found = {
        package.relative_to(ROOT).as_posix().replace("/", "."): first_line(package)
        for package in PACKAGES
    }
    assert rooms == found


def test_the_layers_are_those_that_are_enforced() -> None:
    shown = re.search(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert shown is not None
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    assert tomllib.loads(shown[1])["layers"] == contracts[0]["layers"]


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(gvo\.[\w.]+)", PAGE))))
def test_what_the_page_names_is_there(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    # The compiler of kernels is not imported: it switches compiled kernels off, in the processes
    # that are started later, too.
    try:
        found = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        found = None
    if found is None:
        assert hasattr(importlib.import_module(module), attribute), name
