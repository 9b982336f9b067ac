from .comparison import print_comparison as print_comparison, write_comparison as write_comparison
from .design import print_design as print_design, write_design_figure as write_design_figure
from .identification_page import (
    identification_html as identification_html,
    write_flight_page as write_flight_page,
)
from .identification_text import (
    identification_summary as identification_summary,
    print_identification as print_identification,
    print_information as print_information,
)
from .log_page import print_inspection as print_inspection, write_log_page as write_log_page
from .matplotlib_figures import Plots as Plots
from .prediction import (
    print_prediction as print_prediction,
    write_prediction as write_prediction,
    write_prediction_figure as write_prediction_figure,
)
from .study_page import write_report as write_report
from .study_tables import count_outcomes as count_outcomes, error_csv as error_csv, error_table as error_table
