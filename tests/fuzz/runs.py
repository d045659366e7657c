"""Run folders: what a run left, or is still writing."""

import json
from functools import cache

from gvo.io.run_folder.reader import read_run
from gvo.trajectory.formats import COVARIANCE_HEADER
from tests.fuzz.mutations import mutate_behind_first
from tests.fuzz.target import Folder, Target

_COVARIANCE = (
    f"{COVARIANCE_HEADER}\n1500000000," + ",".join(["1", *["0"] * 5, "1", *["0"] * 14]) + "\n"
)
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
            "T_base_truth": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]],
            "ground_truth_stamps_from": "file",
        }
    ),
}
_NAMES = tuple(_FILES)


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


TARGETS = (
    Target(
        name="run_folders",
        run=_run_folder,
        seeds=lambda: [bytes([n]) + _FILES[name].encode() for n, name in enumerate(_NAMES)],
        mutate=mutate_behind_first,
    ),
)
