"""Experiments with a specification: studies as `jaxos4 study` runs them, their variants, and other computations.

    python -m experiments NAME.run experiments/NAME/study.toml --out data/NAME

An experiment without a function here is a study: `python -m experiments study.run ...`.
"""

from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from msgspec.structs import replace

import jaxos4
from experiments.monte_carlo import Column, print_rows, product
from experiments.shared import (
    Folder,
    brackets_at,
    fit_noisy,
    identify,
    measure,
    monte_carlo_error,
    run_studies,
    save_results,
    span,
    standard_problem,
)
from jaxos4.models import MODELS
from jaxos4.study import Study, load_study

SEARCHES: dict[str, Callable[[int], jaxos4.AbstractEstimator]] = {
    "IBSS": lambda most: jaxos4.IBSS(max_sweeps=most),
    "output error": lambda most: jaxos4.OutputError(max_steps=most),
}
TESTS = ("white_p", "input_p", "level_p")  # p-values: white residuals, free of the inputs, as large as the noise


def study(specification: Path, out: Folder) -> None:
    """Run a study."""
    run_studies({"": load_study(specification)}, out)


def inverse_crime(
    specification: Path, out: Folder, fit_methods: list[str] = ("euler", "rk4"), dts: list[float] = (0.01, 0.002)
) -> None:
    """How large is the error if the simulation and the fit integrate the equations with different methods?

    A study for each method of the fit and sample time [s], in a folder of its own. Each has flights from all methods of
    simulation.
    """
    found = load_study(specification)
    run_studies({f"{m} {dt:g} s": replace(found, fit_method=m, dt=dt) for dt in dts for m in fit_methods}, out)


def bracket_and_seeds(specification: Path, out: Folder, seeds: list[int] = (0, 1, 2)) -> None:
    """How do the network and the hybrid depend on the width of the bracket and on the random seed of the training?

    A study of the same flights for each training seed, in a folder of its own.
    """
    found = load_study(specification)
    run_studies({f"seed {s}": replace(found, network=replace(found.network, seed=s)) for s in seeds}, out)


def model_of(study: Study, name: str | None = None) -> jaxos4.AbstractModel:
    """A model with the airframe of a study; by default its first."""
    return MODELS[name or study.models[0]](study.vehicle(study.airframes[0]))


def input_of(study: Study, excitation: str | None = None, duration: float | None = None) -> jax.Array:
    """Rotor speeds of a study; by default its first."""
    return study.omega(excitation or study.excitations[0], study.airframes[0], duration or study.durations[0])


def noise_limits(study: Study, model: str, excitation: str, duration: float, channels: str) -> np.ndarray:
    """The largest noise for each parameter, in multiples of the standard noise. 0: the truth is 0. NaN: not excited."""
    vehicle, omega = model_of(study, model), input_of(study, excitation, duration)
    flight = jaxos4.simulate(vehicle, vehicle.alpha, omega, dt=study.dt)
    known = {"sigma": jaxos4.SENSOR_SIGMA, "initial_state": jnp.zeros(12), "channels": channels}
    problem = jaxos4.ShootingProblem(vehicle, flight, **known)
    found = jaxos4.identifiability(jaxos4.evaluate(problem, vehicle.alpha), jaxos4.Bracket.default(vehicle))
    return np.where(found.excited | (vehicle.alpha == 0), found.noise_limit, np.nan)


def frontier(specification: Path, out: Folder) -> None:
    """What is the largest noise at which each parameter can be distinguished from 0?

    The answer is |alpha| / (1.96 Cramer-Rao bound), in multiples of the standard noise, for the parameters of the
    airframe and a known initial state. It depends on the model, the input, the duration and the channels. There is no
    randomness.
    """
    study, names = load_study(specification), model_of(load_study(specification)).parameter_names
    axes = {"model": study.models, "excitation": study.excitations, "duration": study.durations}
    axes |= {"channels": study.channels}
    values = np.stack([noise_limits(study, **case) for case in product(**axes)])
    coordinates = {name: list(axis) for name, axis in axes.items()} | {"parameter": list(names)}
    shape = [len(axis) for axis in coordinates.values()]
    frontier = xr.DataArray(values.reshape(shape), coordinates, list(coordinates), attrs={"units": "1"})
    save_results(xr.Dataset({"frontier": frontier}), study, out)
    columns: dict[str, Column] = {"model": "model", "channels": "channels"}
    columns |= {name: lambda case, name=name: span(frontier.sel(case | {"parameter": name}), 2) for name in names}
    title = "largest noise at which a parameter can be distinguished from 0 [standard noise], over all inputs"
    print_rows(title, product(model=study.models, channels=study.channels), columns)


def searched(study: Study, channels: str, search: str, limit: int) -> xr.Dataset:
    """Errors in bounds, and rollouts, of all flights by a search with a limit."""
    model = model_of(study)
    problem = standard_problem(model, channels, scale=study.scales[0], omega=input_of(study), dt=study.dt)
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem, model.alpha)))
    found, _ = fit_noisy(SEARCHES[search](limit), problem, study.flights, study.seed)
    error = np.asarray((found.parameters - model.alpha) / bound)
    return xr.Dataset(
        {
            "error": (("flight", "parameter"), error, {"units": "bounds"}),
            "rollouts": ("flight", np.asarray(found.rollouts), {"units": "1"}),
        }
    )


