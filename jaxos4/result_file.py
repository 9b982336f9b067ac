"""Reads and validates result files of `jaxos4 estimate`."""

import os
import re
from collections.abc import Iterator
from typing import Any, get_type_hints

import msgspec
import numpy as np

from ._custom_types import Arrays
from ._files import read_json
from .airframe import airframe_from_table
from .analysis.diagnostics import Correlations
from .analysis.frequency_response import AxisResponse, FrequencyResponse
from .analysis.prediction import Predictions
from .analysis.traces import Traces
from .errors import InputError, named, of_schema, shortened
from .identification.results import APART, Constant, Identification, RigidBody
from .models.state import CHANNELS
from .results import NAMES

_NAME = re.compile(r"[\w.() -]{1,80}")
_REMEDY, _AGAIN = "give a file of this version's `jaxos4 estimate --out`", "run `jaxos4 estimate` again."
_LARGEST = 1e30  # far beyond every quantity in SI units, and its square is a number
_ALWAYS = {True: ("terms", "fitted_seconds"), False: ("channels", "windows")}  # of a vehicle's provenance, and an OS4's
_EMPTY = "holds no estimate; see what `jaxos4 estimate` says about the flight."

_ARRAYS = {"traces": Traces, "correlations": Correlations, "predictions": Predictions, "trajectories": Predictions}
_FIELD: Any = msgspec.field  # its types do not know that a field can have neither default
# The fields of a file: those of an `Identification`, with what has another form there.
_File = msgspec.defstruct(
    "_File",
    [
        *(
            (field.name, field.type, _FIELD(default=field.default, default_factory=field.default_factory))
            for field in msgspec.structs.fields(Identification)
            if field.name not in {*APART, *_ARRAYS, "response"}
        ),
        ("constants", dict[str, Constant | float | bool]),
        ("airframe", dict[str, Any] | None),
        *((name, dict[str, Any] | None, None) for name in _ARRAYS),
        ("response", dict[str, dict[str, Any]] | None, None),
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
            fields = msgspec.structs.asdict(msgspec.convert(value, _File))
        except msgspec.ValidationError as error:
            raise InputError(f"not a result: {shortened(of_schema(error), 200)}; {_REMEDY}.") from None
        constants, tests = {}, {}
        for name, each in fields.pop("constants").items():
            (constants if isinstance(each, Constant) else tests)[name] = each
        if fields["airframe"] is None:
            raise InputError(f"{fields['result']}: {_EMPTY}")
        fields |= {
            "airframe": airframe_from_table(fields["airframe"]),
            "rigid_body": RigidBody(constants, tests.pop("consistency_p", None), tests.pop("rigid_body", None)),
        }
        fields |= {
            name: _arrays(kind, fields[name], name) for name, kind in _ARRAYS.items() if fields[name] is not None
        }
        if (axes := fields["response"]) is not None:
            names = FrequencyResponse._fields
            own = (_arrays(AxisResponse, axes.get(name, {}), f"response.{name}") for name in names)
            fields["response"] = FrequencyResponse(*own)
        found = Identification(**fields)
        if problem := next(_problems(found, tests), None):
            raise InputError(f"{problem}; {_AGAIN}")
    return found


def _arrays(kind: type[Arrays], table: dict[str, Any], place: str) -> Any:
    """Arrays from lists of numbers by name. A missing number is NaN; whole numbers may not be missing."""
    fields = {}
    for name, hint in get_type_hints(kind).items():
        try:
            array = np.array(table[name], dtype=float)
            fields[name] = array.item() if hint is float else array
            if "int64" in getattr(hint, "dtypes", ()):
                fields[name] = np.where(np.abs(array) < 1 << 40, array, -1).astype(int)
                if (fields[name] != array).any():
                    raise ValueError
        except (LookupError, TypeError, ValueError):
            raise InputError(f"`{place}.{name}`: is not an array of numbers; {_AGAIN}") from None
    with named(f"`{place}`"):
        return kind(**fields)


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
    if missing := [name for name in _ALWAYS[found.is_vehicle] if getattr(found.provenance, name) is msgspec.UNSET]:
        yield f"`provenance`: has no {missing[0]}"
    for name, each in found.disturbances.items():
        if each.smoothing is not None and (name in "pqr" or not 0 < each.smoothing < each.time_constant):
            yield f"`disturbances.{name}`: `smoothing` is of a rate, or not between 0 and `time_constant`"
    if (skill := found.skill) is not None:
        table = [each for rate in (skill.p, skill.q, skill.r) for each in msgspec.structs.astuple(rate)]
        if any(len(column) != len(skill.horizons) for column in table):
            yield "`skill`: does not have one value for each horizon"
    yield from _problems_of_signals(found)
    yield from _problems_of_response(found.response)


def _problems_of_signals(found: Identification) -> Iterator[str]:
    """The faults of traces, correlations and predictions."""
    ahead, traces, crossed = found.predictions, found.traces, found.correlations
    for name in ("predictions", "trajectories"):
        if (one := getattr(found, name)) is None:
            continue
        usable = one.start.size and one.horizons.size and one.start[0] >= 0
        if not (usable and (np.diff(one.start) > 0).all() and (one.horizons > 0).all()):
            yield f"`{name}`: starts must increase, and horizons be positive"
    if (paths := found.trajectories) is not None:
        if ahead is None or not np.isin(paths.start, ahead.start).all():
            yield "`trajectories`: has starts that are not among those of the predictions"
        elif (np.diff(paths.horizons) <= 0).any() or paths.horizons[-1] > 1.001 * ahead.horizons.max():
            yield "`trajectories`: horizons must increase, up to those of the predictions"
    if traces is not None:
        channels, simulated = traces.measured.shape[1], traces.predicted.shape[1]
        spatial = {traces.position.shape[1], traces.disturbance.shape[1]}
        if not np.isfinite(np.concatenate([traces.time, traces.start_time])).all() or traces.time.size < 2:
            yield "`traces`: a time is missing"
        if channels not in CHANNELS.values() or simulated not in (0, channels) or spatial - {0, 3}:
            yield "`traces`: has channels that no model has"
        if ahead is not None and ahead.start.size != traces.start_time.size:
            yield "`traces`: has not one time for each start of the predictions"
        logs = np.concatenate([traces.log, traces.start_log])
        if (logs < 0).any() or (logs > len(found.logs)).any():  # one more: that of `validate`
            yield "`traces`: is of a log that has no name"
    if crossed is not None and (len(crossed.own) not in CHANNELS.values() or crossed.with_torque.shape[2] % 2 == 0):
        yield "`correlations`: has channels that no model has"


def _problems_of_response(response: FrequencyResponse | None) -> Iterator[str]:
    """The faults of a frequency response."""
    if response is None:
        return
    if any(not np.array_equal(axis.frequency, response.roll.frequency) for axis in response):
        yield "`response`: its axes must have the same frequencies"
    for name, axis in response._asdict().items():
        frequency = axis.frequency
        if (frequency <= 0).any() or not (np.diff(frequency) > 0).all():
            yield f"`response.{name}`: frequencies must be positive and increase"
        if (axis.gain <= 0).any() or (np.diagonal(axis.covariance) < 0).any():
            yield f"`response.{name}`: gains must be positive, and variances not negative"
