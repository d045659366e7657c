"""Two processes do not write one run."""

import contextlib
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.errors import ResumeError, RunBusyError
from gvo.io.synthetic.recording import SyntheticRecording
from gvo.run_tally import Progress

N = 6
NO_REPORT = gvo.RunOutputs(report=False)


@pytest.fixture(scope="module")
def recording() -> SyntheticRecording:
    return SyntheticRecording("handheld", "stereo", n_frames=N, scale=0.25)


@pytest.fixture(scope="module")
def bag(recording: SyntheticRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "walk.mcap"
    gvo.convert(recording, path)
    return path


def run(bag: Path, out: Path, **options: Any) -> gvo.RunResult:
    return gvo.run_recording(gvo.open_recording(bag), out, outputs=NO_REPORT, **options)


def tables_of(out: Path) -> dict[str, bytes]:
    times = ("timings.csv", "summary.json")
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name not in times}


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("is_other", [False, True])
def test_a_folder_that_is_written_is_refused_and_the_first_run_goes_on(
    bag: Path, tmp_path: Path, resume: bool, is_other: bool
) -> None:
    run(bag, tmp_path / "alone")
    out = tmp_path / "out"
    config = gvo.load_configuration(settings=["window.size=3"] if is_other else [])
    refused: list[ResumeError] = []

    def start_another(progress: Progress) -> None:
        if progress.n_done in (1, 4):
            with pytest.raises(RunBusyError, match="another process is writing") as error:
                run(bag, out, config=config, resume=resume)
            refused.append(error.value)

    assert run(bag, out, on_progress=start_another).exit_code == 0
    assert len(refused) == 2
    assert tables_of(out) == tables_of(tmp_path / "alone")


def test_a_folder_is_free_again_when_its_run_was_interrupted(bag: Path, tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.n_done == 3:
            raise KeyboardInterrupt

    for resume in (False, True, False):
        with contextlib.suppress(KeyboardInterrupt):
            run(bag, tmp_path, on_progress=stop)
        assert run(bag, tmp_path, resume=resume).exit_code == 0
