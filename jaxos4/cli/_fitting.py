"""What commands that fit a flight share: the job that it makes, and the fit with the noise that is found."""

import math
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from ..airframe import load_airframe
from ..analysis.fisher import cramer_rao_bound
from ..bracket import Bracket
from ..errors import InputError
from ..estimate import AbstractEstimator, Estimate
from ..flight import STATE_NAMES, Flight
from ..identification.vehicle import NO_ANSWER
from ..logs import read_flight_and_notes
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks import NetworkEstimator, TrainedNetwork
from ..noise import SENSOR_SIGMA
from ..results import RESULTS, result_names
from ..shooting import ShootingProblem
from ._bracket_file import load_bracket
from ._choices import Channels, InitialState, Model

# The noise levels are not known: they are estimated from the residuals, and where one turns out to be off by more than
# this share, the fit is repeated with them. Weights within it cost less than one percent of the efficiency.
OFF = 0.2
PASSES = 4


class Job(NamedTuple):
    """A flight to be explained, where to look, and what was noticed while reading."""

    problem: ShootingProblem
    bracket: Bracket
    notes: tuple[str, ...]


def load_job(
    flight: Path,
    model: Model,
    airframe: str,
    bracket: Path | None,
    channels: Channels | None,
    initial_state: InitialState,
    window: float | None = None,
) -> Job:
    """What the options that commands share ask for. Raises `InputError` for what cannot be used."""
    vehicle = MODELS[model](load_airframe(airframe))
    where = Bracket.default(vehicle) if bracket is None else load_bracket(bracket, vehicle)
    if window is not None and not (math.isfinite(window) and window > 0):
        raise InputError(f"--window: must be a positive number of seconds, got {window:g}.")
    known = initial_state == "known"
    if window is not None and known:
        raise InputError("--window: each window begins in a state of its own; use --initial-state free.")
    recorded, notes = read_flight_and_notes(flight, vehicle.airframe)
    problem = problem_of(flight, vehicle, recorded, channels, known=known, window=window)
    return Job(problem, where, tuple(notes))


def problem_of(
    path: Path,
    model: AbstractModel,
    flight: Flight,
    channels: Channels | None,
    *,
    known: bool,
    window: float | None = None,
) -> ShootingProblem:
    """What is to be explained: the channels that were measured, or those asked for."""
    measured = ~np.isnan(np.asarray(flight.states))
    beyond = {"rates": slice(0, 3), "attitude": slice(3, 6), "all": slice(6, 12)}
    present = {name: measured[:, CASCADE_ORDER[part]].any() for name, part in beyond.items()}
    if not (present["rates"] or present["attitude"]):
        raise InputError(f"{path}: neither rates nor attitude were measured; log p, q, r or phi, theta, psi.")
    chosen = channels.value if channels else [name for name, there in present.items() if there][-1]
    if not present[chosen]:
        missing = ", ".join(STATE_NAMES[i] for i in CASCADE_ORDER[beyond[chosen]])
        raise InputError(f"{path}: --channels {chosen}: none of {missing} was measured; leave --channels out.")
    start = None
    if known:
        needed = CASCADE_ORDER[: CHANNELS[chosen]]
        missing = [STATE_NAMES[i] for i in needed if not measured[0, i]]
        if missing:
            raise InputError(
                f"{path}: row 2: --initial-state known needs {', '.join(missing)} there; use --initial-state free."
            )
        start = jnp.nan_to_num(flight.states[0])
    windows, samples, dt = 1, flight.states.shape[0], float(flight.dt)
    if window is not None:
        if window < 2 * dt:
            raise InputError(f"--window {window:g}: less than two samples of {path}; give at least {2 * dt:g}.")
        windows = min(max(round(samples * dt / window), 1), samples // 2)
    columns = CASCADE_ORDER[: CHANNELS[chosen]]
    if windows > 1:
        absent = [STATE_NAMES[i] for i in columns if not measured[:, i].any()]
        if absent and chosen != "rates":
            raise InputError(
                f"{path}: --window: {', '.join(absent)} were not measured, and no window could tell where it began; "
                "use --channels rates."
            )
    unknowns = len(model.parameter_names) + (0 if known else windows * len(columns))
    if measured[:, columns].sum() <= unknowns:
        raise InputError(
            f"{path}: {measured[:, columns].sum()} measurements for {unknowns} unknowns; give a longer flight"
            + ("." if window is None else ", or fewer windows.")
        )
    return ShootingProblem(model, flight, sigma=SENSOR_SIGMA, initial_state=start, channels=chosen, windows=windows)


def seen_channels(problem: ShootingProblem) -> str:
    """What a network looks at: the rates, or the attitude too where not all of them were measured."""
    rates = np.asarray(problem.flight.states)[:, CASCADE_ORDER[: CHANNELS["rates"]]]
    return "attitude" if problem.size > CHANNELS["rates"] and np.isnan(rates).all(axis=0).any() else "rates"


def fit_network(
    training: NetworkEstimator, flight: Path, problem: ShootingProblem, bracket: Bracket, *, seed: int
) -> TrainedNetwork:
    """A network for a flight's inputs."""
    try:
        return training.fit(problem, bracket, key=jax.random.key(seed), progress=True)
    except ValueError as error:
        raise InputError(f"{flight}: {error}") from None


def fit(
    estimator: AbstractEstimator, problem: ShootingProblem, bracket: Bracket, *, shoots: bool
) -> tuple[ShootingProblem, Estimate, Array, int]:
    """The problem with the noise levels found, the estimate, the Cramer-Rao bound, and the rollouts that it took."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("compiling and fitting", total=PASSES)
        found = jax.block_until_ready(estimator(problem, bracket))
        rollouts = int(found.rollouts)
        for number in range(1, PASSES + 1):
            if str(result_names(found.result)) in NO_ANSWER:
                return problem, found, found.std, rollouts
            used, problem = problem, problem.reweighted(problem.residuals(found.parameters, found.initial_state))
            settled = bool(jnp.all(jnp.abs(problem.sigma / used.sigma - 1) < OFF))
            if settled or number == PASSES or (shoots and found.result != RESULTS.successful):
                break
            progress.update(task, completed=number, description=f"fitting with the noise found in pass {number}")
            found = jax.block_until_ready(estimator(problem, bracket))
            rollouts += int(found.rollouts)
        if not shoots:  # the answers and the errors of the others depend on the noise
            found = jax.block_until_ready(estimator(problem, bracket))
            rollouts += int(found.rollouts)
            if str(result_names(found.result)) in NO_ANSWER:
                return problem, found, found.std, rollouts
        bound = cramer_rao_bound(problem, found.parameters, found.initial_state)
        cost = problem.cost(found.parameters, found.initial_state)
    covariance = bound if shoots else found.covariance
    found = eqx.tree_at(lambda e: (e.covariance, e.cost), found, (covariance, cost))
    return problem, found, jnp.sqrt(jnp.diagonal(bound)), rollouts
