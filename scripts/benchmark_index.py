"""Compare indices of binary descriptors on the places of drives that come back.

The places of the first lap are the index, those of the second are looked for. FLANN's LSH cannot
be added to: it is built anew. faiss is compared where it is installed.

Example: python scripts/benchmark.py --seeds 6 --kind block --keep rendered
         python scripts/benchmark_index.py rendered/block-*.mcap
"""

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import gvo
from gvo.frontend.factory import make_frontend
from gvo.frontend.features import PlaceIndex
from gvo.types import FaultyFrame, FloatArray

_EVERY = 3
_FIRST_LAP_S, _SECOND_LAP_S = 36.0, (37.2, 44.4)
_NEAR_M = 3.5
# Bits by which descriptors of one point differ at most.
_MAX_DISTANCE = 50
_HAMMING = 9  # FLANN_DIST_HAMMING


class _Place(NamedTuple):
    drive: int
    elapsed_s: float
    descriptors: NDArray[np.uint8]
    position: FloatArray


def main() -> None:
    """Measure each index."""
    places = [place for drive, path in enumerate(sys.argv[1:]) for place in read(drive, Path(path))]
    first = [place for place in places if place.elapsed_s < _FIRST_LAP_S]
    again = [place for place in places if _SECOND_LAP_S[0] <= place.elapsed_s < _SECOND_LAP_S[1]]
    if not first or not again:
        sys.exit("benchmark_index: name drives of `benchmark.py --kind block`")
    print(f"{len(first)} places, {sum(len(each.descriptors) for each in first)} descriptors")
    print(f"{'index':<24} {'build ms':>9} {'query ms':>9} {'right first %':>14} {'of three %':>11}")
    for name, build, scores in indices(first):
        start = time.process_time()
        index = build()
        built_ms = 1e3 * (time.process_time() - start)
        start = time.process_time()
        found = [scores(index, place.descriptors) for place in again]
        query_ms = 1e3 * (time.process_time() - start) / len(again)
        best = [np.argsort(-each)[:3] for each in found]
        right = np.array(
            [
                [is_near(first[k], place) for k in chosen]
                for chosen, place in zip(best, again, strict=True)
            ]
        )
        shares = 100.0 * right[:, 0].mean(), 100.0 * right.any(axis=1).mean()
        print(f"{name:<24} {built_ms:9.1f} {query_ms:9.2f} {shares[0]:14.1f} {shares[1]:11.1f}")


def read(drive: int, path: Path) -> Iterator[_Place]:
    """Yield every third frame of a drive as a place."""
    source = gvo.open_recording(path)
    frontend: Any = make_frontend(source.info.camera)
    truth = source.ground_truth()
    if truth is None:
        sys.exit(f"{path}: no true poses")
    for index, frame in enumerate(gvo.frames(source)):
        if isinstance(frame, FaultyFrame) or index % _EVERY:
            continue
        descriptors = frontend.describe(frontend.extract(frame)).descriptors_left
        elapsed_s = 1e-9 * (frame.stamp_ns - int(truth.stamps_ns[0]))
        yield _Place(drive, elapsed_s, descriptors, truth.positions[index])


def is_near(first: _Place, second: _Place) -> bool:
    """Tell whether two places are one."""
    distance_m = np.linalg.norm(first.position - second.position)
    return first.drive == second.drive and bool(distance_m < _NEAR_M)


class _Flat:
    """Descriptors of all places in one index of neighbours, which votes for their places."""

    def __init__(self, places: list[_Place]) -> None:
        self.descriptors = np.concatenate([place.descriptors for place in places])
        self._n_places = len(places)
        self._owners = np.repeat(
            np.arange(len(places)), [len(place.descriptors) for place in places]
        )

    def count(self, numbers: NDArray[Any], distances: NDArray[Any]) -> NDArray[Any]:
        """Return the number of near neighbours of each place."""
        is_there = (numbers >= 0) & (numbers < len(self._owners)) & (distances <= _MAX_DISTANCE)
        return np.bincount(self._owners[numbers[is_there]], minlength=self._n_places)

    def flann(self, n_tables: int, n_bits: int, level: int) -> Any:  # noqa: ANN401
        """Build FLANN's LSH."""
        names = "algorithm", "table_number", "key_size", "multi_probe_level"
        tables: Any = dict(zip(names, (6, n_tables, n_bits, level), strict=True))
        return cv2.flann.Index(self.descriptors, tables, _HAMMING)

    def of_flann(self, index: Any, seen: NDArray[np.uint8]) -> NDArray[Any]:  # noqa: ANN401
        """Ask FLANN."""
        numbers, distances = index.knnSearch(seen, 2)
        return self.count(numbers[:, 0], distances[:, 0])

    def faiss(self) -> Any:  # noqa: ANN401
        """Build faiss's multi-hash."""
        import faiss  # type: ignore[import-not-found]

        faiss.omp_set_num_threads(1)
        index = faiss.IndexBinaryMultiHash(256, 8, 16)
        index.add(self.descriptors)
        return index

    def of_faiss(self, index: Any, seen: NDArray[np.uint8]) -> NDArray[Any]:  # noqa: ANN401
        """Ask faiss."""
        distances, numbers = index.search(seen, 1)
        return self.count(numbers[:, 0], distances[:, 0])


def indices(places: list[_Place]) -> Iterator[tuple[str, Callable[[], Any], Callable[..., Any]]]:
    """Yield the name of an index, what builds it, and what scores the places for a view."""
    flat = _Flat(places)
    yield "words of 16 bits", partial(words_of, places), PlaceIndex.scores
    for shape in ((6, 12, 1), (6, 18, 1), (10, 20, 0)):
        name = "FLANN LSH {} x {}, {}".format(*shape)
        yield name, partial(flat.flann, *shape), flat.of_flann
    if find_spec("faiss"):
        yield "faiss multi-hash 8 x 16", flat.faiss, flat.of_faiss


def words_of(places: list[_Place]) -> PlaceIndex:
    """Build the index of the package."""
    index = PlaceIndex()
    for place in places:
        index.add(place.descriptors)
    return index


if __name__ == "__main__":
    main()
