"""The report of a study: from its Dataset to figures, tables and one HTML page."""

from .reading import read_results as read_results
from .terminal import error_table as error_table
from .writing import write_report as write_report
