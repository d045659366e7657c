"""Run folders: what a run left, or is still writing."""

import json
import random
from functools import cache
from pathlib import Path

import numpy as np

from gvo.io.run_folder.reader import read_run
from gvo.resuming.journal import Journal
from gvo.resuming.record_file import MAX_RECORD, RecordFile
from gvo.resuming.records import Call, FaultyRecord, FrameRecord, encode
from gvo.types import Failure, FaultyFrame, RelativePose
from tests.fuzz.mutations import mutate_bytes, mutate_text
from tests.fuzz.target import Folder, Target

_COVARIANCE = "h\n1500000000," + ",".join(["1", *["0"] * 5, "1", *["0"] * 14]) + "\n"
_FILES = {
    "frames.csv": "stamp_ns,status,n_inliers,reason\n1500000000,ok,40,\n1600000000,lost,0,dark\n",
    "edges.csv": "stamp_ns,reference_ns,kind,is_accepted,chi2\n1600000000,1500000000,step,1,2.5\n",
    "timings.csv": "stamp_ns,read_ms,window_ms\n1500000000,1.5,\n",
    "raw.txt": "1.500000000 0 0 0 0 0 0 1\n1.600000000 1 0 0 0 0 0 1\n",
    "raw_covariance.csv": _COVARIANCE,
    "causal.txt": "1.500000000 0 0 0 0 0 0 1\n",
    "smoothed.txt": "",
    "ground_truth.txt": "1.5 0 0 0 0 0 0 1\n",
    "summary.json": json.dumps(
        {
            "recording": "x",
            "T_frame_truth": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]],
            "ground_truth_stamps_from": "file",
        }
    ),
}
_NAMES = tuple(_FILES)
_BETWEEN = b"\n--\n"


@cache
def _folder() -> Folder:
    folder = Folder()
    for name, text in _FILES.items():
        folder.write(name, text.encode())
    return folder


def _run_folder(data: bytes) -> None:
    """Replace the file that the first byte chooses, read the folder, then mend it again."""
    name = _NAMES[data[0] % len(_NAMES) if data else 0]
    folder = _folder()
    folder.write(name, data[1:])
    try:
        record = read_run(folder.path)
        record.comparable()
        str(record.name)
    finally:
        folder.write(name, _FILES[name].encode())


def _mutate_behind_first(data: bytes, rng: random.Random) -> bytes:
    return data[:1] + mutate_text(data[1:], rng)


def _journal(data: bytes) -> None:
    """Read a journal whose check sums are right: what is in its records is not."""
    path = _folder().path / "journal.bin"
    with RecordFile(path, is_new=True) as file:
        file.append(b"{}")
        for payload in data.split(_BETWEEN):
            file.append(payload[:MAX_RECORD])
    _read_journal(path)


def _journal_file(data: bytes) -> None:
    _read_journal(_folder().write("journal.bin", data))


def _read_journal(path: Path) -> None:
    journal = Journal.open(path)
    if journal is None:
        return
    with journal:
        for record in journal.past():
            encode(record)


def _record_seeds() -> list[bytes]:
    pose = RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        matches=np.zeros((3, 2), dtype=np.int64),
        inliers=np.array([True, True, False]),
    )
    failure = Failure(reason="dark", n_matches=3, n_inliers=0)
    calls = (
        Call(kind="register", reference_ns=5, has_prior=True, result=pose),
        Call(kind="relocalize", reference_ns=5, has_prior=False, result=failure),
    )
    frame = FrameRecord(
        stamp_ns=6,
        n_keypoints=3,
        n_points=2,
        calls=calls,
        points_cam=np.ones((2, 3)),
        learnt=(),
        stage_ms={"read": 1.5},
    )
    faulty = FaultyRecord(frame=FaultyFrame(stamp_ns=7, reason="dark"), read_ms=1.0)
    records = [encode(frame), encode(faulty)]
    return [*records, _BETWEEN.join(records)]


def _mutate_record(data: bytes, rng: random.Random) -> bytes:
    """Change the text of a record and mend its length, half of the time; else any bytes."""
    length = int.from_bytes(data[:4], "little")
    if rng.random() < 0.5 or not 0 < length <= len(data) - 4:
        return mutate_bytes(data, rng)
    text = mutate_text(data[4 : 4 + length], rng)
    return len(text).to_bytes(4, "little") + text + data[4 + length :]


def _file_seeds() -> list[bytes]:
    for seed in _record_seeds():
        _journal(seed)
    return [(_folder().path / "journal.bin").read_bytes(), b"gvo journal 1\n"]


TARGETS = (
    Target(name="journals", run=_journal, seeds=_record_seeds, mutate=_mutate_record),
    Target(name="journal_files", run=_journal_file, seeds=_file_seeds, mutate=mutate_bytes),
    Target(
        name="run_folders",
        run=_run_folder,
        seeds=lambda: [bytes([n]) + _FILES[name].encode() for n, name in enumerate(_NAMES)],
        mutate=_mutate_behind_first,
    ),
)
