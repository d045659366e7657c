"""How many files and functions a frame passes: the fewer, the easier to follow and to change."""

import sys
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import gvo

_PACKAGE = str(Path(gvo.__file__).parent)
# As many as there are, and a few for what differs between machines: lower them, do not raise them.
_MAX_FILES, _MAX_FUNCTIONS = 40, 300


@pytest.mark.recorded
def test_a_frame_passes_no_more_files_and_functions_than_before(gvo_data: Path) -> None:
    source = gvo.open_recording(gvo_data / "kitti_06_start")
    frames: list[Any] = list(islice(gvo.frames(source), 51))
    odometry, entered = gvo.Odometry(source.info.camera), set()

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        # Comprehensions, lambdas and generators are told with the function that they stand in.
        if event == "call" and code.co_filename.startswith(_PACKAGE) and "<" not in code.co_name:
            entered.add((code.co_filename, code.co_qualname))

    for frame in frames[:10]:
        odometry.track(frame)
    sys.setprofile(note)
    try:
        for frame in frames[10:]:
            odometry.track(frame)
    finally:
        sys.setprofile(None)
    assert len({file for file, _ in entered}) <= _MAX_FILES
    assert 100 < len(entered) <= _MAX_FUNCTIONS
