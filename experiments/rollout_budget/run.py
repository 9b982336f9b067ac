"""How many rollouts does an accuracy cost?

Each search stops after a limited number of sweeps (or steps) of each stage, and its estimate counts, converged or not.
All flights have the same true vehicle. Each bracket's center is drawn within 80 % of the default half-widths around
the truth.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import xarray as xr

import jaxos4
from experiments.monte_carlo import print_table
from experiments.shared import DT, fit_noisy, save_results, span, standard_problem
from jaxos4.excitation import EXCITATIONS
from jaxos4.models import MODELS
from jaxos4.study import Study, load_study

SEARCHES: dict[str, Callable[[int], jaxos4.AbstractEstimator]] = {
    "IBSS": lambda most: jaxos4.IBSS(max_sweeps=most),
    "output error": lambda most: jaxos4.OutputError(max_steps=most),
}


def identify_each(study: Study, channels: str, names: list[str], limits: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Errors in bounds [searches, limits, flights, parameters], and rollouts [searches, limits, flights]."""
    model = MODELS[study.models[0]](jaxos4.load_airframe(study.airframes[0]))
    omega = EXCITATIONS[study.excitations[0]](model.airframe, duration=study.durations[0], dt=DT)
    problem = standard_problem(model, channels, scale=study.scales[0], omega=omega)
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem, model.alpha)))
    found = [[fit_noisy(SEARCHES[n](most), problem, study.flights, study.seed)[0] for most in limits] for n in names]
    errors = [[(one.parameters - model.alpha) / bound for one in some] for some in found]
    return np.array(errors), np.array([[one.rollouts for one in some] for some in found])


def main(
    specification: Path,
    out: Annotated[Path, typer.Option(help="Folder for the Dataset.")],
    limits: Annotated[list[int], typer.Option(help="Limits of sweeps or steps.")] = (1, 2, 3, 4, 6, 10),
    names: Annotated[list[str], typer.Option(help="Names of the searches.")] = tuple(SEARCHES),
) -> None:
    """Measure errors and rollouts of each search, by channels and limit."""
    study = load_study(specification)
    found = [identify_each(study, channels, list(names), list(limits)) for channels in study.channels]
    dims = ("channels", "search", "limit", "flight")
    results = xr.Dataset(
        {
            "error": ((*dims, "parameter"), np.stack([errors for errors, _ in found]), {"units": "bounds"}),
            "rollouts": (dims, np.stack([rollouts for _, rollouts in found]), {"units": "1"}),
        },
        {"channels": list(study.channels), "search": list(names), "limit": list(limits)},
    )
    save_results(results, study, out)
    rms, spent = (results["error"] ** 2).mean("flight") ** 0.5, results["rollouts"].mean("flight")
    lines = (
        (
            channels,
            search,
            str(limit),
            span(rms.loc[channels, search, limit]),
            f"{spent.loc[channels, search, limit]:.0f}",
        )
        for channels, search, limit in itertools.product(study.channels, names, limits)
    )
    title = f"accuracy by limit, {study.flights} flights, Monte-Carlo error {1 / np.sqrt(2 * study.flights):.2g}"
    print_table(title, ("channels", "search", "most sweeps or steps", "RMSE / bound", "rollouts"), lines)
