"""A result as tables: its physical quantities, a pandas DataFrame, and an xarray Dataset."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._version import __version__
from ..airframe import MOTIONS, YAW
from ..analysis.inertia import CenterOfMass, center_of_mass
from ..errors import InputError
from ..models.terms import TERMS
from .results import Constant, Identification, RigidBody, VehicleIdentification
from .verdict import RIGID_BODY, Verdict

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CENTER = "center of mass"
_ORDER = ("thrust", "motors", CENTER, "damping", "drag")  # of a vehicle's quantities, after the moments of inertia
_COLUMNS = ("kind", "unit", "estimate", "std", "low", "high", "bound", "note")
_NONE = (None, None)


class PhysicalQuantity(NamedTuple):
    """A physical quantity of a vehicle, or a parameter of an OS4.

    - `name`: in words, such as `"rotor lag"`. `unit`: of all numbers; `"1"` without one.
    - `value`, `std`: the estimate and its standard deviation. `ci95`: its 95 % interval.
    - `condition`: the condition under which it holds, in words; may be empty.
    - `judged`: the name of its verdict. `verdict`: the verdict; `None` without one.
    """

    name: str
    unit: str
    value: float
    std: float
    ci95: tuple[float, float]
    condition: str
    judged: str
    verdict: Verdict | None

    @property
    def trusted(self) -> bool:
        """Whether no verdict refuses it."""
        return self.verdict is None or self.verdict.trusted


def physical_quantities(found: Identification) -> list[PhysicalQuantity]:
    """Moments of inertia, then thrust, motors, centre of mass, damping and drag; of an OS4 its alphas and J_R too.

    A quantity that was not estimated is not in the table, nor is one that `possible` leaves out.
    """
    quantities: list[PhysicalQuantity] = []

    def add(name: str, row: Constant, ci95: tuple[float, float], judged: str) -> None:
        verdict, note = found.verdicts.get(judged), row.note or ""
        quantities.append(PhysicalQuantity(name, row.unit, row.estimate, row.std, ci95, note, judged, verdict))

    constants = found.rigid_body.constants if found.is_vehicle else possible(found.rigid_body)
    for name, row in constants.items():
        add(name, row, row.ci95, name if found.is_vehicle else RIGID_BODY)
    # The name of the verdict on each parameter.
    judged = {name: name for name in found.parameters}
    if found.is_vehicle:
        terms = [term for term in TERMS.values() if term.quantity]
        judged = {x.name: term.quantity for term in terms for x in term.parameters if x.force_axis is None}
    for name, row in found.parameters.items():
        if row.estimate is None or row.std is None or row.ci95 is None:
            continue
        if judged.get(name, CENTER) != CENTER:
            add(name.replace("_", " "), Constant(row.estimate, row.std, row.unit), row.ci95, judged[name])
    if found.is_vehicle:
        for each in centers_of_mass(found):
            center = Constant(1e3 * each.value, 1e3 * each.std, "mm", "if rotors are alike")
            add(f"{CENTER} {each.axis}", center, center.ci95, CENTER)
        quantities.sort(key=lambda each: _ORDER.index(each.judged) if each.judged in _ORDER else -1)
    return quantities


def possible(body: RigidBody) -> dict[str, Constant]:
    """The constants of a rigid body that are clearly positive; J_R only if it is not larger than Iz."""
    vehicle = body.constants.get(YAW.inertia)
    most = {} if vehicle is None else {"J_R": vehicle.estimate}
    every = ((name, row, most.get(name, np.inf)) for name, row in body.constants.items())
    return {name: row for name, row, limit in every if row.margin < row.estimate <= limit}


def centers_of_mass(found: Identification) -> list[CenterOfMass]:
    """The coordinates of the centre of mass that were estimated; see `jaxos4.center_of_mass`."""
    if found.covariance is None:
        return []
    values = [np.nan if row.estimate is None else row.estimate for row in found.parameters.values()]
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        every = center_of_mass(tuple(found.parameters), np.array(values), np.array(found.covariance), found.airframe)
    return [each for each in every if np.isfinite([each.value, each.std]).all()]


def dataframe(found: Identification) -> "pd.DataFrame":
    """See `Identification.to_dataframe`."""
    rows: dict[str, tuple[Any, ...]] = {}
    for name, row in found.rigid_body.constants.items():
        rows[name] = ("constant", row.unit, row.estimate, row.std, *row.ci95, None, row.note or "")
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
