"""Scripts, run in this process."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import Answer

SCRIPTS = Path(__file__).parents[2] / "scripts"
Script = Callable[..., Answer]
# Behind an installed gvo: the parts of the benchmark are imported by tests.
sys.path.append(str(SCRIPTS.parent))


@pytest.fixture
def script(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> Script:
    """Return a function that runs a script by its name and arguments, in an empty folder."""

    def run(name: str, *arguments: object) -> Answer:
        path = SCRIPTS / f"{name}.py"
        monkeypatch.setattr("sys.argv", [str(path), *map(str, arguments)])
        capfd.readouterr()
        code = 0
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as ended:
            code = int(ended.code or 0)
        return Answer(code, *capfd.readouterr())

    monkeypatch.syspath_prepend(SCRIPTS)
    monkeypatch.chdir(tmp_path)
    return run
