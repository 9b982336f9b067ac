"""The door of result files: all that a file of `jaxos4 estimate --out` holds is checked here, once."""

import os
import re
from collections.abc import Iterator
from functools import partial
from typing import Any, get_type_hints

import msgspec
import numpy as np

from ._files import read_json
from .airframe import airframe_from_table
from .analysis.diagnostics import Correlations
from .analysis.frequency_response import AxisResponse, FrequencyResponse
from .analysis.prediction import Predictions
from .analysis.traces import Traces
from .errors import InputError, named, shortened
from .identification.results import APART, Constant, Identification, RigidBody
from .models.state import CHANNELS
from .results import NAMES

_NAME = re.compile(r"[\w.() -]{1,80}")
_REMEDY, _AGAIN = "give a file of this version's `jaxos4 estimate --out`", "run `jaxos4 estimate` again."
_LARGEST = 1e30  # far beyond every quantity in SI units, and its square is a number
_ALWAYS = {True: ("terms", "fitted_seconds"), False: ("channels", "windows")}  # of a vehicle's provenance, and an OS4's
_EMPTY = "holds no estimate; see what `jaxos4 estimate` says about the flight."

_FIELD: Any = msgspec.field  # its types do not know that a field can have neither default
# The fields of a file: those of an `Identification`, with what has another form there.
_File = msgspec.defstruct(
    "_File",
    [
        *(
            (field.name, field.type, _FIELD(default=field.default, default_factory=field.default_factory))
            for field in msgspec.structs.fields(Identification)
            if field.name not in APART
        ),
        ("constants", dict[str, Constant | float | bool]),
        ("airframe", dict[str, Any] | None),
        ("predictions", dict[str, Any] | None, None),
        ("trajectories", dict[str, Any] | None, None),
        ("response", dict[str, dict[str, Any]] | None, None),
        ("traces", dict[str, Any] | None, None),
        ("correlations", dict[str, Any] | None, None),
    ],
    kw_only=True,
)


def read_result(path: str | os.PathLike[str]) -> Identification:
    """Read a file of `jaxos4 estimate --out`: the result of `jaxos4.identify`, without `estimate` and `problem`.

    **Raises:** `InputError` with one line if the file is no result, or has texts, numbers or correlations that no
    result can have; `OSError` if it cannot be read.
    """
    value = read_json(path, _REMEDY, _LARGEST)
    with named(path):
        try:
            file = msgspec.convert(value, _File)
        except msgspec.ValidationError as error:
            raise InputError(f"not a result ({shortened(' '.join(str(error).split()), 200)}); {_REMEDY}.") from None
        fields = msgspec.structs.asdict(file)
        constants, tests = {}, {}
        for name, each in fields.pop("constants").items():
            (constants if isinstance(each, Constant) else tests)[name] = each
        if fields["airframe"] is None:
            raise InputError(f"{fields['result']}: {_EMPTY}")
        fields |= {
            "airframe": airframe_from_table(fields["airframe"]),
            "rigid_body": RigidBody(constants, tests.pop("consistency_p", None), tests.pop("rigid_body", None)),
            "is_vehicle": fields["model"] == "flight",
        }
        checked = {"response": _response, "traces": _traces, "correlations": _correlations}
        checked |= {name: partial(_predictions, place=name) for name in ("predictions", "trajectories")}
        fields |= {name: check(fields[name]) for name, check in checked.items() if fields[name] is not None}
        found = Identification(**fields)
        if problem := next(_problems(found, tests), None):
            raise InputError(f"{problem}; {_AGAIN}")
    return found


def vehicle_result(found: Identification | str | os.PathLike[str]) -> Identification:
    """The result of a vehicle, given or read, with an estimate. Raises `InputError`, one line; as `read_result`."""
    given = isinstance(found, Identification)
    own = found if given else read_result(found)
    with named("" if given else found):
        if not own.is_vehicle:
            which = "only a vehicle (--model flight) can be exported or can predict"
            raise InputError(f"`model` {shortened(own.model, 40)}: {which}.")
        if not own.covariance:
            raise InputError(f"{own.result}: {_EMPTY}")
    return own


