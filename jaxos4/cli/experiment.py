"""What the scripts in `experiments/` share: studies that differ in what is no axis, Datasets and figures as files."""

import importlib.metadata
from collections.abc import Callable
from pathlib import Path

import jax
import msgspec
import numpy as np
import tomlkit
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._files import write_atomically
from ..report.style import Style, drawing, pdf, svg
from ..study import RESULTS_FILE, Study, run_here, save_dataset
from ._studies import carry_out, device_name, use_all_cores as use_all_cores


def run_studies(studies: dict[str, Study], out: Path) -> None:
    """Runs each study into a folder of that name in `out`, or goes on with it. Raises as `open_store` does."""
    for name, study in studies.items():
        carry_out(study, out / name, device_name(), run_here)


def save_results(dataset: xr.Dataset, study: Study, out: Path) -> None:
    """Writes what was computed without a study's cells, with its provenance, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    provenance = {
        "title": study.title,
        "specification": tomlkit.dumps(msgspec.to_builtins(study)),
        "version": importlib.metadata.version("jaxos4"),
        "jax": jax.__version__,
        "precision": study.precision,
        "device": device_name(),
        "seed": study.seed,
    }
    save_dataset(dataset.assign_attrs(provenance), out)


def load_results(directory: Path) -> xr.Dataset:
    """What `save_results` wrote into a folder."""
    return xr.load_dataset(directory / RESULTS_FILE, engine="h5netcdf")


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
