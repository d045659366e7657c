"""The frames that were tracked, kept so that any can be shown again."""

from __future__ import annotations

import io
import tempfile
import weakref
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from threading import Lock, RLock
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.types import Estimate, FloatArray, FrameLink, FrameResult, ImageArray, IntArray, Status
from gvo.viz.view.clouds import Cloud, KeyframeClouds, accumulate

# Stamps (n,) in nanoseconds, ascending, and positions (n, 3) in the world, metres.
Path: TypeAlias = tuple[IntArray, FloatArray]
_JPEG_QUALITY = 85


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """What is kept of a frame.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.
    result : FrameResult or None
        None for a faulty frame. Kept without `registration`.
    reason : str
        Why there is no pose, or no registration; empty where there are.
    image, overlay : ndarray of uint8, shape (height, width, 3)
        The image, small, and the image with its matches, BGR.
    cloud : tuple of ndarray
        Points that the frame measured, in the `cam` frame, and their colours.
    window_poses : dict of int to ndarray of float64, shape (4, 4)
        T_world_frame of the newest poses in the window and of its keyframes, by stamp.
    window_covariances : dict of int to ndarray of float64, shape (6, 6)
        Of the same, in the poses' own frames.
    """

    stamp_ns: int
    result: FrameResult | None
    reason: str
    image: ImageArray
    overlay: ImageArray
    cloud: Cloud
    window_poses: dict[int, FloatArray]
    window_covariances: dict[int, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameView(FrameRecord):
    """All that a page shows of a frame.

    Parameters
    ----------
    index : int
        Of the frame in the recording, from 0; faulty ones count.
    T_world_frame : ndarray of float64, shape (4, 4)
        Causal pose; for a faulty frame that of the frame before, the identity before any.
    """

    index: int
    T_world_frame: FloatArray

    @classmethod
    def of(cls, record: FrameRecord, index: int, T_world_frame: FloatArray) -> FrameView:
        """Return a record with what was known with it."""
        kept = {field.name: getattr(record, field.name) for field in fields(record)}
        return cls(**kept, index=index, T_world_frame=T_world_frame)

    @property
    def status(self) -> Status | None:
        """What ties the frame to earlier ones; None for a faulty frame."""
        return None if self.result is None else self.result.status

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Stamps of the keyframes, oldest first."""
        return () if self.result is None else self.result.keyframes_ns

    @property
    def links(self) -> tuple[FrameLink, ...]:
        """The edges that were offered to the window with the frame."""
        return () if self.result is None else self.result.links


class History:
    """The frames that are done, and the paths up to the one that is shown.

    Poses and counts lie in memory, pictures, points and the poses of the window in a temporary
    file. It may be asked from any thread.

    Parameters
    ----------
    first_index : int
        Of the first frame in the recording.

    Attributes
    ----------
    shown : int
        Index of the frame that is shown, up to which the paths go.
    """

    def __init__(self, first_index: int = 0) -> None:
        self.first_index = first_index
        self.shown = first_index - 1
        self._arrays = DiskList()
        self._lock = RLock()
        # Of each frame: stamp, result without registration, reason.
        self._told: list[tuple[int, FrameResult | None, str]] = []
        self._latest: tuple[int, FrameRecord] | None = None
        # Of each frame with a pose: its index and stamp, and its raw and causal pose. Of each final
        # smoothed pose: the index of the frame with which it became final, its stamp, and the pose.
        self._tracked = _Rows(2, np.int64)
        self._poses = {name: _Rows(16, np.float64) for name in ("raw", "causal")}
        self._finishing = _Rows(2, np.int64)
        self._finished = _Rows(16, np.float64)
        self._keyframes: list[int] = []
        self._clouds = KeyframeClouds()

    @property
    def n_done(self) -> int:
        """Frames that are done: the index of the last one, and 1."""
        return self.first_index + len(self._told)

    def add(self, record: FrameRecord) -> None:
        """Keep the next frame; it is not shown yet."""
        index = self.n_done
        with self._lock:
            self._arrays.append(_arrays_of(record))
            result = record.result
            if result is not None:
                result = replace(result, registration=None)
            self._told.append((record.stamp_ns, result, record.reason))
            self._latest = index, replace(record, result=result)
            if result is None:
                return
            self._tracked.append((index, record.stamp_ns))
            self._poses["raw"].append(result.raw.T_world_frame.ravel())
            self._poses["causal"].append(result.causal.T_world_frame.ravel())
            self._note_finished(index, result.finished)
            if record.stamp_ns in result.keyframes_ns:
                self._keyframes.append(index)
                self._clouds.add(index, record.cloud)

    def finish(self, estimates: Iterable[Estimate]) -> None:
        """Add the smoothed poses that are known with the last frame."""
        with self._lock:
            self._note_finished(self.n_done - 1, estimates)

    def _note_finished(self, index: int, estimates: Iterable[Estimate]) -> None:
        for estimate in estimates:
            self._finishing.append((index, estimate.stamp_ns))
            self._finished.append(estimate.T_world_frame.ravel())

    def show(self, index: int) -> None:
        """Set the frame shown, up to which the paths go.

        Raises
        ------
        ValueError
            When it is not done, or was before the first.
        """
        self._check(index)
        self.shown = index

    def stamp_ns(self, index: int) -> int:
        """Return the stamp of a frame that is done, nanoseconds."""
        self._check(index)
        return self._told[index - self.first_index][0]

    def frame_view(self, index: int | None = None) -> FrameView:
        """Return what a page shows of a frame.

        Parameters
        ----------
        index : int, optional
            The one that is shown where omitted.

        Raises
        ------
        ValueError
            When it is not done.
        """
        with self._lock:
            index = self.shown if index is None else index
            record = self._record(index)
            _, causal = self._known("causal", index)
            return FrameView.of(record, index, causal[-1] if len(causal) else np.eye(4))

    def path(self, name: str) -> Path:
        """Return stamps (n,) and positions (n, 3) up to the frame shown.

        Parameters
        ----------
        name : {"raw", "causal", "smoothed"}
            The raw chain; poses as they were known when each frame came; as of the frame shown.
        """
        with self._lock:
            is_smoothed = name == "smoothed"
            stamps_ns, poses = self._smoothed() if is_smoothed else self._known(name, self.shown)
            return stamps_ns.copy(), poses[:, :3, 3].copy()

    def loop_lines(self) -> FloatArray:
        """Return both ends of the loops so far as of the frame shown, shape (n, 2, 3), metres."""
        with self._lock:
            told = self._told[: self.shown + 1 - self.first_index]
            loops = [loop for _, result, _ in told if result is not None for loop in result.loops]
            if not loops:
                return np.zeros((0, 2, 3))
            stamps_ns, T_world_frame = self._smoothed()
            ends_ns = [(loop.reference_ns, loop.stamp_ns) for loop in loops]
            return T_world_frame[np.searchsorted(stamps_ns, ends_ns), :3, 3]

    def accumulated_cloud(self) -> Cloud:
        """Return the points of all keyframes in the world, metres, and their colours, RGB.

        Placed by the smoothed poses as of the frame shown; thinned to at most 200,000.
        """
        with self._lock:
            _, T_world_frame = self._smoothed()
            keyframes = self._keyframes[: bisect_right(self._keyframes, self.shown)]
            rows = np.searchsorted(self._tracked.rows[: len(T_world_frame), 0], keyframes)
            clouds = self._clouds.select(dict(zip(keyframes, T_world_frame[rows], strict=True)))
        return accumulate(clouds)

    def _check(self, index: int) -> None:
        if not self.first_index <= index < self.n_done:
            raise ValueError(
                f"frame {index} is not among those done: {self.first_index} to {self.n_done - 1}"
            )

    def _record(self, index: int) -> FrameRecord:
        self._check(index)
        if self._latest is None or self._latest[0] != index:
            row = index - self.first_index
            self._latest = index, _record_of(*self._told[row], self._arrays[row])
        return self._latest[1]

    def _known(self, name: str, index: int) -> tuple[IntArray, FloatArray]:
        """Return stamps and raw or causal poses of all frames up to one."""
        n = int(np.searchsorted(self._tracked.rows[:, 0], index, side="right"))
        return self._tracked.rows[:n, 1], self._poses[name].rows[:n].reshape(-1, 4, 4)

    def _smoothed(self) -> tuple[IntArray, FloatArray]:
        """Return stamps and the best poses as of the frame shown: final, window or causal."""
        stamps_ns, causal = self._known("causal", self.shown)
        poses = causal.copy()
        if len(stamps_ns) == 0:
            return stamps_ns, poses
        window = self._record(self.shown).window_poses
        known = [stamp_ns for stamp_ns in window if stamp_ns <= stamps_ns[-1]]
        if known:
            poses[np.searchsorted(stamps_ns, known)] = [window[stamp_ns] for stamp_ns in known]
        is_final = self._finishing.rows[:, 0] <= self.shown
        rows = np.searchsorted(stamps_ns, self._finishing.rows[is_final, 1])
        poses[rows] = self._finished.rows[is_final].reshape(-1, 4, 4)
        return stamps_ns, poses


class _Rows:
    """An array that grows by rows."""

    def __init__(self, width: int, dtype: type) -> None:
        self._array: NDArray[Any] = np.empty((64, width), dtype=dtype)
        self._n = 0

    def append(self, row: Any) -> None:  # noqa: ANN401 - whatever numpy takes
        if self._n == len(self._array):
            self._array = np.concatenate([self._array, np.empty_like(self._array)])
        self._array[self._n] = row
        self._n += 1

    @property
    def rows(self) -> NDArray[Any]:
        return self._array[: self._n]


def _arrays_of(record: FrameRecord) -> dict[str, NDArray[Any]]:
    return {
        "image": _encode(record.image),
        "overlay": _encode(record.overlay),
        "points": record.cloud[0],
        "colours": record.cloud[1],
        "window_ns": np.array(list(record.window_poses), dtype=np.int64),
        "poses": np.array(list(record.window_poses.values())),
        "covariances": np.array(list(record.window_covariances.values())),
    }


def _record_of(
    stamp_ns: int, result: FrameResult | None, reason: str, arrays: dict[str, NDArray[Any]]
) -> FrameRecord:
    window_ns = arrays["window_ns"].tolist()
    return FrameRecord(
        stamp_ns=stamp_ns,
        result=result,
        reason=reason,
        image=_decode(arrays["image"]),
        overlay=_decode(arrays["overlay"]),
        cloud=(arrays["points"], arrays["colours"]),
        window_poses=dict(zip(window_ns, arrays["poses"], strict=True)),
        window_covariances=dict(zip(window_ns, arrays["covariances"], strict=True)),
    )


def _encode(image: ImageArray) -> ImageArray:
    """Return a picture as the bytes of a JPEG."""
    _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return np.asarray(content, dtype=np.uint8)


def _decode(content: ImageArray) -> ImageArray:
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), dtype=np.uint8)


class DiskList:
    """A list of named arrays in an unnamed temporary file, which is gone with the object."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the object
        weakref.finalize(self, self._file.close)
        self._ends = [0]
        self._lock = Lock()

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._ends) - 1

    def append(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write arrays at the end.

        Raises
        ------
        ValueError
            When an array holds Python objects.
        """
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        with self._lock:
            self._file.seek(self._ends[-1])
            self._file.write(content.getbuffer())
            self._ends.append(self._file.tell())

    def __getitem__(self, index: int) -> dict[str, NDArray[Any]]:
        """Read the arrays of an item.

        Raises
        ------
        IndexError
            When there is none.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is not among {len(self)} items")
        with self._lock:
            start, end = self._ends[index : index + 2]
            self._file.seek(start)
            content = io.BytesIO(self._file.read(end - start))
        with np.load(content, allow_pickle=False) as arrays:
            return dict(arrays)
