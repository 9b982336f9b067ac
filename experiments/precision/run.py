"""Which estimators reach the Cramer-Rao bound in single precision?

The same noisy standard flights are identified in double and in single precision. Flights, brackets and bounds are made
in double precision, and networks are trained in it. Estimators that see the rates alone have the bound of the rates.
"""

import io
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, count_results, in_words, print_table, write_report
from experiments.shared import PARAMETERS, brackets_around, identify, measure
from jaxos4._custom_types import as_float
from jaxos4.estimators import ESTIMATORS, make_estimator
from jaxos4.networks import encode_network

MODEL, DT = jaxos4.PublishedOS4, 0.01


class Case(NamedTuple):
    """The inputs of all flights, the scale of their noise, and whether their start at rest is known."""

    omega: np.ndarray
    scale: float
    known: bool

    def problem(self, states: np.ndarray, channels: str) -> jaxos4.ShootingProblem:
        """The problem of a flight, in the current precision."""
        flight = jaxos4.Flight(DT * np.arange(len(states)), self.omega, states)
        start, sigma = np.zeros(12) if self.known else None, self.scale * jaxos4.SENSOR_SIGMA
        return jaxos4.ShootingProblem(MODEL(jaxos4.OS4), flight, sigma=sigma, initial_state=start, channels=channels)


class Answers(NamedTuple):
    """Parameters of all flights, the half-widths of their 95 % intervals, and the names of the results."""

    parameters: np.ndarray
    half_width: np.ndarray
    results: np.ndarray

    @classmethod
    def of(
        cls, estimator: Any, problem: jaxos4.ShootingProblem, brackets: jaxos4.Bracket, states: np.ndarray
    ) -> "Answers":
        """The answers in the current precision."""
        found = identify(estimator, problem, jax.tree.map(as_float, brackets), as_float(states))
        if found.parameters.dtype != jax.numpy.result_type(float):
            raise TypeError(f"the estimates are of {found.parameters.dtype}")
        return cls(*map(np.asarray, (found.parameters, found.half_width(0.95))), jaxos4.result_names(found.result))

    def summary(self, double: "Answers", truth: np.ndarray, bound: np.ndarray) -> dict[str, Any]:
        """A row of the table. Differences from the answers in `double` precision are in multiples of the bound."""
        error = self.parameters.astype(np.float64) - truth
        return {
            "efficiency": np.sqrt(np.mean((error / bound) ** 2, axis=0)).tolist(),
            "covered": float(np.mean(np.abs(error) < self.half_width)),
            "largest_difference": float(np.abs((self.parameters - double.parameters) / bound).max()),
            "results": count_results(self.results),
        }


def main(
    flights: Annotated[int, typer.Option(help="Number of flights.")] = 256,
    seed: Annotated[int, typer.Option(help="Random seed for noise and brackets; networks: seed 0.")] = 0,
    estimators: Annotated[list[str], typer.Option(help="Estimators, by name.")] = tuple(ESTIMATORS),
    scale: Annotated[float, typer.Option(help="Noise, in multiples of the standard sensors'.")] = 1.0,
    known: Annotated[bool, typer.Option("--known/--free", help="Whether the initial state is known.")] = True,
    steps: Annotated[int, typer.Option(help="Training steps of the network.")] = jaxos4.NetworkEstimator.steps,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results.")] = None,
) -> None:
    """RMSE / Cramer-Rao bound of each estimator in double and in single precision."""
    model, (noise_key, bracket_key) = MODEL(jaxos4.OS4), jax.random.split(jax.random.key(seed))
    exact = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe), dt=DT)
    truth, flown, case = np.asarray(model.alpha), np.asarray(exact.states), Case(np.asarray(exact.omega), scale, known)
    noise = jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)
    states = np.asarray(measure(noise, exact, jax.random.split(noise_key, flights)))
    brackets = jax.tree.map(np.asarray, brackets_around(model, jax.random.split(bracket_key, flights)))
    network = b""
    if any(ESTIMATORS[name].needs_network for name in estimators):
        standard, bracket = case._replace(scale=1.0).problem(flown, "rates"), jaxos4.Bracket.default(model)
        trained = jaxos4.NetworkEstimator(steps=steps).fit(standard, bracket, key=jax.random.key(0))
        network = encode_network(trained)

    bounds, found = {}, {}
    for name in estimators:
        bound = jaxos4.cramer_rao_bound(case.problem(flown, ESTIMATORS[name].looks_at), model.alpha)
        bounds[name] = np.sqrt(np.diagonal(bound))
    for precision in ("float64", "float32"):
        jax.clear_caches()  # JAX finds what it has traced in the other precision
        with jax.enable_x64(precision == "float64"):
            for name in estimators:
                loaded = jaxos4.load_network(io.BytesIO(network)) if ESTIMATORS[name].needs_network else None
                problem = case.problem(np.zeros_like(flown), ESTIMATORS[name].looks_at)
                found[name, precision] = Answers.of(make_estimator(name, loaded), problem, brackets, states)
    report: Row = {"flights": flights, "seed": seed, "scale": scale, "known": known, "version": jaxos4.__version__}
    report["rows"] = [
        {"estimator": name, "precision": precision}
        | found[name, precision].summary(found[name, "float64"], truth, bounds[name])
        for name in estimators
        for precision in ("float64", "float32")
    ]
    cells = (
        (
            *(row["estimator"], row["precision"], *(f"{x:.3g}" for x in row["efficiency"])),
            *(f"{row['covered']:.3f}", f"{row['largest_difference']:.2g}", in_words(row["results"])),
        )
        for row in report["rows"]
    )
    title = f"RMSE / bound, {flights} flights, noise {scale:g}, Monte-Carlo error {1 / np.sqrt(2 * flights):.3f}"
    headings = "estimator", "precision", *PARAMETERS, "covered", "largest difference", "results"
    print_table(title, headings, cells, width=170)
    write_report(out, report)
