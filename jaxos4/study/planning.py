"""The work that a study still needs, before it is run."""

from pathlib import Path
from typing import NamedTuple

import jax

from .cell import programs_of
from .network_jobs import job_of, jobs
from .specification import Study
from .store import Store, check_store


class Plan(NamedTuple):
    """The remaining work of an estimator.

    - `programs`, `networks`: how many are to be compiled, and to be trained.
    - `seconds`: for the cells on this process's devices, without the training of networks, from the mean time of this
      estimator's finished cells; `None` if none is finished.
    """

    estimator: str
    cells: int
    flights: int
    programs: int
    networks: int
    seconds: float | None


def plan(study: Study, directory: Path) -> list[Plan]:
    """A row for each estimator. Programs and networks count for the first estimator that needs them.

    Raises `InputError` as `open_store`.
    """
    store = check_store(directory, study)
    remaining = [study.cell(index) for index in store.missing()]
    means, rows = _mean_seconds(store), []
    trained = {job for number, job in enumerate(jobs(study)) if store.network_file(number).exists()}
    compiled: set[tuple] = set()
    devices = len(jax.local_devices())
    for estimator in study.estimators:
        cells = [cell for cell in remaining if cell.scenario.estimator == estimator]
        flights = sum(min(study.batch, study.flights - cell.first) for cell in cells)
        networks = {job_of(study, cell.scenario) for cell in cells if cell.scenario.needs_network} - trained
        trained |= networks
        seconds = means[estimator] * len(cells) / devices if estimator in means else None
        programs = {program for cell in cells for program in programs_of(study, cell)} - compiled
        compiled |= programs
        rows.append(Plan(estimator, len(cells), flights, len(programs), len(networks), seconds))
    return rows


def _mean_seconds(store: Store) -> dict[str, float]:
    """The mean time of a finished cell, by estimator, from the study's log."""
    seconds: dict[str, list[float]] = {}
    for entry in store.read_log():
        if "cell" in entry:
            seconds.setdefault(store.study.cell(entry["cell"]).scenario.estimator, []).append(entry["seconds"])
    return {estimator: sum(times) / len(times) for estimator, times in seconds.items()}
