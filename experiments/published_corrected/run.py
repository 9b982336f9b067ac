"""How well do the published and the corrected model explain their own flights, and each other's?

One model simulates the flights, with the parameters of its airframe. IBSS fits the same or the other model to them. All
flights have the same rotor speeds. Errors are differences from the parameters that the airframe implies for the fitted
model.
"""

import itertools
from pathlib import Path
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
import xarray as xr

import jaxos4
from experiments.monte_carlo import print_table
from experiments.shared import identify, many_times, measure, save_results, span, standard_problem
from jaxos4.excitation import EXCITATIONS
from jaxos4.models import MODELS
from jaxos4.study import Study, load_study


class Fits(NamedTuple):
    """For each flight: the estimate, the half-width of its 95 % interval, the result, and the diagnostics.

    The p-values are of white residuals, of residuals that do not depend on the inputs, and of residuals as large as the
    noise. Each is the smallest of all channels, times the number of channels (Bonferroni).
    """

    estimate: np.ndarray
    half_width: np.ndarray
    result: np.ndarray
    white_p: np.ndarray
    input_p: np.ndarray
    level_p: np.ndarray


def model_of(study: Study, name: str) -> jaxos4.AbstractModel:
    """The model of this name, with the airframe of the study."""
    return MODELS[name](jaxos4.load_airframe(study.airframes[0]))


def judge(exact: jaxos4.ShootingProblem, found: jaxos4.Estimate, states: jax.Array) -> Fits:
    """The fits with their diagnostics."""
    least = []
    for flight, parameters, start in zip(states, found.parameters, found.initial_state, strict=True):
        problem = eqx.tree_at(lambda p: p.flight.states, exact, flight)
        tests = jaxos4.residual_diagnostics(jaxos4.evaluate(problem, parameters, start))
        least.append([min(p.size * p.min(), 1.0) for p in (tests.white_p, tests.input_p, tests.level_p)])
    names, half_width = jaxos4.result_names(found.result), np.asarray(found.half_width(0.95))
    return Fits(np.asarray(found.parameters), half_width, names, *np.array(least).T)


def fits(study: Study, channels: str, flown: str, fitted: str) -> xr.Dataset:
    """Fit the model `fitted` to flights of the model `flown`."""
    truth, model = model_of(study, flown), model_of(study, fitted)
    omega = EXCITATIONS[study.excitations[0]](model.airframe, duration=study.durations[0], dt=study.dt)
    sigma = study.scales[0] * jaxos4.SENSOR_SIGMA
    exact = standard_problem(model, channels, scale=study.scales[0], omega=omega)
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(exact, model.alpha)))

    flight, noise = jaxos4.simulate(truth, truth.alpha, omega, dt=study.dt), jaxos4.WhiteNoise(sigma)
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(study.seed), i))(jnp.arange(study.flights))
    bracket = jaxos4.Bracket.around(model.alpha + 0.3 * model.half_width, model.half_width)
    states = measure(noise, flight, keys)
    found = judge(exact, identify(jaxos4.IBSS(), exact, many_times(bracket, study.flights), states), states)
    answered = np.isin(found.result, ["successful", "unidentifiable"])
    error = found.estimate - np.asarray(model.alpha)
    return xr.Dataset(
        {
            "error": (("flight", "parameter"), error / bound, {"units": "bounds of the fitted model's own flight"}),
            "covered": (("flight", "parameter"), np.abs(error) < found.half_width),
            "answered": ("flight", answered),
            "white_p": ("flight", found.white_p),
            "input_p": ("flight", found.input_p),
            "level_p": ("flight", found.level_p),
            "truth": ("parameter", np.asarray(model.alpha)),
            "bound": ("parameter", bound),
        },
        {"parameter": list(model.parameter_names)},
    )


def main(specification: Path, out: Annotated[Path, typer.Option(help="Folder for the Dataset.")]) -> None:
    """Fit each model to flights of each model."""
    study = load_study(specification)
    cases = [study.channels, study.models, study.models]
    parts = [
        fits(study, *case).expand_dims(
            {dim: [value] for dim, value in zip(("channels", "flown", "fitted"), case, strict=True)}
        )
        for case in itertools.product(*cases)
    ]
    results = xr.combine_by_coords(parts)
    save_results(results, study, out)
    print_table(
        f"models fitted to flights of each other, {study.flights} flights, seed {study.seed}",
        ("channels", "fitted model", "flights of", "answered [%]", "RMSE / bound", "residuals not white [%]"),
        (line_of(results, channels, flown, fitted) for channels, flown, fitted in itertools.product(*cases)),
    )


def line_of(results: xr.Dataset, channels: str, flown: str, fitted: str) -> tuple[str, ...]:
    """A line of the table; residuals are not white if the p-value is below 1 %."""
    one = results.sel(channels=channels, flown=flown, fitted=fitted)
    rms = (one["error"].where(one["answered"]) ** 2).mean("flight") ** 0.5
    answered, alien = 100 * one["answered"].mean(), 100 * (one["white_p"] < 0.01).mean()
    return channels, fitted, flown, f"{answered:.0f}", span(rms), f"{alien:.0f}"
