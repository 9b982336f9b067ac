"""RMSE / bound and coverage against the noise scale; with 10,000 flights their error is below 0.01."""

from experiments.shared import of_study, plotter, read_by_noise
from jaxos4.report.study_page import coverage, efficiency

main = plotter(read_by_noise, {"scale-efficiency": of_study(efficiency), "scale-coverage": of_study(coverage)})
