"""Noise studies: a specification, its cells, the folder that keeps them, and the Dataset of their results."""

from .cell import OUTCOMES as OUTCOMES
from .dataset import (
    RESULTS_FILE as RESULTS_FILE,
    Store as Store,
    assemble as assemble,
    open_store as open_store,
    provenance as provenance,
    read_results as read_results,
    read_store as read_store,
    save_dataset as save_dataset,
)
from .run import (
    Step as Step,
    carry_out as carry_out,
    device_name as device_name,
    plan as plan,
    run_here as run_here,
    run_on_cluster as run_on_cluster,
)
from .specification import Study as Study, Training as Training, load_study as load_study