def _problems(found: Identification, tests: dict[str, Any]) -> Iterator[str]:
    """The faults of a table that no result has, in words."""
    if found.result not in NAMES:
        yield f"`result` {shortened(found.result, 40)}: is not a result code"
    texts = (found.estimator, *found.parameters, *found.held, *found.verdicts, *found.rigid_body.constants, *tests)
    if strange := [each for each in texts if not _NAME.fullmatch(each)] or list(tests):
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
    if not all(each > 0 for each in (found.provenance.sample_time, *(x.sample_time for x in found.sample_times))):
        yield "`sample_time`: is not positive"
    if missing := [name for name in _ALWAYS[found.is_vehicle] if getattr(found.provenance, name) is msgspec.UNSET]:
        yield f"`provenance`: has no {missing[0]}"
    for name, each in found.disturbances.items():
        if each.time_constant <= 0 or min(each.strength, each.sensor) < 0:
            yield f"`disturbances.{name}`: a time constant is not positive, or a standard deviation is negative"
        if each.smoothing is not None and (name in "pqr" or not 0 < each.smoothing < each.time_constant):
            yield f"`disturbances.{name}`: `smoothing` is of a rate, or not between 0 and `time_constant`"
    constants = [found.rigid_body.constants, *(each.constants for each in found.sample_times)]
    deviations = [row.std for table in constants for row in table.values()]
    if any(std is not None and std < 0 for std in (*deviations, *(row.std for row in found.parameters.values()))):
        yield "`std`: is negative"
    fits = [*found.fit.values(), *(() if found.validation is None else (found.validation.fit or {}).values())]
    if any(each.level < 0 for each in fits):
        yield "`level`: is negative"
    if (traces := found.traces) is not None:
        if found.predictions is not None and found.predictions.start.size != traces.start_time.size:
            yield "`traces`: has not one time for each start of the predictions"
        if max(traces.log.max(), traces.start_log.max(initial=0)) > len(found.logs):  # one more: that of `validate`
            yield "`traces`: is of a log that has no name"
    if (paths := found.trajectories) is not None:
        ahead = found.predictions
        if ahead is None or not np.isin(paths.start, ahead.start).all():
            yield "`trajectories`: has starts that are not among those of the predictions"
        elif (np.diff(paths.horizons) <= 0).any() or paths.horizons[-1] > 1.001 * ahead.horizons.max():
            yield "`trajectories`: horizons must increase, up to those of the predictions"
    if (skill := found.skill) is not None:
        table = [each for rate in (skill.p, skill.q, skill.r) for each in msgspec.structs.astuple(rate)]
        if any(len(column) != len(skill.horizons) for column in table):
            yield "`skill`: does not have one value for each horizon"


def _arrays(kind: type, table: dict[str, Any], place: str) -> dict[str, Any]:
    """The arrays of a named tuple by name, checked against the shapes in its annotations; a missing number is NaN."""
    arrays, sizes = {}, {"3": 3, "4": 4}
    for name, hint in get_type_hints(kind).items():
        try:
            array = np.array(table[name], dtype=float)
        except (KeyError, TypeError, ValueError):
            raise InputError(f"`{place}.{name}`: is not an array of numbers; {_AGAIN}") from None
        names = getattr(hint, "dim_str", "").split()
        if array.shape == (0,) and len(names) == 2:
            array = np.zeros((0, sizes.get(names[1], 0)))  # a list of no rows does not say how long they are
        if array.ndim != len(names) or any(
            sizes.setdefault(each, size) != size for each, size in zip(names, array.shape, strict=True)
        ):
            raise InputError(f"`{place}.{name}`: has another shape than the arrays beside it; {_AGAIN}")
        arrays[name] = array if names else float(array)
    return arrays


def _traces(table: dict[str, Any]) -> Traces:
    arrays = _arrays(Traces, table, "traces")
    channels, simulated = arrays["measured"].shape[1], arrays["predicted"].shape[1]
    spatial = {arrays[name].shape[1] for name in ("position", "disturbance")}
    if not np.isfinite(np.concatenate([arrays["time"], arrays["start_time"]])).all() or arrays["time"].size < 2:
        raise InputError(f"`traces`: a time is missing; {_AGAIN}")
    if channels not in CHANNELS.values() or simulated not in (0, channels) or spatial - {0, 3}:
        raise InputError(f"`traces`: has channels that no model has; {_AGAIN}")
    for name in ("log", "start_log"):
        log = arrays[name] = np.nan_to_num(arrays[name], nan=-1.0).astype(int)
        if (log < 0).any():
            raise InputError(f"`traces.{name}`: is not the number of a log; {_AGAIN}")
    return Traces(**arrays)


def _correlations(table: dict[str, Any]) -> Correlations:
    arrays = _arrays(Correlations, table, "correlations")
    if arrays["own"].shape[0] not in CHANNELS.values() or arrays["with_torque"].shape[2] % 2 == 0:
        raise InputError(f"`correlations`: has channels that no model has; {_AGAIN}")
    return Correlations(**arrays)


def _predictions(table: dict[str, Any], place: str) -> Predictions:
    arrays = _arrays(Predictions, table, place)
    start, horizons = arrays["start"], arrays["horizons"]
    usable = start.size and (start >= 0).all() and (start < 1 << 40).all() and (np.diff(start) >= 1).all()
    if not (usable and horizons.size and (horizons > 0).all() and (start % 1 == 0).all()):
        raise InputError(f"`{place}`: starts must increase, and horizons be positive; {_AGAIN}")
    return Predictions(**arrays | {"start": start.astype(int)})


def _response(table: dict[str, dict[str, Any]]) -> FrequencyResponse:
    axes = {}
    for name in FrequencyResponse._fields:
        arrays = axes[name] = _arrays(AxisResponse, table.get(name, {}), f"response.{name}")
        frequency = arrays["frequency"]
        unusable = (arrays["gain"] <= 0) | (np.diagonal(arrays["covariance"]) < 0)
        if not (frequency > 0).all() or not (np.diff(frequency) > 0).all() or unusable.any():
            raise InputError(f"`response.{name}`: frequencies must increase, gains and errors be positive; {_AGAIN}")
    if any(not np.array_equal(each["frequency"], axes["roll"]["frequency"]) for each in axes.values()):
        raise InputError(f"`response`: its axes must have the same frequencies; {_AGAIN}")
    return FrequencyResponse(**{name: AxisResponse(**arrays) for name, arrays in axes.items()})
