"""The door of result files: all that a file of `jaxos4 estimate --out` holds is checked here, once."""

import os
import re

import msgspec
import numpy as np

from ._files import read_json
from .errors import InputError, named, shortened
from .identification.results import (
    ChannelFit,
    Constant,
    Identification,
    PredictionSkill,
    ResultFile,
    SampleTime,
    Validation,
)

_NAME = re.compile(r"[\w.() -]{1,80}")
_REMEDY = "give a file of this version's `jaxos4 estimate --out`"
_LARGEST = 1e30  # far beyond every quantity in SI units, and its square is a number
_ROUNDING = 1e-6  # of a correlation


class _Others(msgspec.Struct, frozen=True):
    """The fields that no command reads yet: a file in which they are of another kind is no result either."""

    rollouts: int = 0
    cost: float | None = None
    seconds: float = 0.0
    constants: dict[str, Constant | float | bool] = {}
    fit: dict[str, ChannelFit] = {}
    validation: Validation | None = None
    noise: dict[str, float] = {}
    widened: dict[str, float] = {}
    sample_times: tuple[SampleTime, ...] = ()
    skill: PredictionSkill | None = None


def result_file(found: Identification | str | os.PathLike[str]) -> ResultFile:
    """The result of a vehicle, or the one in a file, as `ResultFile.of` reads it.

    **Raises:** `InputError`, one line, also for texts, numbers and correlations that no result has; `OSError` if the
    file cannot be read.
    """
    if isinstance(found, Identification):
        return ResultFile.of(found.to_dict())
    value = read_json(found, _REMEDY, _LARGEST)
    file = ResultFile.of(value, found)
    with named(found):
        try:
            msgspec.convert(value, _Others)
        except msgspec.ValidationError as error:
            raise InputError(f"not a result ({shortened(str(error), 200)}); {_REMEDY}.") from None
        if strange := [each for each in (file.estimator, *file.parameters, *file.held) if not _NAME.fullmatch(each)]:
            raise InputError(f"{shortened(strange[0], 40)!r} is no name of an estimator or a parameter; {_REMEDY}.")
        covariance = np.array(file.covariance)
        std = np.sqrt(np.diag(covariance))
        if (np.abs(covariance) > (1 + _ROUNDING) * np.outer(std, std)).any():
            raise InputError("`covariance`: a correlation exceeds 1; run `jaxos4 estimate` again.")
        if not file.provenance.sample_time > 0:
            raise InputError("`sample_time`: is not positive; run `jaxos4 estimate` again.")
    return file
