"""The report of a run, or of estimates compared with a reference, as one page."""

from gvo.viz.report.run import write_comparison_report as write_comparison_report
from gvo.viz.report.run import write_run_report as write_run_report
