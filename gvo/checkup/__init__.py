"""What is in a recording, and what is wrong with it, before odometry runs over it."""

from gvo.checkup.recording import check_recording
from gvo.checkup.report import Checkup, Finding
from gvo.checkup.table import format_checkup

__all__ = ["Checkup", "Finding", "check_recording", "format_checkup"]
