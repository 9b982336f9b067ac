"""RMS error and bound of each parameter, and RMSE / bound, against the noise scale."""

from experiments.shared import of_study, plotter, read_by_noise
from jaxos4.report.study_page import efficiency, errors

main = plotter(read_by_noise, {"noise_study-error": of_study(errors), "noise_study-efficiency": of_study(efficiency)})
