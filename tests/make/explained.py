"""Frames of short rendered recordings, explained."""

from functools import cache

from gvo.config import Config, load_configuration
from gvo.diagnostics.explain import FrameExplanation, explain_frame
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording

LAST = 4
KINDS = ("klt", "descriptor")


def configuration(kind: str, *settings: str) -> Config:
    return load_configuration(settings=[f"frontend.kind={kind}", *settings])


@cache
def recording(sensor: Sensor) -> SyntheticRecording:
    return SyntheticRecording("handheld", sensor, n_frames=LAST + 1, scale=0.4)


@cache
def explained(kind: str, sensor: Sensor, index: int = LAST, *settings: str) -> FrameExplanation:
    return explain_frame(recording(sensor), index, config=configuration(kind, *settings))
