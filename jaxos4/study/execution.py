"""A study from its specification to its Dataset."""

from collections.abc import Callable, Iterator
from pathlib import Path

import xarray as xr

from .dataset import assemble, save_dataset
from .run import Step, run_here
from .specification import Study
from .store import Store, open_store


def carry_out(
    study: Study,
    out: Path,
    device: str,
    *,
    run: Callable[[Store], Iterator[Step]] = run_here,
    progress: Callable[[Step], None] = lambda step: None,
) -> xr.Dataset:
    """Runs the missing cells of a study and writes its Dataset.

    **Arguments:**

    - `out`: the study's folder; a new one, or one that the same study wrote.
    - `device`: what computes, in words, for the provenance.
    - `run`: `run_here`, or `run_on_cluster` with its client.
    - `progress`: is called after each step.

    **Raises:** what `open_store` and `run` raise.
    """
    with open_store(out, study, device) as store:
        for step in run(store):
            progress(step)
        progress(Step(study.count, "writing the Dataset"))
        dataset = assemble(store)
        save_dataset(dataset, out)
    return dataset