def computed(compute: Callable[..., xr.Dataset], study: Study, **axes) -> tuple[list[dict], xr.Dataset]:
    """The cases of all combinations, and their Datasets as one."""
    cases = list(product(**axes))
    parts = [compute(study, **case).expand_dims({name: [value] for name, value in case.items()}) for case in cases]
    return cases, xr.combine_by_coords(parts).sel({name: list(axis) for name, axis in axes.items()})


def rollout_budget(
    specification: Path, out: Folder, limits: list[int] = (1, 2, 3, 4, 6, 10), names: list[str] = tuple(SEARCHES)
) -> None:
    """How many rollouts does an accuracy cost?

    Each search stops after a limited number of sweeps (or steps) of each stage, and its estimate counts, converged or
    not. All flights have the same true vehicle. Each bracket's center is drawn within 80 % of the default half-widths
    around the truth.
    """
    study = load_study(specification)
    cases, results = computed(searched, study, channels=study.channels, search=names, limit=limits)
    save_results(results, study, out)
    rms, spent = (results["error"] ** 2).mean("flight") ** 0.5, results["rollouts"].mean("flight")
    columns: dict[str, Column] = {
        "channels": "channels",
        "search": "search",
        "most sweeps or steps": "limit",
        "RMSE / bound": lambda case: span(rms.sel(case)),
        "rollouts": lambda case: float(spent.sel(case)),
    }
    title = f"accuracy by limit, {study.flights} flights, {monte_carlo_error(study.flights)}"
    print_rows(title, cases, columns)


def p_values(exact: jaxos4.ShootingProblem, found: jaxos4.Estimate, states: jax.Array) -> np.ndarray:
    """The p-values of `TESTS` for each flight: the smallest of all channels, times their number (Bonferroni)."""
    least = []
    for flight, parameters, start in zip(states, found.parameters, found.initial_state, strict=True):
        problem = eqx.tree_at(lambda p: p.flight.states, exact, flight)
        tests = jaxos4.residual_diagnostics(jaxos4.evaluate(problem, parameters, start))
        every = (getattr(tests, name) for name in TESTS)
        least.append([min(p.size * p.min(), 1.0) for p in every])
    return np.array(least).T


def fitted_to(study: Study, channels: str, flown: str, fitted: str) -> xr.Dataset:
    """Fit the model `fitted` to flights of the model `flown`."""
    truth, model, omega = model_of(study, flown), model_of(study, fitted), input_of(study)
    exact = standard_problem(model, channels, scale=study.scales[0], omega=omega, dt=study.dt)
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(exact, model.alpha)))
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(study.seed), i))(jnp.arange(study.flights))
    flight = jaxos4.simulate(truth, truth.alpha, omega, dt=study.dt)
    states = measure(jaxos4.WhiteNoise(exact.sigma), flight, keys)
    found = identify(jaxos4.IBSS(), exact, brackets_at(model, 0.3, study.flights), states)
    error = np.asarray(found.parameters) - np.asarray(model.alpha)
    tests = zip(TESTS, p_values(exact, found, states), strict=True)
    return xr.Dataset(
        {
            "error": (("flight", "parameter"), error / bound, {"units": "bounds of the fitted model's own flight"}),
            "covered": (("flight", "parameter"), np.abs(error) < np.asarray(found.half_width(0.95))),
            "answered": ("flight", np.isin(jaxos4.result_names(found.result), ["successful", "unidentifiable"])),
            **{name: ("flight", values) for name, values in tests},
            "truth": ("parameter", np.asarray(model.alpha)),
            "bound": ("parameter", bound),
        },
        {"parameter": list(model.parameter_names)},
    )


def published_corrected(specification: Path, out: Folder) -> None:
    """How well do the published and the corrected model explain their own flights, and each other's?

    One model simulates the flights, with the parameters of its airframe. IBSS fits the same or the other model to them.
    All flights have the same rotor speeds. Errors are differences from the parameters that the airframe implies for the
    fitted model.
    """
    study = load_study(specification)
    axes = {"channels": study.channels, "flown": study.models, "fitted": study.models}
    cases, results = computed(fitted_to, study, **axes)
    save_results(results, study, out)
    rms = (results["error"].where(results["answered"]) ** 2).mean("flight") ** 0.5
    columns: dict[str, Column] = {
        "channels": "channels",
        "fitted model": "fitted",
        "flights of": "flown",
        "answered [%]": lambda case: float(100 * results["answered"].sel(case).mean()),
        "RMSE / bound": lambda case: span(rms.sel(case)),
        "residuals not white [%]": lambda case: float(100 * (results["white_p"].sel(case) < 0.01).mean()),
    }
    title = f"models fitted to flights of each other, {study.flights} flights, seed {study.seed}"
    print_rows(title, cases, columns)


SCRIPTS = {
    "bracket_and_seeds.run": bracket_and_seeds,
    "frontier.run": frontier,
    "inverse_crime.run": inverse_crime,
    "published_corrected.run": published_corrected,
    "rollout_budget.run": rollout_budget,
    "study.run": study,
}
