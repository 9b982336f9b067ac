"""Reads the Dataset of a study from its folder."""

from pathlib import Path

import xarray as xr

from ..errors import InputError
from ..study import RESULTS_FILE, metrics

_DIMENSIONS = (*metrics.SCENARIO, "flight", "parameter")
_VARIABLES = {
    "truth": tuple(name for name in _DIMENSIONS if name != "estimator"),
    "center": ("model", "airframe", "width", "parameter"),
    "estimate": _DIMENSIONS,
    "half_width": (*_DIMENSIONS, "level"),
    "bound": _DIMENSIONS,
    "result": (*metrics.SCENARIO, "flight"),
    "rollouts": (*metrics.SCENARIO, "flight"),
    "hit": (*metrics.SCENARIO, "flight"),
    "seen": ("channels", "estimator"),
    "unit": ("parameter",),
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
    if missing := _what_is_missing(dataset):
        raise InputError(f"{path}: not the results of a study: {missing}; give a folder that `jaxos4 study` wrote.")
    return dataset


def _what_is_missing(dataset: xr.Dataset) -> str:
    """Why a Dataset is not the results of a study, or an empty string."""
    for name, dimensions in _VARIABLES.items():
        if name not in dataset.variables:
            return f"no variable `{name}`"
        if set(dataset[name].dims) != set(dimensions):
            return f"`{name}` is not along {', '.join(dimensions)}"
    for name in (*_DIMENSIONS, "level"):
        if dataset.sizes[name] == 0:
            return f"nothing along `{name}`"
        if name not in dataset.coords:
            return f"no coordinate `{name}`"
    for name in ("truth", "center", "estimate", "half_width", "bound", "rollouts", "hit", "scale", "level"):
        if dataset[name].dtype.kind not in "fiu":
            return f"`{name}` does not hold numbers"
    attributes = dataset["result"].attrs
    if not {"flag_values", "flag_meanings"} <= attributes.keys():
        return "`result` does not say what its codes mean"
    return ""
