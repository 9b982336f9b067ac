from .flight_page import write_flight_page as write_flight_page
from .identification_page import print_identification as print_identification
from .reading import read_results as read_results
from .terminal import error_table as error_table
from .writing import write_report as write_report
