"""A synthetic study: random numbers with a fixed seed, in the layout of a study's Dataset."""

import json

import numpy as np
import xarray as xr

import jaxos4
from jaxos4.study import OUTCOMES as RESULTS
from jaxos4.study.cell import LEVELS
from jaxos4.study.dataset import described
from jaxos4.study.metrics import SCENARIO

MODEL = jaxos4.PublishedOS4()
UNITS = MODEL.parameter_units
TRUTH = np.array([-0.73333333, 6e-9, 133.33333, 0.73333333, 6e-9, 133.33333, 0.0, 76.923077])
HALF_WIDTH = np.array([0.35, 0.05, 60.0, 0.35, 0.05, 60.0, 0.2, 35.0])
# Cramer-Rao standard deviations of the standard flight at a noise scale of 1.
BOUND = {
    "rates": np.array([6e-3, 1.1e-3, 0.147, 5.9e-3, 1.9e-3, 0.147, 5.2e-3, 0.085]),
    "all": np.array([1.0e-3, 1.4e-4, 0.0387, 1.1e-3, 3.3e-4, 0.036, 1.2e-3, 0.068]),
}
# For each estimator: spread and bias of its errors in bounds, rollouts, and whether it looks at the rates alone.
ESTIMATORS = {
    "ibss": (1.0, 0.0, 600, False),
    "network": (1.15, 0.0, 0, True),
    "hybrid": (1.0, 0.0, 90, False),
    "output-error": (1.02, 0.0, 110, False),
    "equation-error": (2.5, 1.5, 0, True),
    "rls": (2.6, 1.5, 0, True),
    "svsf": (4.0, 3.0, 0, True),
    "kalman": (1.3, 0.2, 24, False),
}
GAUSSIAN = np.array([0.67449, 1.64485, 1.95996, 2.57583])  # for LEVELS
PROVENANCE = {
    "title": "A synthetic study",
    "specification": 'title = "A synthetic study"\nscales = [0.1, 1.0, 10.0]\n',
    "version": "0.1.0",
    "precision": "float64",
    "device": "cpu",
    "jax": "0.9.0",
    "seed": 0,
    "command": "jaxos4 study synthetic.toml --out synthetic",
}


def synthetic_study(
    *,
    flights=40,
    scales=(0.1, 1.0, 10.0),
    estimators=("ibss", "network", "hybrid", "equation-error", "svsf"),
    models=("published",),
    spoiled=True,
    drawn=False,
):
    """A synthetic Dataset.

    `spoiled`: some flights have other results, one cell failed, and one was not run. `drawn`: each flight has its own
    truth, drawn over 60 % of the bracket.
    """
    values = (models, ["os4"], ["multisine"], [5.0], ["euler"], ["white"], scales, [1.0], ["all"], estimators)
    coordinates = {name: list(some) for name, some in zip(SCENARIO, values, strict=True)}
    seen = np.array([["rates" if ESTIMATORS[name][3] else "all" for name in estimators]])
    found, failures = answers(flights, coordinates, seen, drawn), []
    if spoiled:
        spoil(found, flights, len(scales) - 1, len(estimators) - 1)
        message = "FloatingPointError: <b>the filter's covariance</b> is not positive definite"
        failures.append({"cell": 7, **{name: some[-1] for name, some in coordinates.items()}, "message": message})
    center = np.broadcast_to(TRUTH + 0.2 * HALF_WIDTH * (not drawn), (len(models), 1, 1, 8))
    found |= {"center": center, "bracket_half_width": np.broadcast_to(HALF_WIDTH, center.shape), "seen": seen}
    names = {"parameter": list(MODEL.parameter_names), "unit": list(UNITS)}
    coordinates |= {"flight": np.arange(flights), "level": list(LEVELS)} | names
    return xr.Dataset(described(found), described(coordinates), PROVENANCE | {"failures": json.dumps(failures)})


def answers(flights, coordinates, seen, drawn):
    """Arrays of the answers of estimators whose errors are Gaussian, by name."""
    rng, shape = np.random.default_rng(0), tuple(map(len, coordinates.values()))
    estimators, scales = coordinates["estimator"], coordinates["scale"]
    truth = np.broadcast_to(TRUTH, (*shape[:-1], flights, 8)).copy()
    if drawn:
        truth += 0.6 * HALF_WIDTH * rng.uniform(-1, 1, truth.shape)
    estimate, std, bound = (np.full((*shape, flights, 8), np.nan) for _ in range(3))
    half_width = np.full((*shape, flights, 8, 4), np.nan)
    result = np.full((*shape, flights), RESULTS.index("successful"), dtype=np.int8)
    rollouts = np.zeros((*shape, flights), dtype=np.int32)
    cost = np.full((*shape, flights), np.nan)
    hit = np.full((*shape, flights), -1, dtype=np.int8)
    for index in np.ndindex(shape):
        spread, bias, shots, _ = ESTIMATORS[estimators[index[-1]]]
        sigma = scales[index[6]] * BOUND[seen[index[8], index[9]]]
        bound[index] = sigma
        estimate[index] = truth[index[:-1]] + sigma * (spread * rng.standard_normal((flights, 8)) + bias)
        std[index] = sigma * min(spread, 1.5)
        half_width[index] = std[index][..., None] * GAUSSIAN
        rollouts[index] = rng.poisson(shots, flights)
        cost[index] = 0.5 * rng.chisquare(500, flights)
        if estimators[index[-1]] == "hybrid":
            hit[index] = rng.random(flights) < 0.97
    return {
        **{"truth": truth, "estimate": estimate, "std": std, "half_width": half_width, "bound": bound},
        **{"result": result, "rollouts": rollouts, "cost": cost, "hit": hit},
    }


def spoil(found, flights, worst, last):
    """Some flights end without an estimate. `worst`: the place of the largest noise; `last`: of the last estimator."""

    def without(scale, estimator, names):
        cell = (*[0] * 6, scale, 0, 0, estimator)
        for flight, name in names.items():
            found["result"][cell][flight] = RESULTS.index(name)
            for numbers in ("estimate", "std", "half_width"):
                found[numbers][cell][flight] = np.nan
        return cell

    without(0, 0, {1: "at_bound", 3: "nonfinite_trajectory"})
    without(worst, 0, {2: "max_sweeps"})
    found["result"][(*[0] * 6, worst, 0, 0, 1)][5:8] = RESULTS.index("unidentifiable")
    for scale, name in ((worst, "failed"), (0, "not_run")):
        cell = without(scale, last, dict.fromkeys(range(flights), name))
        found["rollouts"][cell], found["cost"][cell] = 0, np.nan
        if name == "not_run":
            found["bound"][cell] = np.nan
