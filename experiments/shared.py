"""Functions that the experiments share: batched identification, tables, Datasets and figure files."""

import functools
import itertools
import json
import os
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Key as Keys
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.drawing import rendered
from experiments.monte_carlo import count_results, in_words, print_table
from jaxos4._custom_types import Key, States
from jaxos4._files import write_file, write_netcdf
from jaxos4.analysis.evaluation import cramer_rao_bound
from jaxos4.bracket import Bracket
from jaxos4.cli.studies import run_with_bar
from jaxos4.estimate import AbstractEstimator, Estimate
from jaxos4.excitation import multisine
from jaxos4.flight import Flight
from jaxos4.models.abstract import AbstractModel
from jaxos4.noise import SENSOR_SIGMA, AbstractNoise, WhiteNoise
from jaxos4.report.matplotlib_figures import as_matplotlib, drawing
from jaxos4.report.study_tables import scenarios
from jaxos4.report.style import Style
from jaxos4.report.text import plain
from jaxos4.results import result_names
from jaxos4.shooting import ShootingProblem
from jaxos4.simulation import simulate
from jaxos4.study import Study, device_name, metrics, read_results
from jaxos4.study.dataset import RESULTS_FILE, provenance

PARAMETERS = tuple(f"a{i}" for i in range(1, 9))
"""Column headings of the eight alphas."""
DT = 0.01  # of a standard flight [s]
CHUNK = 250  # flights in one call, limited by the memory for the derivatives of the residuals


def flight_files(folder: Path | None, names: Iterable[str]) -> list[Path]:
    """The files of recorded flights in a folder, by default `$JAXOS4_FLIGHTS`. Ends the script if one is missing."""
    if folder is None and os.environ.get("JAXOS4_FLIGHTS"):
        folder = Path(os.environ["JAXOS4_FLIGHTS"])
    paths = [] if folder is None else [folder / name for name in names]
    missing = next((path.name for path in paths if not path.is_file()), None)
    if folder is None or missing is not None:
        raise SystemExit(f"--flights: no {missing or 'flights'} in {folder}: give the folder of the flights.")
    return paths


def run_studies(studies: dict[str, Study], out: Path) -> None:
    """Runs or resumes each study in the folder of its name in `out`. Raises what `open_store` raises.

    Prints a line for each study, scenario, noise scale and estimator, and what this run took: nothing for cells that
    were there.
    """
    found, spent = {}, []
    for name, study in studies.items():
        begin = time.perf_counter()
        found[name] = run_with_bar(study, out / name)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        spent.append((name or study.title, f"{study.flights:,}", f"{time.perf_counter() - begin:.0f}", f"{peak:,.0f}"))
    print_table("time and memory of this run", ("study", "flights", "time [s]", "peak memory [MiB]"), spent)
    titles = {f"{study.title}: {study.flights} flights, seed {study.seed}" for study in studies.values()}
    error = 1 / np.sqrt(2 * max(study.flights for study in studies.values()))
    headings = "scenario", "noise", "estimator", "RMSE / bound", "95 % intervals that hold [%]", "rollouts", "results"
    lines = (line for name, data in found.items() for line in study_lines(name, data))
    print_table(f"{', '.join(titles)}, Monte-Carlo error {error:.2g} of the RMSE", headings, lines)


