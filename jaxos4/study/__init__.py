"""Noise studies: a specification, its cells, the folder that keeps them, and the Dataset of their results."""

from .cell_file import OUTCOMES as OUTCOMES
from .cluster import run_on_cluster as run_on_cluster
from .dataset import assemble as assemble, provenance as provenance, save_dataset as save_dataset
from .devices import device_name as device_name, use_all_cores as use_all_cores
from .execution import carry_out as carry_out
from .planning import Plan as Plan, plan as plan
from .run import Step as Step, run_here as run_here
from .specification import Study as Study, Training as Training, load_study as load_study
from .store import RESULTS_FILE as RESULTS_FILE, Store as Store, open_store as open_store, read_store as read_store
