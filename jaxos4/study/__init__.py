"""Noise studies: a specification, its cells, the folder that keeps them, and the Dataset of their results."""

from .cell import OUTCOMES as OUTCOMES
from .dataset import read_results as read_results
from .run import device_name as device_name, plan as plan, run_on_cluster as run_on_cluster, run_study as run_study
from .specification import Study as Study, Training as Training, load_study as load_study