def study_lines(name: str, dataset: xr.Dataset) -> Iterator[tuple[str, ...]]:
    """The lines of a study, for each scenario, noise scale and estimator; `name`: begins the first cell of each."""
    several = sum(1 for _ in scenarios(dataset)) > 1
    for one in scenarios(dataset):
        label = ", ".join(filter(None, (name, one.label if several else "")))
        ratio, held = metrics.efficiency(one.data)["efficiency"], metrics.mean_coverage(one.data).sel(level=0.95)
        spent, results = metrics.mean_rollouts(one.data), metrics.result_counts(one.data)
        for scale, estimator in itertools.product(one.data["scale"].values, one.data["estimator"].values):
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
    model: AbstractModel, channels: str = "all", *, scale: float = 1.0, known: bool = True, windows: int = 1, omega=None
) -> ShootingProblem:
    """The standard flight of a model, or that of other rotor speeds, without noise; for sensors of this `scale`."""
    exact = simulate(model, model.alpha, multisine(model.airframe) if omega is None else omega, dt=DT)
    settings = {"channels": channels, "windows": windows, "initial_state": exact.states[0] if known else None}
    return ShootingProblem(model, exact, sigma=scale * SENSOR_SIGMA, **settings)


def brackets_around(model: AbstractModel, keys: Keys[Array, " flights"], share: float = 0.8) -> Bracket:
    """For each key, a bracket of the default width. Its centre lies within `share` half-widths of the truth."""

    def one(key: Key) -> Bracket:
        offset = jax.random.uniform(key, model.alpha.shape, minval=-share, maxval=share, dtype=float)
        return Bracket.around(model.alpha + offset * model.half_width, model.half_width)

    return jax.vmap(one)(keys)


def many_times(bracket: Bracket, flights: int) -> Bracket:
    """The same bracket for each flight."""
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


def scores(problem: ShootingProblem, found: Estimate) -> dict[str, Any]:
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


def write_figure(draw: Callable[[], Figure | None], directory: Path, name: str) -> None:
    """Draws a figure in the style of this library and writes it as SVG and PDF; nothing if `draw` returns `None`."""
    directory.mkdir(parents=True, exist_ok=True)
    with drawing():
        figure = draw()
        if figure is None:
            return
        for kind in ("svg", "pdf"):
            write_file(directory / f"{name}.{kind}", rendered(figure, kind))


def of_study(draw: Callable[[xr.Dataset], Any]) -> Callable[[xr.Dataset], Figure | None]:
    """A figure of a study's page, drawn by Matplotlib."""

    def drawn(data: xr.Dataset) -> Figure | None:
        figure = draw(data)
        return None if figure is None else as_matplotlib(figure)

    return drawn


def plotter(read: Callable[[Path], Any], drawn: dict[str, Callable[[Any], Figure | None]]) -> Callable[..., None]:
    """The command that reads the results of an experiment and draws figures, by the names of their files."""

    def main(results: Path, figures: Path) -> None:
        """Draws the results of the experiment."""
        found = read(results)
        for name, draw in drawn.items():
            write_figure(functools.partial(draw, found), figures, name)

    return main


def read_by_noise(directory: Path) -> xr.Dataset:
    """The Dataset of a study, by noise scale and estimator alone."""
    return read_results(directory).squeeze([d for d in metrics.SCENARIO if d not in ("scale", "estimator")])


def read_json(path: Path) -> dict[str, Any]:
    """Reads what an experiment wrote as JSON."""
    return json.loads(path.read_text(encoding="utf-8"))


def read_each(directory: Path) -> dict[str, xr.Dataset]:
    """The Datasets of the studies in a folder, by the names of their folders."""
    return {path.parent.name: read_results(path.parent) for path in sorted(directory.glob("*/results.nc"))}


def draw_spread(panel: Axes, x: np.ndarray, values: xr.DataArray, look: Style, label: str) -> None:
    """Draws the geometric mean over the parameters at each x, with a bar from the smallest to the largest."""
    values = values.transpose(..., "parameter")
    finite = values.notnull().any("parameter").values
    logarithm = xr.apply_ufunc(np.log, values.where(values > 0))
    mean = np.exp(logarithm.mean("parameter").values)
    panel.plot(x, mean, color=look.color, marker=look.marker, linestyle=look.dash, label=label)
    low, high = (end.values[finite] for end in (values.min("parameter"), values.max("parameter")))
    panel.vlines(x[finite], low, high, color=look.color, linewidth=1.0)
