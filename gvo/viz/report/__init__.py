"""The report of a run, or of estimates compared with a reference, as one page."""

from gvo.viz.report.run import write_comparison_report, write_run_report

__all__ = ["write_comparison_report", "write_run_report"]
