"""Two processes do not write one run folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from gvo.errors import OutputError, RunBusyError
from gvo.io.run_folder.writer import check_unused, free_folder, written_alone

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


@pytest.mark.parametrize(
    "name", ["summary.json", "smoothed.txt", "frames.csv", "report.html", "explanation.html"]
)
def test_a_folder_with_an_earlier_result_is_refused(tmp_path: Path, name: str) -> None:
    check_unused(tmp_path)
    (tmp_path / name).write_text("")
    said = rf"{tmp_path}: holds an earlier result \({name}\); .*--out, or --force"
    with pytest.raises(OutputError, match=said):
        check_unused(tmp_path)
    with pytest.raises(OutputError, match=said), written_alone(tmp_path):
        pytest.fail("it is taken")
    check_unused(tmp_path, force=True)
    with written_alone(tmp_path, force=True):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_folder_is_named_after_the_recording_and_numbered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kitti.06").mkdir()
    monkeypatch.chdir(tmp_path / "kitti.06")
    names = {
        "../gvo-demo/drive.mcap": "gvo-drive",
        "day.2.db3.zst": "gvo-day.2",
        str(tmp_path / "kitti.06"): "gvo-kitti.06",
        ".": "gvo-kitti.06",
        "lines": "gvo-lines",
    }
    assert {given: str(free_folder(given)) for given in names} == names
    assert str(free_folder("drive.bag", "-frame-3")) == "gvo-drive-frame-3"
    for number in ("", "-2", "-3"):
        assert str(free_folder("drive.bag")) == f"gvo-drive{number}"
        Path(f"gvo-drive{number}").mkdir()
