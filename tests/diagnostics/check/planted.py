"""Rendered recordings held in memory, and faults to plant in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from numpy.typing import NDArray

from gvo.config import Config
from gvo.diagnostics.check import CheckResult, Finding, check_recording
from gvo.errors import RecordingError
from gvo.io.recording import RecordingInfo, Sensor, Source, StampedImage
from gvo.io.synthetic.recording import SyntheticRecording, WorldName
from gvo.trajectory.trajectory import Trajectory

N_FRAMES = 40
Change = Callable[[NDArray[Any]], NDArray[Any]]


@dataclass(frozen=True)
class Held:
    """A recording as a list of images, each loaded once at most."""

    info: RecordingInfo
    items: Sequence[StampedImage]
    damage: str = ""
    loaded: list[int] = field(default_factory=list)
    truth: Trajectory | None = None

    def images(self) -> Iterator[StampedImage]:
        yield from self.items
        if self.damage:
            raise RecordingError(self.damage)

    def ground_truth(self) -> Trajectory | None:
        return self.truth

    def stream(self, number: int) -> list[StampedImage]:
        return [image for image in self.items if image.stream == number]

    def mapped(self, change: Callable[[StampedImage, int], StampedImage | None]) -> Held:
        """Return the recording with each image changed; the number counts within its stream."""
        numbers = [0, 0]
        items = []
        for image in self.items:
            changed = change(image, numbers[image.stream])
            numbers[image.stream] += 1
            if changed is not None:
                items.append(changed)
        return replace(self, items=items)

    def with_pixels(self, change: Change, *, stream: int | None = None) -> Held:
        """Return the recording with the pixels of one stream (or both) changed."""

        def alter(image: StampedImage, _: int) -> StampedImage:
            if stream not in (None, image.stream):
                return image
            return replace(image, load=lambda: change(image.load()))

        return self.mapped(alter)

    def with_stamps(self, change: Callable[[int, int], int], *, stream: int | None = None) -> Held:
        """Return the recording with the stamps changed, given stamp and number."""

        def alter(image: StampedImage, number: int) -> StampedImage:
            if stream not in (None, image.stream):
                return image
            return replace(image, stamp_ns=change(image.stamp_ns, number))

        return self.mapped(alter)


@cache
def render(world: WorldName, sensor: Sensor, seed: int = 0) -> Held:
    """Return a rendered recording of half the size that keeps what it rendered."""
    source = SyntheticRecording(world, sensor, n_frames=N_FRAMES, seed=seed, scale=0.5)
    items = [replace(image, load=cache(image.load)) for image in source.images()]
    return Held(info=source.info, items=items)


def check(recording: Source, *, n_samples: int = 4, **options: Any) -> CheckResult:
    return check_recording(recording, Config(), n_samples=n_samples, **options)


def complaints(found: CheckResult | Mapping[str, Finding]) -> set[str]:
    """Return the names of all warnings and faults."""
    findings = found.findings if isinstance(found, CheckResult) else found.values()
    return {finding.name for finding in findings if finding.verdict in ("warning", "fault")}


def find(result: CheckResult, name: str) -> Finding:
    """Return the finding of this name."""
    (found,) = [finding for finding in result.findings if finding.name == name]
    return found
