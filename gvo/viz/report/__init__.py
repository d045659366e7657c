"""The report: one page that shows a run, or estimates beside a reference."""

from gvo.viz.report.comparison import write_comparison_report
from gvo.viz.report.run import write_run_report

__all__ = ["write_comparison_report", "write_run_report"]
