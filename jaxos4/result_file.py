"""Reads and validates result files of `jaxos4 estimate`."""

import os
import re
from collections.abc import Iterator
from typing import Any, get_type_hints

import msgspec
import numpy as np

from ._custom_types import as_array
from ._files import read_json
from .airframe import MOTIONS, airframe_from_table
from .analysis.diagnostics import Correlations
from .analysis.frequency_response import FrequencyResponse
from .analysis.prediction import Predictions
from .analysis.traces import Traces
from .errors import InputError, named, of_schema, shortened
from .identification.results import (
    APART,
    VEHICLE_MODEL,
    Constant,
    Identification,
    OS4Identification,
    RigidBody,
    VehicleIdentification,
)
from .models.state import CHANNELS
from .results import NAMES

ResultSource = Identification | str | os.PathLike[str]
"""A result, or its file."""
_NAME = re.compile(r"[\w.() -]{1,80}")
_REMEDY, _AGAIN = "give a file of this version's `jaxos4 estimate --out`", "run `jaxos4 estimate` again."
_LARGEST = 1e30  # far beyond every quantity in SI units, and its square is a number
_EMPTY = "holds no estimate; see what `jaxos4 estimate` says about the flight."
_FIELD: Any = msgspec.field  # its types do not know that a field can have neither default
# Fields that hold arrays. msgspec would check them in the caller's context of jaxtyping, with the axes of its arrays.
_ARRAYS = {"traces": Traces, "correlations": Correlations, "response": FrequencyResponse}
_ARRAYS |= {"predictions": Predictions, "trajectories": Predictions}


def _file_of(kind: type[Identification]) -> type[msgspec.Struct]:
    """The fields of a file of this kind of result: those of the result, with what has another form there."""
    own = [
        (
            x.name,
            dict[str, Any] | None if x.name in _ARRAYS else x.type,
            _FIELD(name=x.encode_name, default=x.default, default_factory=x.default_factory),
        )
        for x in msgspec.structs.fields(kind)
        if x.name not in APART
    ]
    others = [("constants", dict[str, Constant | float | bool]), ("airframe", dict[str, Any] | None)]
    return msgspec.defstruct("File", [*own, *others], kw_only=True)


_FILES = {kind: _file_of(kind) for kind in (OS4Identification, VehicleIdentification)}


def read_result(path: str | os.PathLike[str]) -> Identification:
    """Read a file of `jaxos4 estimate --out`: the result of `jaxos4.identify`, without `estimate` and `problem`.

    **Raises:** `InputError` with one line if the file is no result, or has texts, numbers or correlations that no
    result can have; `OSError` if it cannot be read.
    """
    value = read_json(path, _REMEDY, _LARGEST)
    is_vehicle = isinstance(value, dict) and value.get("model") == VEHICLE_MODEL
    kind = VehicleIdentification if is_vehicle else OS4Identification
    with named(path):
        try:
            fields = msgspec.structs.asdict(msgspec.convert(value, _FILES[kind]))
        except msgspec.ValidationError as error:
            raise InputError(f"not a result: {shortened(of_schema(error), 200)}; {_REMEDY}.") from None
        if fields["airframe"] is None:
            raise InputError(f"{fields['result']}: {_EMPTY}")
        for name, holder in _ARRAYS.items():  # in this order: of several faults, the same one is named each time
            if fields.get(name) is not None:
                fields[name] = _with_arrays(holder, fields[name], name)
        constants, tests = {}, {}
        for name, each in fields.pop("constants").items():
            (constants if isinstance(each, Constant) else tests)[name] = each
        body = RigidBody(constants, tests.pop("consistency_p", None), tests.pop("rigid_body", None))
        found = kind(**fields | {"airframe": airframe_from_table(fields["airframe"]), "rigid_body": body})
        if problem := next(_problems(found, [*tests]), None):
            raise InputError(f"{problem}; {_AGAIN}")
    return found


def _with_arrays(kind: type[msgspec.Struct], table: Any, place: str) -> Any:
    """A struct of arrays, or of such structs, from lists of numbers by name. Raises `InputError`."""
    if not isinstance(table, dict):
        raise InputError(f"`{place}`: is not a table of arrays; {_REMEDY}.")
    fields: dict[str, Any] = {}
    hints: dict[str, Any] = get_type_hints(kind)
    if missing := [name for name in hints if name not in table]:
        raise InputError(f"`{place}`: object missing required field `{missing[0]}`; {_REMEDY}.")
    for name, hint in hints.items():
        value, own = table[name], f"{place}.{name}"
        if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
            fields[name] = _with_arrays(hint, value, own)
            continue
        try:
            fields[name] = as_array(hint, value) if hasattr(hint, "dtypes") else float(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"`{own}`: {error}; {_AGAIN}") from None
    with named(f"`{place}`"):
        return kind(**fields)


