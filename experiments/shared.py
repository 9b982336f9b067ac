"""Functions that the experiments share: standard flights and their identification, studies, and files."""

import itertools
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
import xarray as xr
from jaxtyping import Array, Float, Key as Keys

import jaxos4
from experiments.benchmarks.worker import peak_mib
from experiments.monte_carlo import Column, Row, count_results, in_words, print_table
from jaxos4._custom_types import Key, States
from jaxos4._files import write_netcdf
from jaxos4.analysis.evaluation import cramer_rao_bound
from jaxos4.bracket import Bracket
from jaxos4.cli.studies import run_with_bar
from jaxos4.errors import InputError
from jaxos4.estimate import AbstractEstimator, Estimate
from jaxos4.excitation import multisine
from jaxos4.flight import Flight
from jaxos4.models import MODELS
from jaxos4.models.abstract import AbstractModel
from jaxos4.noise import SENSOR_SIGMA, AbstractNoise, WhiteNoise
from jaxos4.report.study_tables import scenarios
from jaxos4.report.text import plain
from jaxos4.results import result_names
from jaxos4.shooting import ShootingProblem
from jaxos4.simulation import simulate
from jaxos4.study import Study, device_name, metrics
from jaxos4.study.dataset import RESULTS_FILE, provenance

PARAMETERS = tuple(f"a{i}" for i in range(1, 9))
"""Column headings of the eight alphas."""
DT = 0.01  # of a standard flight [s]
CHUNK = 250  # flights in one call, limited by the memory for the derivatives of the residuals
# Options of several scripts.
Count = Annotated[int, typer.Option(help="Number of flights of each row or case.")]
End = Annotated[float | None, typer.Option(help="Use recorded flights up to this time [s].")]
Estimators = Annotated[list[str], typer.Option(help="Names of the estimators, as those of `jaxos4 estimate`.")]
Flights = Annotated[Path | None, typer.Option(help="Folder of the recorded flights; by default $JAXOS4_FLIGHTS.")]
Out = Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")]
Report = Annotated[Path | None, typer.Option(help="JSON file for the results; written anew if it exists.")]
Seed = Annotated[int, typer.Option(help="Random seed of flights, noise and starts.")]
Folder = Annotated[Path, typer.Option(help="Folder of the results: a new one, or one of a study to be resumed.")]


def flight_files(folder: Path | None, names: Iterable[str]) -> list[Path]:
    """The files of recorded flights in a folder, by default `$JAXOS4_FLIGHTS`. `InputError`: one is missing."""
    if folder is None and os.environ.get("JAXOS4_FLIGHTS"):
        folder = Path(os.environ["JAXOS4_FLIGHTS"])
    advice = "give the folder of the flights, here or in the environment variable JAXOS4_FLIGHTS."
    if folder is None:
        raise InputError(f"--flights: no folder; {advice}")
    names = list(names)
    if missing := [name for name in names if not (folder / name).is_file()]:
        raise InputError(f"--flights: no {missing[0]} in the folder {folder}; {advice}")
    return [folder / name for name in names]


def run_studies(studies: dict[str, Study], out: Path) -> None:
    """Runs or resumes each study in the folder of its name in `out`. Raises what `open_store` raises.

    Prints a line for each study, scenario, noise scale and estimator, and what this run took: nothing for cells that
    were there.
    """
    found, spent = {}, []
    for name, study in studies.items():
        begin = time.perf_counter()
        found[name] = run_with_bar(study, out / name)
        spent.append(
            (name or study.title, f"{study.flights:,}", f"{time.perf_counter() - begin:.0f}", f"{peak_mib():,.0f}")
        )
    print_table("time and memory of this run", ("study", "flights", "time [s]", "peak memory [MiB]"), spent)
    titles = {f"{study.title}: {study.flights} flights, seed {study.seed}" for study in studies.values()}
    error = monte_carlo_error(max(study.flights for study in studies.values()))
    headings = "scenario", "noise", "estimator", "RMSE / bound", "95 % intervals that hold [%]", "rollouts", "results"
    lines = (line for name, data in found.items() for line in study_lines(name, data))
    print_table(f"{', '.join(titles)}, {error} of the RMSE", headings, lines)


