"""A result as a pandas DataFrame and as an xarray Dataset."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from .._version import __version__
from ..airframe import MOTIONS
from ..errors import InputError
from ..results import NINETY_FIVE
from .results import Identification, VehicleIdentification

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
_COLUMNS = ("kind", "unit", "estimate", "std", "low", "high", "bound", "note")
_NONE = (None, None)


def dataframe(found: Identification) -> "pd.DataFrame":
    """See `Identification.to_dataframe`."""
    rows: dict[str, tuple[Any, ...]] = {}
    for name, row in found.rigid_body.constants.items():
        half = NINETY_FIVE * row.std
        ends = row.estimate - half, row.estimate + half
        rows[name] = ("constant", row.unit, row.estimate, row.std, *ends, None, row.note or "")
    for name, row in found.parameters.items():
        rows[name] = ("parameter", row.unit, row.estimate, row.std, *(row.ci95 or _NONE), row.bound, row.note)
    for name, row in found.held.items() if isinstance(found, VehicleIdentification) else ():
        rows[name] = ("held", row.unit, row.value, 0.0, *_NONE, None, row.note)
    table = _imported("pandas").DataFrame.from_dict(rows, orient="index", columns=_COLUMNS)
    return table.astype(dict.fromkeys(_COLUMNS[2:7], float)).rename_axis("name")


def dataset(found: Identification) -> "xr.Dataset":
    """See `Identification.to_dataset`."""
    names, rows = list(found.parameters), list(found.parameters.values())
    ends = np.array([row.ci95 or _NONE for row in rows], dtype=float).reshape(-1, 2)
    columns = {
        "estimate": np.array([row.estimate for row in rows], dtype=float),
        "std": np.array([row.std for row in rows], dtype=float),
        "low": ends[:, 0],
        "high": ends[:, 1],
    }
    variables: dict[str, Any] = {name: ("parameter", column) for name, column in columns.items()}
    coordinates: dict[str, Any] = {"parameter": names, "unit": ("parameter", [row.unit for row in rows])}
    if found.covariance is not None:
        variables["covariance"] = (("parameter", "other"), np.array(found.covariance).reshape(2 * [len(names)]))
        coordinates["other"] = names
    ahead = response = None
    if isinstance(found, VehicleIdentification):
        ahead, response = found.predictions, found.response
    if ahead is not None:
        both = ("start", "horizon", "rate")
        for name, rates in (("predicted", ahead.predicted), ("measured", ahead.measured)):
            variables[name] = (both, rates, {"units": "rad/s"})
        variables["initial"] = (("start", "rate"), ahead.initial, {"units": "rad/s"})
        coordinates |= {
            "start": ("start", ahead.start * found.provenance.sample_time, {"units": "s"}),
            "horizon": ("horizon", ahead.horizons, {"units": "s"}),
            "rate": list("pqr"),
        }
    if response is not None:
        for name in ("gain", "phase", "coherence", "half_width"):
            variables[name] = (("axis", "frequency"), np.stack([getattr(axis, name) for axis in response]))
        coordinates |= {
            "axis": list(MOTIONS),
            "frequency": ("frequency", response.roll.frequency, {"units": "Hz"}),
        }
    about = {"estimator": found.estimator, "model": found.model, "result": found.result, "version": __version__}
    return _imported("xarray").Dataset(variables, coords=coordinates, attrs=about)


def _imported(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError:
        raise InputError(f"the package {package} is missing; install it: `pip install {package}`.") from None
