"""How many rollouts does an accuracy cost?

Each search stops after a limited number of sweeps (or steps) of each stage, and its estimate counts, converged or not.
All flights have the same true vehicle. Each bracket's center is drawn within 80 % of the default half-widths around
the truth.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
import xarray as xr

import jaxos4
from experiments.shared import save_results
from jaxos4.excitation import EXCITATIONS
from jaxos4.models import MODELS
from jaxos4.study import Study, load_study

SEARCHES: dict[str, Callable[[int], jaxos4.AbstractEstimator]] = {
    "IBSS": lambda most: jaxos4.IBSS(max_sweeps=most),
    "output error": lambda most: jaxos4.OutputError(max_steps=most),
}
HYBRID = "hybrid"


def identify(study: Study, channels: str, names: list[str], limits: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Errors in bounds [searches, limits, flights, parameters], and rollouts [searches, limits, flights]."""
    model = MODELS[study.models[0]](jaxos4.load_airframe(study.airframes[0]))
    omega = EXCITATIONS[study.excitations[0]](model.airframe, duration=study.durations[0], dt=study.dt)
    exact = jaxos4.simulate(model, model.alpha, omega, dt=study.dt)
    sigma = study.scales[0] * jaxos4.SENSOR_SIGMA
    noise = jaxos4.WhiteNoise(sigma)

    def problem(flight: jaxos4.Flight) -> jaxos4.ShootingProblem:
        return jaxos4.ShootingProblem(model, flight, sigma=sigma, initial_state=jnp.zeros(12), channels=channels)

    @jax.jit
    def draw(number: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The measured states of a flight, and the center of its bracket."""
        noise_key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(study.seed), number))
        offset = jax.random.uniform(start_key, model.alpha.shape, minval=-0.8, maxval=0.8)
        return noise(exact, key=noise_key).states, model.alpha + offset * model.half_width

    @eqx.filter_jit
    def run(estimator: jaxos4.AbstractEstimator, states: jax.Array, centers: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(states: jax.Array, center: jax.Array) -> tuple[jax.Array, jax.Array]:
            flight = eqx.tree_at(lambda f: f.states, exact, states)
            found = estimator(problem(flight), jaxos4.Bracket.around(center, model.half_width))
            return found.parameters, found.rollouts

        return jax.vmap(one)(states, centers)

    def train() -> jaxos4.TrainedNetwork:
        """A network for twice the default bracket, which contains the brackets of all searches."""
        return jaxos4.NetworkEstimator(
            channels=channels, steps=study.network.steps, held_out=study.network.held_out, noise=(study.scales[0],) * 2
        ).fit(
            problem(exact),
            jaxos4.Bracket.around(model.alpha, 2 * model.half_width),
            key=jax.random.key(study.network.seed),
        )

    network = train() if HYBRID in names else None
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem(exact), model.alpha)))
    found, flights = [], jax.lax.map(draw, jnp.arange(study.flights))
    for name in names:
        for most in limits:
            hybrid = jaxos4.Hybrid(network, jaxos4.IBSS(max_sweeps=most)) if name == HYBRID else None
            found.append(run(hybrid or SEARCHES[name](most), *flights))
    shape = (len(names), len(limits), study.flights)
    errors = np.stack([(parameters - model.alpha) / bound for parameters, _ in found]).reshape(*shape, -1)
    return errors, np.stack([rollouts for _, rollouts in found]).reshape(shape)


def main(
    specification: Path,
    out: Annotated[Path, typer.Option(help="Folder for the Dataset.")],
    limits: Annotated[list[int], typer.Option(help="Limits of sweeps or steps.")] = (1, 2, 3, 4, 6, 10),
    names: Annotated[list[str], typer.Option(help="Names of the searches.")] = (*SEARCHES, HYBRID),
) -> None:
    """Measure errors and rollouts of each search, by channels and limit."""
    study = load_study(specification)
    found = [identify(study, channels, list(names), list(limits)) for channels in study.channels]
    dims = ("channels", "search", "limit", "flight")
    results = xr.Dataset(
        {
            "error": ((*dims, "parameter"), np.stack([errors for errors, _ in found]), {"units": "bounds"}),
            "rollouts": (dims, np.stack([rollouts for _, rollouts in found]), {"units": "1"}),
        },
        {"channels": list(study.channels), "search": list(names), "limit": list(limits)},
    )
    save_results(results, study, out)
