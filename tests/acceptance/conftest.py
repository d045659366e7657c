"""Scripts that are refused what they are asked for."""

import runpy
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
Script = Callable[[str, Sequence[object]], str]


@pytest.fixture
def script(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Script:
    """Return a function that runs a script here, which must refuse, and gives its last line."""

    def refuse(name: str, arguments: Sequence[object]) -> str:
        path = SCRIPTS / f"{name}.py"
        monkeypatch.setattr("sys.argv", [str(path), *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            runpy.run_path(str(path), run_name="__main__")
        assert caught.value.code == 2
        return capsys.readouterr().err.splitlines()[-1]

    monkeypatch.syspath_prepend(SCRIPTS)
    monkeypatch.chdir(tmp_path)
    return refuse
