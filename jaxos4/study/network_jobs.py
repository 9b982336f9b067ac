"""The networks that a study needs, and their training."""

import equinox as eqx
import jax
import numpy as np

from ..bracket import Bracket
from ..estimators import ESTIMATORS
from ..models.state import CHANNELS
from ..networks import NetworkEstimator, TrainedNetwork
from ..shooting import ShootingProblem
from .flights import blank_problem, fleet_of, key_of
from .specification import Cell, Job, Scenario, Study


def jobs(study: Study) -> list[Job]:
    """The networks that a study needs."""
    scenarios = (study.cell(index).scenario for index in range(0, study.count, study.blocks))
    return list(dict.fromkeys(job_of(study, scenario) for scenario in scenarios if scenario.needs_network))


def job_of(study: Study, scenario: Scenario) -> Job:
    """The network that a scenario's estimator needs."""
    # The hybrid's network only says where to shoot.
    channels = hybrid_channels(study, scenario) if ESTIMATORS[scenario.estimator].shoots else scenario.seen
    return Job(scenario.model, scenario.airframe, scenario.excitation, scenario.duration, scenario.width, channels)


def hybrid_channels(study: Study, scenario: Scenario) -> str:
    """The channels that a hybrid's network looks at."""
    return min(scenario.seen, study.network.hybrid_channels, key=CHANNELS.__getitem__)


def job_number(study: Study, cell: Cell, needed: list[Job]) -> int | None:
    """The place of a cell's network in `needed`, the networks of the study."""
    return needed.index(job_of(study, cell.scenario)) if cell.scenario.needs_network else None


def train_network(study: Study, job: Job) -> TrainedNetwork:
    """Trains a network for all noises and scales of a study. Raises as `NetworkEstimator.fit` does.

    The numbers are the same bit for bit only on the same number of cores, which share the products of matrices.
    """
    with jax.enable_x64(study.double):
        settings, problem, bracket = _training(study, job)
        return settings.fit(problem, bracket, key=key_of(study.network.seed, jobs(study).index(job)))


def blank_network(study: Study, job: Job) -> TrainedNetwork:
    """A network of ones with the shapes of the trained one: programs can be compiled with it during the training."""
    with jax.enable_x64(study.double):
        settings, problem, bracket = _training(study, job)
        shapes = eqx.filter_eval_shape(settings.blank, problem, bracket)
        arrays, others = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
        return eqx.combine(jax.tree.map(lambda leaf: jax.device_put(np.ones(leaf.shape, leaf.dtype)), arrays), others)


def _training(study: Study, job: Job) -> tuple[NetworkEstimator, ShootingProblem, Bracket]:
    scales = [scale or 1.0 for scale in study.scales]
    settings = study.network.estimator(channels=job.channels, noise=(min(scales), max(scales)))
    fleet = fleet_of(study, job)
    return settings, blank_problem(study, fleet, 1.0, job.channels), fleet.bracket
