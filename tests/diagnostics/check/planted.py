"""Rendered recordings held in memory, and faults to plant in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

from gvo.config import Config
from gvo.diagnostics.check import CheckResult, Finding, check_recording
from gvo.io.recording import Sensor, Source
from gvo.io.synthetic import SyntheticRecording, WorldName
from tests.make.recordings import Held, hold

N_FRAMES = 26


@cache
def render(world: WorldName, sensor: Sensor, seed: int = 0) -> Held:
    """Return a rendered recording of half the size that keeps what it rendered."""
    source = SyntheticRecording(world, sensor, n_frames=N_FRAMES, seed=seed, scale=0.5)
    return replace(hold(source), truth=None)


def check(recording: Source, *, n_samples: int = 4, **options: Any) -> CheckResult:
    return check_recording(recording, Config(), n_samples=n_samples, **options)


def complaints(found: CheckResult | Mapping[str, Finding]) -> set[str]:
    findings = found.findings if isinstance(found, CheckResult) else found.values()
    return {finding.name for finding in findings if finding.verdict in ("warning", "fault")}


def find(result: CheckResult, name: str) -> Finding:
    (found,) = [finding for finding in result.findings if finding.name == name]
    return found