def vehicle_result(found: ResultSource) -> VehicleIdentification:
    """The result of a vehicle, given or read, with an estimate. Raises `InputError`, one line; as `read_result`."""
    given = isinstance(found, Identification)
    own = found if given else read_result(found)
    with named("" if given else found):
        if not isinstance(own, VehicleIdentification):
            which = "only a vehicle (--model flight) can be exported or can predict"
            raise InputError(f"`model` {shortened(own.model, 40)}: {which}.")
        if not own.covariance:
            raise InputError(f"{own.result}: {_EMPTY}")
    return own


def _problems(found: OS4Identification | VehicleIdentification, unknown: list[str]) -> Iterator[str]:
    """The faults that no result has, in words. `unknown`: numbers among the constants."""
    if found.result not in NAMES:
        yield f"`result` {shortened(found.result, 40)}: is not a result code"
    fixed = found.held if isinstance(found, VehicleIdentification) else ()
    names = (found.estimator, *found.parameters, *fixed, *found.verdicts, *found.rigid_body.constants)
    if strange := unknown + [each for each in names if not _NAME.fullmatch(each)]:
        yield f"{shortened(strange[0], 40)!r} is no name of an estimator, a parameter or a quantity"
    if found.covariance is not None:
        count = len(found.parameters)
        if [len(row) for row in found.covariance] != count * [count]:
            yield f"`covariance`: is not one of {count} parameters"
        covariance = np.array(found.covariance).reshape(count, count)
        if (np.diag(covariance) < 0).any():
            yield "`covariance`: a variance is negative"
        std = np.sqrt(np.diag(covariance))
        if (np.abs(covariance) > (1 + 1e-6) * np.outer(std, std)).any():  # beyond rounding
            yield "`covariance`: a correlation exceeds 1"
    needed = ("terms", "fitted_seconds") if isinstance(found, VehicleIdentification) else ("channels", "windows")
    if missing := [name for name in needed if getattr(found.provenance, name) is msgspec.UNSET]:
        yield f"`provenance`: has no {missing[0]}"
    crossed = found.correlations
    if crossed is not None and (len(crossed.own) not in CHANNELS.values() or crossed.with_torque.shape[2] % 2 == 0):
        yield "`correlations`: has channels that no model has"
    yield from _problems_of_traces(found)
    if isinstance(found, VehicleIdentification):
        yield from _problems_of_vehicle(found)


def _problems_of_traces(found: Identification) -> Iterator[str]:
    """The faults of traces."""
    if (traces := found.traces) is None:
        return
    channels, simulated = traces.measured.shape[1], traces.predicted.shape[1]
    spatial = {traces.position.shape[1], traces.disturbance.shape[1]}
    if not np.isfinite(np.concatenate([traces.time, traces.start_time])).all() or traces.time.size < 2:
        yield "`traces`: a time is missing"
    if channels not in CHANNELS.values() or simulated not in (0, channels) or spatial - {0, 3}:
        yield "`traces`: has channels that no model has"
    logs = np.concatenate([traces.log, traces.start_log])
    if (logs < 0).any() or (logs > len(found.logs)).any():  # one more: that of `validate`
        yield "`traces`: is of a log that has no name"


def _problems_of_vehicle(found: VehicleIdentification) -> Iterator[str]:
    """The faults of disturbances, predictions and the frequency response."""
    for name, each in found.disturbances.items():
        if each.smoothing is not None and (name in "pqr" or not 0 < each.smoothing < each.time_constant):
            yield f"`disturbances.{name}`: `smoothing` is of a rate, or not between 0 and `time_constant`"
    if (skill := found.skill) is not None:
        table = [each for rate in (skill.p, skill.q, skill.r) for each in msgspec.structs.astuple(rate)]
        if any(len(column) != len(skill.horizons) for column in table):
            yield "`skill`: does not have one value for each horizon"
    ahead, paths = found.predictions, found.trajectories
    for name, one in (("predictions", ahead), ("trajectories", paths)):
        if one is None:
            continue
        usable = one.start.size and one.horizons.size and one.start[0] >= 0
        if not (usable and (np.diff(one.start) > 0).all() and (one.horizons > 0).all()):
            yield f"`{name}`: starts must increase, and horizons be positive"
    if paths is not None:
        if ahead is None or not np.isin(paths.start, ahead.start).all():
            yield "`trajectories`: has starts that are not among those of the predictions"
        elif (np.diff(paths.horizons) <= 0).any() or paths.horizons[-1] > 1.001 * ahead.horizons.max():
            yield "`trajectories`: horizons must increase, up to those of the predictions"
    if ahead is not None and found.traces is not None and ahead.start.size != found.traces.start_time.size:
        yield "`traces`: has not one time for each start of the predictions"
    for name, axis in zip(MOTIONS, found.response or (), strict=False):
        frequency = axis.frequency
        if found.response is not None and not np.array_equal(frequency, found.response.roll.frequency):
            yield "`response`: its axes must have the same frequencies"
        if (frequency <= 0).any() or not (np.diff(frequency) > 0).all():
            yield f"`response.{name}`: frequencies must be positive and increase"
        if (axis.gain <= 0).any() or (np.diagonal(axis.covariance) < 0).any():
            yield f"`response.{name}`: gains must be positive, and variances not negative"
