"""The report: one page that shows a run, or estimates beside a reference."""

from gvo.outputs.report.comparison_report import write_comparison_report
from gvo.outputs.report.run_report import write_run_report

__all__ = ["write_comparison_report", "write_run_report"]
