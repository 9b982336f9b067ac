"""A result in other forms: arrays as lists, a pandas DataFrame, an xarray Dataset."""

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, SupportsFloat

import numpy as np

from .._version import __version__
from ..analysis.frequency_response import FrequencyResponse
from ..analysis.prediction import Predictions
from ..errors import InputError
from ..results import NINETY_FIVE

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_COLUMNS = ("kind", "unit", "estimate", "std", "low", "high", "bound", "note")
_NONE = (None, None)


def finite_or_none(value: SupportsFloat) -> float | None:
    """A number, or `None` if it is not finite."""
    return float(value) if math.isfinite(float(value)) else None


def as_list(array: np.ndarray) -> list[Any]:
    """An array as a list; `None` for what is not finite."""
    values = array.astype(object)
    values[~np.isfinite(array)] = None
    return values.tolist()


def dataframe(constants: Mapping[str, Any], parameters: Mapping[str, Any], fixed: Mapping[str, Any]) -> "pd.DataFrame":
    """See `Identification.to_dataframe`. All rows by name: `Constant`, `ParameterEstimate`, `FixedParameter`."""
    rows: dict[str, tuple[Any, ...]] = {}
    for name, row in constants.items():
        half = NINETY_FIVE * row.std
        ends = row.estimate - half, row.estimate + half
        rows[name] = ("constant", row.unit, row.estimate, row.std, *ends, None, row.note or "")
    for name, row in parameters.items():
        rows[name] = ("parameter", row.unit, row.estimate, row.std, *(row.ci95 or _NONE), row.bound, row.note)
    for name, row in fixed.items():
        rows[name] = ("held", row.unit, row.value, 0.0, *_NONE, None, row.note)
    table = _imported("pandas").DataFrame.from_dict(rows, orient="index", columns=_COLUMNS)
    return table.astype(dict.fromkeys(_COLUMNS[2:7], float)).rename_axis("name")


def dataset(
    parameters: Mapping[str, Any],
    covariance: Sequence[Sequence[float]] | None,
    predictions: Predictions | None,
    response: FrequencyResponse | None,
    *,
    sample_time: float,
    **about: str,
) -> "xr.Dataset":
    """See `Identification.to_dataset`. `sample_time`: of the predictions [s]. `about`: attributes."""
    names, rows = list(parameters), list(parameters.values())
    ends = np.array([row.ci95 or _NONE for row in rows], dtype=float).reshape(-1, 2)
    columns = {
        "estimate": np.array([row.estimate for row in rows], dtype=float),
        "std": np.array([row.std for row in rows], dtype=float),
        "low": ends[:, 0],
        "high": ends[:, 1],
    }
    variables: dict[str, Any] = {name: ("parameter", column) for name, column in columns.items()}
    coordinates: dict[str, Any] = {"parameter": names, "unit": ("parameter", [row.unit for row in rows])}
    if covariance is not None:
        variables["covariance"] = (("parameter", "other"), np.array(covariance).reshape(2 * [len(names)]))
        coordinates["other"] = names
    if predictions is not None:
        both = ("start", "horizon", "rate")
        for name, rates in (("predicted", predictions.predicted), ("measured", predictions.measured)):
            variables[name] = (both, rates, {"units": "rad/s"})
        variables["initial"] = (("start", "rate"), predictions.initial, {"units": "rad/s"})
        coordinates |= {
            "start": ("start", predictions.start * sample_time, {"units": "s"}),
            "horizon": ("horizon", predictions.horizons, {"units": "s"}),
            "rate": list("pqr"),
        }
    if response is not None:
        for name in ("gain", "phase", "coherence", "half_width"):
            variables[name] = (("axis", "frequency"), np.stack([getattr(axis, name) for axis in response]))
        coordinates |= {
            "axis": list(response._fields),
            "frequency": ("frequency", response.roll.frequency, {"units": "Hz"}),
        }
    return _imported("xarray").Dataset(variables, coords=coordinates, attrs=about | {"version": __version__})


def _imported(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError:
        raise InputError(f"the package {package} is missing; install it: `pip install {package}`.") from None