def study_lines(name: str, dataset: xr.Dataset) -> Iterator[tuple[str, ...]]:
    """The lines of a study, for each scenario, noise scale and estimator; `name`: begins the first cell of each."""
    every = scenarios(dataset)
    for label, data in every:
        label = ", ".join(filter(None, (name, label if len(every) > 1 else "")))
        ratio, held = metrics.efficiency(data)["efficiency"], metrics.mean_coverage(data).sel(level=0.95)
        spent, results = metrics.mean_rollouts(data), metrics.result_counts(data)
        for scale, estimator in itertools.product(data["scale"].values, data["estimator"].values):
            at = {"scale": scale, "estimator": estimator}
            counts = {str(code): int(n) for code, n in results.sel(at).to_series().items() if n}
            yield (
                *(label, f"{scale:g}", estimator, span(ratio.sel(at))),
                *(f"{100 * held['coverage'].sel(at):.1f}", f"{spent.sel(at):.0f}", in_words(counts)),
            )


def span(values: xr.DataArray | np.ndarray, digits: int = 3) -> str:
    """The smallest and the largest number as the text of a table cell; empty if there is none."""
    known = np.asarray(values)[np.isfinite(values)]
    return " to ".join(dict.fromkeys(plain(end, digits) for end in (known.min(), known.max()))) if known.size else ""


def save_results(dataset: xr.Dataset, study: Study, out: Path) -> None:
    """Writes a Dataset that was not computed by the cells of `study`, with the provenance of `study`, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_netcdf(out / RESULTS_FILE, dataset.assign_attrs(provenance(study, device_name())), 4)


def load_results(directory: Path) -> xr.Dataset:
    """Reads the Dataset that `save_results` wrote."""
    return xr.load_dataset(directory / RESULTS_FILE, engine="h5netcdf")


@eqx.filter_jit
def measure(noise: AbstractNoise, exact: Flight, keys: Keys[Array, " flights"]) -> Float[Array, "flights samples 12"]:
    """The states of a flight as noisy sensors measure them, once for each key."""
    return jax.lax.map(lambda key: noise(exact, key=key).states, keys)


@eqx.filter_jit
def identify(
    estimator: AbstractEstimator,
    problem: ShootingProblem,
    brackets: Bracket,
    states: Float[Array, "flights samples 12"],
) -> Estimate:
    """Identifies many flights in one call; flight i has the measurements `states[i]` and the bracket `brackets[i]`."""

    def one(bracket: Bracket, states: States) -> Estimate:
        return estimator(eqx.tree_at(lambda p: p.flight.states, problem, states), bracket)

    return jax.vmap(one)(brackets, states)


def standard_problem(
    model: AbstractModel,
    channels: str = "all",
    *,
    scale: float = 1.0,
    known: bool = True,
    windows: int = 1,
    omega=None,
    dt: float = DT,
) -> ShootingProblem:
    """The standard flight of a model, or that of other rotor speeds, without noise; for sensors of this `scale`."""
    exact = simulate(model, model.alpha, multisine(model.airframe) if omega is None else omega, dt=dt)
    settings = {"channels": channels, "windows": windows, "initial_state": exact.states[0] if known else None}
    return ShootingProblem(model, exact, sigma=scale * SENSOR_SIGMA, **settings)


def brackets_around(model: AbstractModel, keys: Keys[Array, " flights"], share: float = 0.8) -> Bracket:
    """For each key, a bracket of the default width. Its centre lies within `share` half-widths of the truth."""

    def one(key: Key) -> Bracket:
        offset = jax.random.uniform(key, model.alpha.shape, minval=-share, maxval=share, dtype=float)
        return Bracket.around(model.alpha + offset * model.half_width, model.half_width)

    return jax.vmap(one)(keys)


def brackets_at(model: AbstractModel, offset: float, flights: int) -> Bracket:
    """The same bracket for each flight: of the default width, `offset` half-widths from the truth."""
    bracket = Bracket.around(model.alpha + offset * model.half_width, model.half_width)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (flights, *x.shape)), bracket)


def flight_keys(seed: int, flights: int) -> Keys[Array, "2 flights"]:
    """The random keys of the noise and of the brackets of flights."""
    return jax.vmap(jax.random.split, out_axes=1)(jax.random.split(jax.random.key(seed), flights))


def fit_noisy(
    estimator: AbstractEstimator, problem: ShootingProblem, flights: int, seed: int, noise: AbstractNoise | None = None
) -> tuple[Estimate, float]:
    """Estimates of noisy copies of a problem's flight, each in a bracket of its own; and the seconds for each.

    `problem`: by `standard_problem`. `noise`: by default white, as large as the problem says. A second call takes the
    time without that of compiling.
    """
    keys = flight_keys(seed, flights)
    brackets = brackets_around(problem.model, keys[1])

    def part(some: slice) -> Estimate:
        states = measure(noise or WhiteNoise(problem.sigma), problem.flight, keys[0][some])
        return jax.block_until_ready(identify(estimator, problem, jax.tree.map(lambda x: x[some], brackets), states))

    parts, begin = [slice(first, first + CHUNK) for first in range(0, flights, CHUNK)], time.perf_counter()
    found = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(part, parts))
    return found, (time.perf_counter() - begin) / flights


def scores(problem: ShootingProblem, found: Estimate) -> Row:
    """A row of a table: errors, in bounds of the problem's flight, and coverage of those that have an answer."""
    results = result_names(found.result)
    answered = np.isin(results, metrics.CONVERGED)
    bound = np.sqrt(np.diagonal(cramer_rao_bound(problem, problem.model.alpha)))
    error, half_width = np.asarray(found.parameters - problem.model.alpha), np.asarray(found.half_width(0.95))
    own, some = error[answered] / bound, answered.any()
    return {
        "flights": len(error),
        "answers": int(answered.sum()),
        "results": count_results(results),
        "efficiency": np.sqrt(np.mean(own**2, axis=0)).tolist() if some else None,
        "bias": np.mean(own, axis=0).tolist() if some else None,
        "monte_carlo_error": float(1 / np.sqrt(2 * max(answered.sum(), 1))),
        # A flight without an answer has an infinite interval, and counts as not covered.
        "covered": (np.isfinite(half_width) & (np.abs(error) < half_width)).mean(axis=0).tolist(),
        "std": np.median(found.std / bound, axis=0).tolist(),
        "rollouts": float(np.mean(found.rollouts)),
    }


