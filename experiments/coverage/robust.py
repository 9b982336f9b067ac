"""How often do 95 % intervals contain the truth if the sensors' noise is coloured?

IBSS identifies standard flights with Gauss-Markov noise. Intervals by the Cramer-Rao bound of white noise are compared
with those by `jaxos4.robust_covariance`.
"""

from typing import Annotated

import equinox as eqx
import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import covered_error, print_table
from experiments.shared import PARAMETERS, fit_noisy, flight_keys, measure, standard_problem
from jaxos4.analysis.evaluation import evaluate, robust_covariance
from jaxos4.noise import NOISES
from jaxos4.results import NINETY_FIVE


def main(
    flights: Annotated[int, typer.Option(help="Number of flights.")] = 256,
    seed: Annotated[int, typer.Option(help="Random seed for noise and starts.")] = 13,
) -> None:
    """Measure the coverage of robust intervals."""
    problem = standard_problem(jaxos4.PublishedOS4(jaxos4.OS4))
    noise = NOISES["coloured"](jaxos4.SENSOR_SIGMA)
    found, _ = fit_noisy(jaxos4.IBSS(), problem, flights, seed, noise)

    def deviations(parameters: jax.Array, states: jax.Array) -> np.ndarray:
        flown = eqx.tree_at(lambda p: p.flight.states, problem, states)
        return np.sqrt(np.diagonal(robust_covariance(evaluate(flown, parameters))))

    states = measure(noise, problem.flight, flight_keys(seed, flights)[0])
    robust = np.stack([deviations(*one) for one in zip(found.parameters, states, strict=True)])
    error = np.abs(np.asarray(found.parameters - problem.model.alpha))
    rows = [
        (name, *(f"{100 * share:.0f}" for share in held.mean(axis=0)), f"{100 * held.mean():.1f}")
        for name, std in (("Cramer-Rao bound", np.asarray(found.std)), ("sandwich", robust))
        for held in [error < NINETY_FIVE * std]
    ]
    chance = 100 * covered_error(0.95, flights)
    title = f"95 % intervals that hold [%], {flights} flights, Monte-Carlo error {chance:.1g} %"
    print_table(title, ("covariance", *PARAMETERS, "all"), rows)
