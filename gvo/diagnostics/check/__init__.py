"""What is in a recording, and what is wrong with it, before odometry runs over it."""

from gvo.diagnostics.check.findings import CheckResult, Finding, format_check
from gvo.diagnostics.check.recording import check_recording

__all__ = ["CheckResult", "Finding", "check_recording", "format_check"]