def monte_carlo_error(flights: int) -> str:
    """The Monte-Carlo error of a root mean square, for the title of a table."""
    return f"Monte-Carlo error {1 / np.sqrt(2 * flights):.2g}"


class Fit(NamedTuple):
    """Noisy standard flights of one kind, and the estimator that identifies them."""

    estimator: AbstractEstimator
    model: str = "published"
    channels: str = "all"
    scale: float = 1.0
    known: bool = True
    windows: int = 1

    @property
    def problem(self) -> ShootingProblem:
        """The flight without noise."""
        settings = {"scale": self.scale, "known": self.known, "windows": self.windows}
        return standard_problem(MODELS[self.model](jaxos4.OS4), self.channels, **settings)

    def row(self, flights: int, seed: int, noise: AbstractNoise | None = None) -> tuple[Row, Estimate]:
        """The row of this many flights, with the seconds for each, and their estimates."""
        problem = self.problem
        found, seconds = fit_noisy(self.estimator, problem, flights, seed, noise)
        return scores(problem, found) | {"seconds": seconds}, found


# Columns of tables.
EFFICIENCY: dict[str, Column] = {
    name: lambda row, i=i: row["efficiency"][i] if row["efficiency"] else None for i, name in enumerate(PARAMETERS)
}
SPAN: dict[str, Column] = {"RMSE / bound": lambda row: span(np.asarray(row["efficiency"] or []))}
ENDED: dict[str, Column] = {"rollouts": "rollouts", "results": "results"}
