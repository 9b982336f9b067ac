"""Reads the Dataset of a study, and divides it into the scenarios that one table or figure compares."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from ..errors import InputError
from ..study import RESULTS_FILE, metrics

_DIMENSIONS = {*metrics.SCENARIO, "flight", "parameter", "level"}
_VARIABLES = {"truth", "center", "estimate", "half_width", "bound", "result", "rollouts", "hit", "seen", "unit"}
_PHRASES = {
    "model": "{} model",
    "airframe": "airframe {}",
    "excitation": "{}",
    "duration": "{:g} s",
    "method": "truth by {}",
    "noise": "{} noise",
    "width": "bracket x {:g}",
    "channels": "{} channels",
}


def read_results(directory: Path) -> xr.Dataset:
    """Reads the Dataset in a study's folder.

    **Raises:** `InputError` if there is no Dataset, or if the file is not the results of a study.
    """
    path = directory / RESULTS_FILE
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; give one that `jaxos4 study` wrote.")
    if not path.is_file():
        raise InputError(f"{directory}: holds no {RESULTS_FILE}; give a folder that `jaxos4 study` wrote.")
    try:
        with xr.open_dataset(path, engine="h5netcdf", phony_dims="sort") as opened:
            dataset = opened.load()
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        what = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a netCDF file that can be read ({what}); run the study again.") from None
    if missing := ", ".join(sorted(_VARIABLES - dataset.variables.keys() | _DIMENSIONS - set(dataset.dims))):
        raise InputError(f"{path}: not the results of a study: no {missing}; give a folder that `jaxos4 study` wrote.")
    return dataset


class Scenario(NamedTuple):
    """The data that one table or figure compares: all noise scales and estimators, one value on each other axis."""

    number: int
    label: str
    data: xr.Dataset


def scenarios(dataset: xr.Dataset) -> Iterator[Scenario]:
    """All scenarios, numbered from 1. The label names the dimensions that differ, or all if there is one scenario."""
    fixed = [name for name in metrics.SCENARIO if name in _PHRASES]
    varied = [name for name in fixed if dataset.sizes[name] > 1] or fixed
    for number, at in enumerate(itertools.product(*(range(dataset.sizes[name]) for name in fixed)), start=1):
        data = dataset.isel(dict(zip(fixed, at, strict=True)))
        yield Scenario(number, ", ".join(_PHRASES[name].format(data[name].item()) for name in varied), data)


def names(data: xr.Dataset | xr.DataArray, dimension: str) -> list[str]:
    """The labels along a dimension."""
    return [str(name) for name in data[dimension].values]


def scale_labels(data: xr.Dataset) -> list[str]:
    """The noise scales in words."""
    return [f"noise x {scale:g}" for scale in data["scale"].values]


def bounds(data: xr.Dataset) -> dict[str, int]:
    """The channels that estimators look at, each with the index of an estimator that has their bound."""
    found: dict[str, int] = {}
    known = data["bound"].notnull().any([name for name in data["bound"].dims if name != "estimator"])
    for place in np.argsort(~known.values, kind="stable").tolist():  # first those that were run
        found.setdefault(str(data["seen"].isel(estimator=place).item()), place)
    return dict(sorted(found.items(), key=lambda item: item[1]))


def positive_scales(data: xr.Dataset) -> xr.Dataset:
    """The data without the noise scale 0, which a logarithmic axis cannot show."""
    return data.isel(scale=np.flatnonzero(data["scale"].values > 0))


def error_unit(data: xr.Dataset, parameter: int) -> tuple[str, str, str]:
    """The scale of a parameter's errors: "percent" or "absolute", the unit, and why not percent.

    Absolute if the percentage of any point is meaningless, so that a panel has one scale.
    """
    reason = metrics.no_percentage(data).isel(parameter=parameter)
    if not (reason > 0).any():
        return "percent", "%", ""
    worst = int(reason.where(reason > 0).min())
    at = [f"{scale:g}" for scale in data["scale"].values[(reason > 0).any("estimator").values]]
    where = f" at noise {', '.join(at)}" if len(at) < data.sizes["scale"] else ""
    return "absolute", names(data, "unit")[parameter], metrics.NO_PERCENTAGE[worst] + where


def accuracy(data: xr.Dataset) -> xr.Dataset:
    """`metrics.accuracy` by scale and estimator, with the Monte-Carlo interval of one parameter: a conservative one.

    The mean of several parameters varies less, by how much their errors correlate.
    """
    found, value = metrics.efficiency(data), metrics.accuracy(data)
    low, high = (value * (found[end] / found["efficiency"]).mean("parameter").fillna(1) for end in ("low", "high"))
    return xr.Dataset({"accuracy": value, "low": low, "high": high}).transpose("scale", "estimator")


def best_estimators(data: xr.Dataset) -> dict[str, str]:
    """The estimators that are as accurate as the best one, within Monte-Carlo error, by the noise scales in words."""
    found, best = accuracy(data), {}
    for scale, one in zip(scale_labels(data), (found.isel(scale=i) for i in range(data.sizes["scale"])), strict=True):
        good = (one["low"] <= one["accuracy"].min()).values
        if good.any():
            best.setdefault(", ".join(np.array(names(data, "estimator"))[good]), []).append(scale)
    return {", ".join(scales) if len(best) > 1 else "every noise": names for names, scales in best.items()}
