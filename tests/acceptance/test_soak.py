"""A run holds no more memory when it goes on: the soak, a part of its length."""

import gc
import runpy
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.types import Progress

pytestmark = pytest.mark.acceptance

SOAK = Path(__file__).parents[1] / "quality/soak.py"
N_LAP = 8
# There and back once: the ends of the thirds see the same frame.
N_THIRD = 2 * N_LAP - 2
# Frames after the last third: what reads ahead is at work at the end of each.
N_BEYOND = 8
# What is held at the end of the third third and was not at that of the second: a few kilobytes of
# the map for each frame, the counts of durations, Python's own caches and the last few steps of the
# window, but no frame's image.
MAX_GROWTH_BYTES = 8_000 * N_THIRD
MAX_GROWTH_OBJECTS = 80 * N_THIRD


@pytest.fixture(scope="module")
def drive() -> Any:
    """Return the script's drive, back and forth over a few frames."""
    order = [*range(N_LAP), *range(N_LAP - 2, 0, -1)]
    return runpy.run_path(str(SOAK))["EndlessDrive"](3 * N_THIRD + N_BEYOND, order)


class Memory:
    """What Python holds at the end of each third, but what it held before the drive."""

    def __init__(self) -> None:
        gc.collect()
        gc.freeze()
        self.n_bytes: list[int] = []
        self.n_objects: list[int] = []

    def __call__(self, progress: Progress) -> None:
        if progress.n_done % N_THIRD == 0:
            gc.collect()
            self.n_objects.append(len(gc.get_objects()))
            self.n_bytes.append(tracemalloc.get_traced_memory()[0])

    @property
    def growth(self) -> tuple[int, int]:
        return self.n_bytes[2] - self.n_bytes[1], self.n_objects[2] - self.n_objects[1]


def drive_on(drive: Any, out: Path) -> Memory:
    memory, outputs = Memory(), gvo.RunOutputs(report=False)
    tracemalloc.start()
    try:
        result = gvo.run_recording(drive, out, outputs=outputs, on_progress=memory)
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    assert result.summary["tracked"] == 3 * N_THIRD + N_BEYOND
    return memory


def test_a_run_holds_no_more_when_it_goes_on(drive: Any, tmp_path: Path) -> None:
    n_bytes, n_objects = drive_on(drive, tmp_path).growth
    assert n_bytes < MAX_GROWTH_BYTES
    assert n_objects < MAX_GROWTH_OBJECTS
