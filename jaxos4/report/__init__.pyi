from .comparison import print_comparison as print_comparison, write_comparison as write_comparison
from .identification_page import (
    identification_html as identification_html,
    write_flight_page as write_flight_page,
)
from .log_page import write_log_page as write_log_page
from .plots import Plots as Plots
from .prediction import (
    print_prediction as print_prediction,
    write_prediction as write_prediction,
    write_prediction_figure as write_prediction_figure,
)
from .study_page import write_report as write_report
from .study_tables import error_csv as error_csv, error_table as error_table
from .terminal import (
    identification_summary as identification_summary,
    print_identification as print_identification,
)
