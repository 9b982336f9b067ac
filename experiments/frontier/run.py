"""What is the largest noise at which each parameter can be distinguished from 0?

The answer is |alpha| / (1.96 Cramer-Rao bound), in multiples of the standard noise, for the parameters of the airframe
and a known initial state. It depends on the model, the input, the duration and the channels. There is no randomness.
"""

import itertools
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import typer
import xarray as xr

import jaxos4
from experiments.monte_carlo import print_table
from experiments.shared import save_results, span
from jaxos4.excitation import EXCITATIONS
from jaxos4.models import MODELS
from jaxos4.study import Study, load_study

DIMS = ("model", "excitation", "duration", "channels", "parameter")


def limits(study: Study, model_name: str, excitation: str, duration: float, channels: str) -> np.ndarray:
    """The largest noise for each parameter, in multiples of the standard noise. 0: the truth is 0. NaN: not excited."""
    model = MODELS[model_name](jaxos4.load_airframe(study.airframes[0]))
    omega = EXCITATIONS[excitation](model.airframe, duration=duration, dt=study.dt)
    flight = jaxos4.simulate(model, model.alpha, omega, dt=study.dt)
    problem = jaxos4.ShootingProblem(
        model, flight, sigma=jaxos4.SENSOR_SIGMA, initial_state=jnp.zeros(12), channels=channels
    )
    found = jaxos4.identifiability(jaxos4.evaluate(problem, model.alpha), jaxos4.Bracket.default(model))
    return np.where(found.excited | (model.alpha == 0), found.noise_limit, np.nan)


def main(specification: Path, out: Annotated[Path, typer.Option(help="Folder for the Dataset.")]) -> None:
    """Compute the largest noise for all models, excitations, durations and channels of a specification."""
    study = load_study(specification)
    axes = (study.models, study.excitations, study.durations, study.channels)
    values = np.stack([limits(study, *which) for which in itertools.product(*axes)])
    names = MODELS[study.models[0]](jaxos4.load_airframe(study.airframes[0])).parameter_names
    coordinates = dict(zip(DIMS, (*map(list, axes), list(names)), strict=True))
    shape = [len(axis) for axis in coordinates.values()]
    frontier = xr.DataArray(values.reshape(shape), coordinates, DIMS, attrs={"units": "1"})
    save_results(xr.Dataset({"frontier": frontier}), study, out)
    lines = (
        (model, channels, *(span(frontier.sel(model=model, channels=channels, parameter=each), 2) for each in names))
        for model, channels in itertools.product(study.models, study.channels)
    )
    title = "largest noise at which a parameter can be distinguished from 0 [standard noise], over all inputs"
    print_table(title, ("model", "channels", *names), lines, width=170)
