"""A recording checked before odometry runs: stamps, images, calibration, frames."""

from gvo.diagnostics.check.findings import CheckResult, Finding, format_check
from gvo.diagnostics.check.recording import check_recording

__all__ = ["CheckResult", "Finding", "check_recording", "format_check"]
