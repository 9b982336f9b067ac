"""What a study would take: cells, flights, memory and time, before it is run."""

from typing import NamedTuple

from ..estimators import ESTIMATORS
from ..networks.network import NetworkEstimator
from .cell import job_of
from .specification import Scenario, Study

# Measured on one core in double precision, at the standard noise: microseconds, and bytes, for a sample of a flight,
# of the rates and of all channels.
_COSTS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "ibss": ((5.0, 20.0), (2000.0, 6000.0)),
    "network": ((0.5, 0.5), (500.0, 500.0)),
    "hybrid": ((2.5, 12.0), (2000.0, 6000.0)),
    "output-error": ((10.0, 60.0), (2000.0, 8000.0)),
    "equation-error": ((6.0, 6.0), (3000.0, 3000.0)),
    "rls": ((9.0, 9.0), (3000.0, 3000.0)),
    "svsf": ((13.0, 13.0), (1000.0, 1000.0)),
    "kalman": ((1.5, 10.0), (1000.0, 6000.0)),
}
# Seconds to compile a program; seconds of training for a step, a flight of its batch, and a sample.
_COMPILING, _TRAINING = 15.0, 5e-8
# MiB of a process before any flight: the interpreter, the compiler, and the programs that it keeps.
_PROCESS = 700.0


class Plan(NamedTuple):
    """What is left to do for an estimator: cells, their flights, memory [MiB] of the process, and time [s]."""

    estimator: str
    cells: int
    flights: int
    memory: float
    seconds: float


def plan(study: Study, missing: list[int], devices: int) -> list[Plan]:
    """A row for each estimator, all `missing` cells told. Rough: other processors, and other noises, take other times.

    Networks count where they are first needed.
    """
    cells, trained, rows = [study.cell(index) for index in missing], set(), []
    for estimator in study.estimators:
        own = [cell for cell in cells if cell.scenario.estimator == estimator]
        programs = {cell.scenario._replace(noise="", scale=0.0, method="") for cell in own}
        flights = sum(min(study.batch, study.flights - cell.first) for cell in own)
        memory = max((_cost(s, 1) * study.batch * _samples(study, s) * devices / 2**20 for s in programs), default=0.0)
        seconds = sum(1e-6 * _cost(cell.scenario, 0) * study.batch * _samples(study, cell.scenario) for cell in own)
        seconds = seconds / devices + _COMPILING * len(programs)
        wanted = {job_of(study, s) for s in programs} - trained if ESTIMATORS[estimator].needs_network else set()
        trained |= wanted
        step = _TRAINING * NetworkEstimator.batch * study.network.steps
        seconds += sum(_COMPILING + step * job.duration / study.dt for job in wanted)
        rows.append(Plan(estimator, len(own), flights, _PROCESS + memory if own else 0.0, seconds))
    return rows


def _samples(study: Study, scenario: Scenario) -> float:
    return scenario.duration / study.dt


def _cost(scenario: Scenario, which: int) -> float:
    """Of a sample of a flight; the attitude lies between the rates and all channels."""
    rates, everything = _COSTS.get(scenario.estimator, _COSTS["ibss"])[which]
    return {"rates": rates, "attitude": (rates + everything) / 2, "all": everything}[scenario.seen]
