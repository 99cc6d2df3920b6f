"""Turns a run's traces into figures and a page: read_run, summarise, print_table, write_page."""

from .page import write_page
from .run import ReportError, Run, read_run
from .summary import Summary, summarise
from .table import print_table

__all__ = ["ReportError", "Run", "Summary", "print_table", "read_run", "summarise", "write_page"]
