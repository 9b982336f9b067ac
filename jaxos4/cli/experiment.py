"""What the scripts in `experiments/` share: many flights identified in one call, tables, Datasets, figures as files."""

from collections.abc import Callable, Iterable
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Key as Keys
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from .._custom_types import Key, States
from .._files import write_atomically
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..flight import Flight
from ..models.abstract import AbstractModel
from ..noise import AbstractNoise
from ..report.style import Style, drawing, pdf, svg
from ..shooting import ShootingProblem
from ..study import (
    RESULTS_FILE,
    Study,
    device_name,
    provenance,
    run_here,
    save_dataset,
    use_all_cores as use_all_cores,
)
from ._studies import carry_out

PARAMETERS = tuple(f"a{i}" for i in range(1, 9))
"""Headings of the eight alphas."""


def run_studies(studies: dict[str, Study], out: Path) -> None:
    """Runs each study into a folder of that name in `out`, or goes on with it. Raises as `open_store` does."""
    for name, study in studies.items():
        carry_out(study, out / name, device_name(), run_here)


def save_results(dataset: xr.Dataset, study: Study, out: Path) -> None:
    """Writes what was computed without a study's cells, with its provenance, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    save_dataset(dataset.assign_attrs(provenance(study, device_name())), out)


def load_results(directory: Path) -> xr.Dataset:
    """What `save_results` wrote into a folder."""
    return xr.load_dataset(directory / RESULTS_FILE, engine="h5netcdf")


def table_of(title: str, headings: Iterable[str]) -> Table:
    """An empty table for the terminal. Its columns keep to one line, but for that of `results`."""
    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, no_wrap=heading != "results")
    return table


@eqx.filter_jit
def measure(noise: AbstractNoise, exact: Flight, keys: Keys[Array, " flights"]) -> Float[Array, "flights samples 12"]:
    """What noisy sensors make of a flight, for each key."""
    return jax.lax.map(lambda key: noise(exact, key=key).states, keys)


@eqx.filter_jit
def identify(
    estimator: AbstractEstimator,
    problem: ShootingProblem,
    brackets: Bracket,
    states: Float[Array, "flights samples 12"],
) -> Estimate:
    """Identifies flights that differ in what was measured, each in a bracket of its own, all in one call.

    One program for an estimator and these shapes, whatever the noise, the start and the experiment.
    """

    def one(bracket: Bracket, states: States) -> Estimate:
        return estimator(eqx.tree_at(lambda p: p.flight.states, problem, states), bracket)

    return jax.vmap(one)(brackets, states)


def brackets_around(model: AbstractModel, keys: Keys[Array, " flights"], share: float = 0.8) -> Bracket:
    """For each key a bracket of the default width whose middle lies within a share of that of the truth."""

    def one(key: Key) -> Bracket:
        offset = jax.random.uniform(key, model.alpha.shape, minval=-share, maxval=share, dtype=float)
        return Bracket.around(model.alpha + offset * model.half_width, model.half_width)

    return jax.vmap(one)(keys)


def count_results(names: np.ndarray) -> dict[str, int]:
    """How many estimates ended in which way, from their `result_names`."""
    names, counts = np.unique(names, return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


def in_words(counts: dict[str, int]) -> str:
    """What `count_results` counted, for a cell of a table."""
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def write_figure(draw: Callable[[], Figure | None], directory: Path, name: str) -> None:
    """Draws a figure in the house style, and writes it as SVG and PDF. Where there is nothing to draw, nothing."""
    directory.mkdir(parents=True, exist_ok=True)
    with drawing():
        figure = draw()
        if figure is None:
            return
        for suffix, render in ((".svg", svg), (".pdf", pdf)):
            with write_atomically(directory / f"{name}{suffix}") as beside:
                beside.write_bytes(render(figure))


def draw_spread(panel: Axes, x: np.ndarray, values: xr.DataArray, look: Style, label: str) -> None:
    """The geometric mean over the parameters at each x, with a bar from the least parameter to the largest."""
    values = values.transpose(..., "parameter")
    there = values.notnull().any("parameter").values
    logarithm = xr.apply_ufunc(np.log, values.where(values > 0))
    mean = np.exp(logarithm.mean("parameter").values)
    panel.plot(x, mean, color=look.color, marker=look.marker, linestyle=look.dash, label=label)
    panel.vlines(
        x[there],
        values.min("parameter").values[there],
        values.max("parameter").values[there],
        color=look.color,
        linewidth=1.0,
    )
