"""`jaxos4 estimate`: the parameters that a flight tells, with their intervals."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import rich.box
import typer
from jaxtyping import Array, Float
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from .._files import write_atomically
from ..airframe import load_airframe
from ..bracket import Bracket
from ..dynamics import CASCADE_ORDER, CHANNELS, MODELS, AbstractModel
from ..errors import InputError
from ..estimators import (
    BASELINES,
    IBSS,
    WITH_PRIOR,
    AbstractEstimator,
    Estimate,
    Hybrid,
    NetworkEstimator,
    TrainedNetwork,
    load_network,
)
from ..flight import STATE_NAMES, STATE_UNITS, Flight
from ..identifiability import Identifiability, identifiability
from ..information import cramer_rao_bound
from ..logs import read_flight_and_notes
from ..noise import SENSOR_SIGMA
from ..results import RESULTS, result_names
from ..shooting import ShootingProblem
from ._bracket_file import load_bracket
from ._check_output import check_output
from ._choices import Channels, Estimator, InitialState, Model

# How long a network is trained that only has to say where to look.
SEED_STEPS = 2000
# The noise levels are not known: they are estimated from the residuals, and where one turns out to be off by more than
# this share, the fit is repeated with them. Weights within it cost less than one percent of the efficiency.
OFF = 0.2
PASSES = 4
# Residuals whose neighbours correlate by more than this are not noise.
COLOURED = 0.3
# Residuals below this share of a channel's largest value are rounding, whatever their correlation.
ROUNDING = 1e-9
# Baselines that look at the body rates, whatever else was measured.
RATES_ONLY = ("equation-error", "rls", "svsf")
# Those that begin with the bracket as what is known, and mix it with what the flight tells.
FILTERS = ("svsf", "kalman")
# Estimators that fit by shooting, and reach the bound: theirs is the covariance that the noise found implies.
SHOOTING = ("ibss", "hybrid", "output-error")
NO_ANSWER = ("nonfinite_trajectory", "bracket_invalid", "network_mismatch")


def estimate(
    flight: Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="The recorded flight.")],
    estimator: Annotated[Estimator, typer.Option(help="The algorithm.")] = Estimator["ibss"],
    model: Annotated[Model, typer.Option(help="The equations: as printed, or corrected.")] = Model["published"],
    airframe: Annotated[str, typer.Option(help="os4, os4-simulator, voos, or a TOML file.")] = "os4",
    bracket: Annotated[Path | None, typer.Option(help="TOML file: alpha1 = \\[lower, upper], ...")] = None,
    channels: Annotated[
        Channels | None, typer.Option(help="What to compare; all that was measured by default.")
    ] = None,
    initial_state: Annotated[
        InitialState, typer.Option(help="free: estimated too; known: the first sample is exact.")
    ] = InitialState["free"],
    network: Annotated[
        Path | None,
        typer.Option(help="A file from `jaxos4 train`, for the network and the hybrid; trained now without it."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="A JSON file to write.")] = None,
) -> None:
    """Estimate alpha_1..8 of a flight, with 95 % intervals."""
    console = Console()
    vehicle = MODELS[model](load_airframe(airframe))
    where = Bracket.default(vehicle) if bracket is None else load_bracket(bracket, vehicle)
    learned = estimator in ("network", "hybrid")
    if network is not None and not learned:
        raise InputError(f"--network: {estimator.value} uses none; say --estimator network or hybrid, or leave it out.")
    if network is not None and estimator == "network" and bracket is not None:
        raise InputError("--bracket: the network looks in the bracket that it was trained in; leave one of them out.")
    if out is not None:
        check_output(out, flight, Path(airframe), bracket, network)
    trained = None if network is None else load_network(network)
    recorded, notes = read_flight_and_notes(flight, vehicle.airframe)
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    problem = problem_of(flight, vehicle, recorded, channels, known=initial_state == "known")

    begin = time.perf_counter()
    method: AbstractEstimator = BASELINES[estimator]() if estimator in BASELINES else IBSS()
    if estimator in RATES_ONLY:
        if channels not in (None, "rates"):
            raise InputError(f"--channels {channels}: {estimator} looks at the rates; use --estimator output-error.")
        if np.isnan(np.asarray(recorded.states)[:, CASCADE_ORDER[:3]]).all(axis=0).any():
            raise InputError(f"{flight}: {estimator} needs p, q and r; use --estimator output-error.")
        problem = problem.restrict("rates")
    if learned:
        if trained is None:
            steps = SEED_STEPS if estimator == "hybrid" else NetworkEstimator.steps
            training = NetworkEstimator(channels=seen_channels(problem), steps=steps)
            console.print(f"note: training a network for this flight, {training.steps} steps", highlight=False)
            trained = fit_network(training, flight, problem, where, seed=0)
        different = trained.mismatch(problem)
        if different is not None:
            raise InputError(
                f"{network or 'the network'}: cannot be used on {flight}: {different}; train one with `jaxos4 train`."
            )
        if estimator == "hybrid":
            method = Hybrid(trained)
        else:
            method, problem, where = trained, problem.restrict(trained.channels), trained.bracket
    problem, found, bound, rollouts = fit(method, problem, where, shoots=estimator in SHOOTING)
    seconds = time.perf_counter() - begin

    name = str(result_names(found.result))
    report = {
        "estimator": estimator.value,
        "model": model.value,
        "result": name,
        "rollouts": rollouts,
        "cost": _number(found.cost),
        "seconds": seconds,
        "parameters": _parameters(problem, where, found, bound, with_prior=estimator in FILTERS),
        "fit": {} if name in NO_ANSWER else _fit_quality(problem, found),
        "provenance": {
            "flight": str(flight),
            "airframe": airframe,
            "channels": problem.channels,
            "initial_state": initial_state.value,
            "samples": int(recorded.time.shape[0]),
            "sample_time": float(recorded.dt),
            "notes": list(notes),
            **({} if trained is None else {"network": _network_provenance(network, trained)}),
            **_provenance(),
        },
    }
    if out is not None:
        with write_atomically(out) as beside:
            beside.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if name == "nonfinite_trajectory":
        console.print(
            "No estimate: wherever the search went, the model's trajectory left this flight before its end. The "
            "vehicle may do what the model lacks, or the airframe's constants or the units are far off.",
            highlight=False,
        )
    elif name not in NO_ANSWER:
        _print(console, report)
    if name != "successful":
        typer.echo(f"jaxos4: {name}: {RESULTS[found.result]}", err=True)
        raise typer.Exit(1)


def fit_network(
    training: NetworkEstimator, flight: Path, problem: ShootingProblem, bracket: Bracket, *, seed: int
) -> TrainedNetwork:
    """A network for a flight's inputs."""
    try:
        return training.fit(problem, bracket, key=jax.random.key(seed), progress=True)
    except ValueError as error:
        raise InputError(f"{flight}: {error}") from None


