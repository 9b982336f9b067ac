"""Reports: of a study from its Dataset to figures, tables and one HTML page; of one identified flight a page."""

from .flight_page import write_flight_page as write_flight_page
from .reading import read_results as read_results
from .terminal import error_table as error_table
from .writing import write_report as write_report
