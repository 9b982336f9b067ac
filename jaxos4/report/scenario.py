"""A study divided into the parts that one table or figure compares: scenarios of all noise scales and estimators."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import xarray as xr

from ..study.metrics import SCENARIO

# A table or figure compares along these dimensions.
_SHOWN = ("scale", "estimator")

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


class Scenario(NamedTuple):
    """The data of one value on each axis except noise scale and estimator."""

    number: int
    label: str
    data: xr.Dataset


def scenarios(dataset: xr.Dataset) -> Iterator[Scenario]:
    """All scenarios, numbered from 1. The label names the dimensions that differ, or all if there is one scenario."""
    fixed = [name for name in SCENARIO if name not in _SHOWN]
    varied = [name for name in fixed if dataset.sizes[name] > 1] or fixed
    for number, at in enumerate(itertools.product(*(range(dataset.sizes[name]) for name in fixed)), start=1):
        data = dataset.isel(dict(zip(fixed, at, strict=True)))
        yield Scenario(number, ", ".join(_PHRASES[name].format(data[name].item()) for name in varied), data)


def count(dataset: xr.Dataset) -> int:
    """The number of scenarios."""
    return sum(1 for _ in scenarios(dataset))


def names(data: xr.Dataset | xr.DataArray, dimension: str) -> list[str]:
    """The labels along a dimension."""
    return [str(name) for name in data[dimension].values]


def bounds(data: xr.Dataset) -> dict[str, int]:
    """The channels that estimators look at, each with the index of an estimator that has their bound."""
    found: dict[str, int] = {}
    known = data["bound"].notnull().any([name for name in data["bound"].dims if name != "estimator"])
    for place in sorted(range(data.sizes["estimator"]), key=lambda i: not known[i]):  # first those that were run
        found.setdefault(str(data["seen"].isel(estimator=place).item()), place)
    return dict(sorted(found.items(), key=lambda item: item[1]))