def seen_channels(problem: ShootingProblem) -> str:
    """What a network looks at: the rates, or the attitude too where not all of them were measured."""
    rates = np.asarray(problem.flight.states)[:, CASCADE_ORDER[: CHANNELS["rates"]]]
    return "attitude" if problem.size > CHANNELS["rates"] and np.isnan(rates).all(axis=0).any() else "rates"


def problem_of(
    path: Path, model: AbstractModel, flight: Flight, channels: Channels | None, *, known: bool
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
    return ShootingProblem(model, flight, sigma=SENSOR_SIGMA, initial_state=start, channels=chosen)


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


def _parameters(
    problem: ShootingProblem,
    bracket: Bracket,
    found: Estimate,
    bound: Float[Array, " parameters"],
    *,
    with_prior: bool,
) -> dict[str, dict[str, Any]]:
    table, half_width, model = {}, np.asarray(found.half_width(0.95)), problem.model
    known = None
    if str(result_names(found.result)) not in NO_ANSWER:
        known = identifiability(problem, bracket, found.parameters, found.initial_state)
    for i, (name, unit) in enumerate(zip(model.parameter_names, model.parameter_units, strict=True)):
        value, std = float(found.parameters[i]), float(found.std[i])
        lower, upper = float(bracket.lower[i]), float(bracket.upper[i])
        # A network's errors are those of the flight and the bracket together.
        most = (upper - lower) / 2 * (0.5 if found.calibration is not None else WITH_PRIOR if with_prior else 1.0)
        told = np.isfinite(std) and std <= most
        table[name] = {
            "estimate": value if told else None,
            "std": _number(std),
            "bound": _number(bound[i]),
            "ci95": [value - half_width[i], value + half_width[i]] if told else None,
            "unit": unit,
            "noise_limit": None if known is None else _number(known.noise_limit[i]),
            "note": _note(found, i, half_width[i], lower, upper) if told else _why_untold(known, name, model),
        }
    return table


def _why_untold(known: Identifiability | None, name: str, model: AbstractModel) -> str:
    reasons = {} if known is None else known.notes(model.parameter_names)
    reason = reasons.get(name, "")
    return reason if reason.startswith("not told") else "not told by this flight"


def _note(found: Estimate, i: int, half_width: float, lower: float, upper: float) -> str:
    notes, value = [], float(found.parameters[i])
    if abs(value) < half_width:
        notes.append("below noise")
    if not lower <= value <= upper:
        notes.append("outside its bracket")
    if found.seed is not None and not found.seed.lower[i] <= value <= found.seed.upper[i]:
        notes.append("missed by the network, found beyond")
    return "; ".join(notes)


def _fit_quality(problem: ShootingProblem, found: Estimate) -> dict[str, dict[str, Any]]:
    """For each channel: noise level [unit], share of the motion explained, correlation of neighbouring residuals."""
    columns = CASCADE_ORDER[: problem.size]
    measured = np.asarray(problem.flight.states)[:, columns]
    error = measured - np.asarray(problem.predict(found.parameters, found.initial_state))
    quality = {}
    for i, column in enumerate(columns):
        there = ~np.isnan(measured[:, i])
        e, y = error[there, i], measured[there, i]
        if len(e) < 3:
            continue
        quality[STATE_NAMES[column]] = {
            "rms": _number(np.sqrt(np.mean(e**2))),
            "unit": STATE_UNITS[column],
            "percent": _number(100 * (1 - np.linalg.norm(e) / max(np.linalg.norm(y - y.mean()), 1e-300))),
            "correlation": _number((e[1:] @ e[:-1]) / (e @ e)) if np.abs(e).max() > ROUNDING * np.abs(y).max() else 0.0,
        }
    return quality


def _print(console: Console, report: dict[str, Any]) -> None:
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "estimate", "95 % interval", "bound", "note"):
        right = heading in ("estimate", "bound")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading != "note")
    for name, row in report["parameters"].items():
        if row["estimate"] is None:
            table.add_row(name, row["unit"], "-", "-", "-", row["note"])
            continue
        low, high = row["ci95"]
        interval = f"[{low:.5g}, {high:.5g}]"
        table.add_row(name, row["unit"], f"{row['estimate']:.5g}", interval, f"{row['bound']:.2g}", row["note"])
    console.print(table, markup=False)
    below = [
        f"{name} {row['noise_limit']:.2g}"
        for name, row in report["parameters"].items()
        if "below noise" in row["note"] and row["noise_limit"]
    ]
    if below:
        console.print(
            f"below noise: not told from 0. The airframe's values would show below this share of the noise found: "
            f"{', '.join(below)}.",
            highlight=False,
        )
    fit = report["fit"]
    shares = ", ".join(f"{name} {row['percent']:.1f}" for name, row in fit.items() if row["percent"] is not None)
    console.print("bound: Cramer-Rao, the least standard deviation that the noise found allows.", highlight=False)
    console.print(f"fit [%], 100 is a perfect prediction: {shares}.", highlight=False, markup=False)
    coloured = [name for name, row in fit.items() if (row["correlation"] or 0) > COLOURED]
    if coloured and report["estimator"] == "network":
        console.print(
            f"The residuals of {', '.join(coloured)} are more than noise: the network's answer is not the best fit, "
            "within its intervals. The hybrid goes on from there, and says whether the model explains this flight.",
            highlight=False,
        )
    elif coloured:
        console.print(
            f"The residuals of {', '.join(coloured)} are not noise: the model does not explain this flight fully, and "
            "the intervals are too narrow.",
            highlight=False,
        )
    console.print(
        f"{report['estimator']}, {report['model']} model, {report['provenance']['channels']} channels: "
        f"{report['result']}, {report['rollouts']} rollouts, {report['seconds']:.1f} s",
        highlight=False,
    )


def _network_provenance(path: Path | None, network: TrainedNetwork) -> dict[str, Any]:
    settings = {field.name: getattr(network.settings, field.name) for field in dataclasses.fields(network.settings)}
    bracket = {"lower": network.bracket.lower.tolist(), "upper": network.bracket.upper.tolist()}
    return {"file": None if path is None else str(path), "settings": settings, "bracket": bracket}


def _provenance() -> dict[str, str]:
    from .. import __version__

    return {
        "version": __version__,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "precision": "float64",
    }


def _number(x: Float[Array | np.ndarray, ""] | float | np.floating) -> float | None:
    return float(x) if np.isfinite(x) else None
