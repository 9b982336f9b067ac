"""Which estimators reach the Cramer-Rao bound in single precision?

The same noisy standard flights are identified in double and in single precision. Flights, brackets and bounds are made
in double precision, and networks are trained in it. Estimators that see the rates alone have the bound of the rates.
"""

import io
from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Column, Row, check_names, count_results, print_rows, product, write_report
from experiments.shared import EFFICIENCY, Count, Estimators, Fit, Report, Seed, brackets_around, identify, measure
from jaxos4._custom_types import as_float
from jaxos4.estimators import ESTIMATORS, make_estimator
from jaxos4.networks import encode_network

PRECISIONS = ("float64", "float32")
COLUMNS: dict[str, Column] = {
    "estimator": "estimator",
    "precision": "precision",
    **EFFICIENCY,
    "covered": "covered",
    "largest difference": "largest_difference",
    "results": "results",
}


def answers(network: bytes, name: str, *data: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters, half-widths of the 95 % intervals and results of all flights, in the current precision.

    `data`: problem, brackets and states.
    """
    loaded = jaxos4.load_network(io.BytesIO(network)) if ESTIMATORS[name].needs_network else None
    data = jax.tree.map(lambda x: as_float(x) if eqx.is_inexact_array_like(x) else x, data)
    found = identify(make_estimator(name, loaded), *data)
    if found.parameters.dtype != jax.numpy.result_type(float):
        raise TypeError(f"the estimates are of {found.parameters.dtype}")
    half_width = np.asarray(found.half_width(0.95))
    return np.asarray(found.parameters, dtype=np.float64), half_width, jaxos4.result_names(found.result)


def main(
    flights: Count = 256,
    seed: Seed = 0,
    estimators: Estimators = tuple(ESTIMATORS),
    scale: float = 1.0,
    known: Annotated[bool, typer.Option("--known/--free", help="Whether the initial state is known.")] = True,
    steps: int = jaxos4.NetworkEstimator.steps,
    out: Report = None,
) -> None:
    """RMSE / Cramer-Rao bound of each estimator in double and in single precision."""
    check_names("estimators", estimators, ESTIMATORS)
    on_rates = Fit(jaxos4.IBSS(), channels="rates", known=known)
    fits = {name: on_rates._replace(channels=ESTIMATORS[name].looks_at, scale=scale) for name in estimators}
    problems = {name: fit.problem for name, fit in fits.items()}
    standard, (noise_key, bracket_key) = on_rates.problem, jax.random.split(jax.random.key(seed))
    noise = jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)
    states = np.asarray(measure(noise, standard.flight, jax.random.split(noise_key, flights)))
    brackets = jax.tree.map(np.asarray, brackets_around(standard.model, jax.random.split(bracket_key, flights)))
    network, truth = b"", np.asarray(standard.model.alpha)
    if any(ESTIMATORS[name].needs_network for name in estimators):
        training, bracket = jaxos4.NetworkEstimator(steps=steps), jaxos4.Bracket.default(standard.model)
        network = encode_network(training.fit(standard, bracket, key=jax.random.key(0)))
    bounds = {name: np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(one, truth))) for name, one in problems.items()}
    found = {}
    for precision in PRECISIONS:
        jax.clear_caches()  # JAX finds what it has traced in the other precision
        with jax.enable_x64(precision == "float64"):
            for name, problem in problems.items():
                found[name, precision] = answers(network, name, problem, brackets, states)
    report: Row = {"flights": flights, "seed": seed, "scale": scale, "known": known, "version": jaxos4.__version__}
    report["rows"] = []
    for case in product(estimator=estimators, precision=PRECISIONS):
        name, (parameters, half_width, results) = case["estimator"], found[tuple(case.values())]
        row = {
            "efficiency": np.sqrt(np.mean(((parameters - truth) / bounds[name]) ** 2, axis=0)).tolist(),
            "covered": float(np.mean(np.abs(parameters - truth) < half_width)),
            "largest_difference": float(np.abs((parameters - found[name, "float64"][0]) / bounds[name]).max()),
            "results": count_results(results),
        }
        report["rows"].append(case | row)
    title = f"RMSE / bound, {flights} flights, noise {scale:g}, Monte-Carlo error {1 / np.sqrt(2 * flights):.3f}"
    print_rows(title, report["rows"], COLUMNS)
    write_report(out, report)
