"""The results of a study as an xarray Dataset with units, names and provenance."""

import itertools
import json
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np
import tomlkit
import xarray as xr

from .._files import write_netcdf
from .._version import __version__
from ..errors import InputError
from ..models import MODELS
from .cell import LEVELS, OUTCOMES, fleet_of, fly
from .metrics import SCENARIO
from .specification import AXES, Study
from .store import RESULTS_FILE, Store

# For each variable of a flight: its further dimensions, type, unit and description.
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "truth": (("parameter",), "f8", "unit", "true parameter"),
    "estimate": (("parameter",), "f8", "unit", "estimated parameter; missing where `result` says that there is none"),
    "std": (("parameter",), "f8", "unit", "standard deviation that the estimator gives"),
    "half_width": (("parameter", "level"), "f8", "unit", "half the interval that claims to hold the truth at `level`"),
    "bound": (("parameter",), "f8", "unit", "Cramer-Rao standard deviation, white noise, of the channels `seen`"),
    "result": ((), "i1", "1", "how the estimate ended"),
    "rollouts": ((), "i4", "1", "simulated flights that the estimate took"),
    "cost": ((), "f8", "1", "1/2 |W (y - x)|^2 at the estimate, of the channels `seen`"),
    "hit": ((), "i1", "1", "whether the hybrid's seed bracket held the truth; -1 for other estimators"),
}
_AXES = {
    "model": "equations that are fitted, and flown",
    "airframe": "airframe that is flown",
    "excitation": "rotor speeds that are flown",
    "duration": "length of a flight",
    "method": "how true flights are simulated",
    "noise": "kind of sensor noise",
    "scale": "noise in multiples of the standard sensors'",
    "width": "bracket in multiples of the default half-width",
    "channels": "what was measured",
    "estimator": "estimator",
    "flight": "number of the flight: the same draws in all scenarios",
    "parameter": "parameter",
    "level": "share of intervals that should hold the truth",
}


def assemble(store: Store) -> xr.Dataset:
    """The Dataset of a study's finished cells; the result of all others is `not_run`.

    Its dimensions are all axes of the grid, `flight`, `parameter` and `level`.

    **Raises:** `InputError` if a cell's file is damaged.
    """
    study = store.study
    coordinates = _coordinates(study)
    sizes = {name: len(values) for name, (_, values, _) in coordinates.items()}
    arrays = {
        name: np.full([sizes[dim] for dim in _dims(name)], np.nan if kind == "f8" else -1, kind)
        for name, (_, kind, _, _) in _VARIABLES.items()
    }
    arrays["result"][...] = OUTCOMES.index("not_run")
    arrays["rollouts"][...] = 0
    failures = []
    for cell in study.cells():
        results = store.read(cell.number)
        if results is None:
            continue
        flights = slice(cell.first, min(cell.first + study.batch, study.flights))
        lanes, shared = (*cell.place, flights), (*cell.place[:-1], flights)
        if "failed" in results:
            arrays["result"][lanes] = OUTCOMES.index("failed")
            # Another estimator that has run has stored the same truths, bit for bit.
            if np.isnan(arrays["truth"][shared]).all():
                truth = fly(study, fleet_of(study, cell.scenario), cell).truth
                arrays["truth"][shared] = np.asarray(truth)[: flights.stop - flights.start]
            where = dict(zip(SCENARIO, cell.scenario, strict=True))
            failures.append({"cell": cell.number, "first": cell.first, **where, "message": str(results["failed"])})
            continue
        try:
            for name in _VARIABLES:
                arrays[name][shared if name == "truth" else lanes] = results[name]
        except (KeyError, ValueError):
            path = store.cell_file(cell.number)
            raise InputError(f"{path}: not a cell of this study; delete it, and run the study again.") from None
    named = {name: _named(long_name, unit) for name, (_, _, unit, long_name) in _VARIABLES.items()}
    named["result"] |= {"flag_values": np.arange(len(OUTCOMES), dtype=np.int8), "flag_meanings": " ".join(OUTCOMES)}
    variables = {name: (_dims(name), arrays[name], attributes) for name, attributes in named.items()}
    command = {"command": "jaxos4 study study.toml --out DIR", "failures": json.dumps(failures)}
    variables |= _brackets(study)
    return xr.Dataset(variables, coords=coordinates, attrs=provenance(study, store.device) | command)


def _dims(name: str) -> tuple[str, ...]:
    """The dimensions of a variable; the truth is the same for all estimators."""
    return (*(SCENARIO[:-1] if name == "truth" else SCENARIO), "flight", *_VARIABLES[name][0])


def save_dataset(dataset: xr.Dataset, directory: Path) -> None:
    """Writes a study's Dataset into its folder, completely or not at all."""
    write_netcdf(directory / RESULTS_FILE, dataset, 4)


def _coordinates(study: Study) -> dict[str, tuple]:
    model = MODELS[study.models[0]](study.vehicle(study.airframes[0]))
    values = {dim: list(getattr(study, axis)) for dim, axis in zip(SCENARIO, AXES, strict=True)}
    values |= {"flight": np.arange(study.flights), "parameter": list(model.parameter_names), "level": list(LEVELS)}
    units = {"duration": "s"}
    coordinates = {dim: (dim, values[dim], _named(name, units.get(dim, "1"))) for dim, name in _AXES.items()}
    return coordinates | {"unit": ("parameter", list(model.parameter_units), _named("unit of the parameter", "1"))}


def provenance(study: Study, device: str) -> dict[str, str | int]:
    """The attributes of a Dataset that say where it comes from; `device`: the devices that computed it, in words."""
    return {
        "title": study.title,
        "specification": tomlkit.dumps(msgspec.to_builtins(study)),
        "version": __version__,
        "jax": jax.__version__,
        "precision": "float64",
        "device": device,
        "seed": study.seed,
    }


def _brackets(study: Study) -> dict[str, tuple]:
    """The brackets of all searches and networks, by model, airframe and width, and the channels that are seen."""
    first, dims = study.cell(0).scenario, ("model", "airframe", "width", "parameter")
    brackets = [
        fleet_of(study, first._replace(model=model, airframe=airframe, width=width)).bracket
        for model, airframe, width in itertools.product(study.models, study.airframes, study.widths)
    ]
    shape = [len(study.models), len(study.airframes), len(study.widths), -1]
    lower, upper = (np.stack([getattr(b, end) for b in brackets]).reshape(shape) for end in ("lower", "upper"))
    seen = [[first._replace(channels=c, estimator=e).seen for e in study.estimators] for c in study.channels]
    return {
        "center": (dims, (lower + upper) / 2, _named("middle of the bracket", "unit")),
        "bracket_half_width": (dims, (upper - lower) / 2, _named("half the width of the bracket", "unit")),
        "seen": (("channels", "estimator"), seen, _named("channels that the estimator looks at", "1")),
    }


def _named(long_name: str, units: str) -> dict[str, Any]:
    return {"long_name": long_name, "units": units}
