"""Two processes do not write one run folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from gvo.errors import OutputError, RunBusyError
from gvo.io.run_folder.writer import written_alone

# Holds a folder until its standard input ends.
_HOLDER = """
import sys
from pathlib import Path
from gvo.io.run_folder.writer import written_alone
with written_alone(Path(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_a_folder_that_another_process_writes_is_busy_until_that_ends(tmp_path: Path) -> None:
    out = tmp_path / "a" / "out"
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", _HOLDER, str(out)]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as holder:
        assert holder.stdout is not None
        try:
            assert holder.stdout.readline() == "ready\n"
            for _ in range(2):
                with (
                    pytest.raises(RunBusyError, match=f"^{out}: another process is writing"),
                    written_alone(out),
                ):
                    pytest.fail("both write")
        finally:
            holder.kill()
            holder.communicate()
    with written_alone(out):
        assert [path.name for path in out.iterdir()] == ["run.lock"]
    assert list(out.iterdir()) == []


def test_a_folder_is_free_again_whatever_ended_the_run(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), written_alone(tmp_path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="file: cannot be written"),
        written_alone(tmp_path / "file"),
    ):
        pytest.fail("it is no folder")


def test_a_link_leads_nowhere(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="cannot be written"), written_alone(tmp_path / "out"):
        pytest.fail("it leads out of the folder")
    assert not (tmp_path / "elsewhere").exists()
