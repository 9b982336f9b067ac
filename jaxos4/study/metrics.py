"""Metrics of the estimators in a study's Dataset: errors, efficiency, coverage, results, and limits of the noise.

Pure functions from a Dataset, or a selection of it, to labelled arrays. Missing numbers are NaN and do not count.
Errors are those of *converged* flights, `successful` or `unidentifiable`: the latter have an estimate too.
"""

import math

import numpy as np
import scipy.special
import xarray as xr

from ..results import NINETY_FIVE
from .specification import Scenario

SCENARIO = Scenario._fields
"""The dimensions of a study's scenarios."""

CONVERGED = ("successful", "unidentifiable")
"""The results of flights whose estimates count in errors."""

NO_PERCENTAGE = ("", "the truth is 0", "below the noise floor")
"""Why a percentage has no meaning, by the codes of `no_percentage`."""


def codes(dataset: xr.Dataset) -> dict[str, int]:
    """The codes of the results by name."""
    attributes = dataset["result"].attrs
    values = np.atleast_1d(attributes["flag_values"])
    return {name: int(value) for name, value in zip(attributes["flag_meanings"].split(), values, strict=True)}


def converged(dataset: xr.Dataset) -> xr.DataArray:
    """Which flights count in errors."""
    return _one_of(dataset, CONVERGED)


def was_run(dataset: xr.Dataset) -> xr.DataArray:
    """Which flights an estimator was run on, with any result."""
    return ~_one_of(dataset, ("failed", "not_run"))


def result_counts(dataset: xr.Dataset) -> xr.DataArray:
    """The number of flights with each result, along `code`."""
    known = codes(dataset)
    counts = [(dataset["result"] == value).sum("flight") for value in known.values()]
    return xr.concat(counts, dim=xr.DataArray(list(known), dims="code", name="code"))


def error(dataset: xr.Dataset) -> xr.DataArray:
    """Estimate - truth of each converged flight, in the parameter's unit."""
    return (dataset["estimate"] - dataset["truth"]).where(converged(dataset))


def no_percentage(dataset: xr.Dataset, bound: xr.DataArray | None = None) -> xr.DataArray:
    """Why percentages of the truth have no meaning, for each scenario and parameter: an index into `NO_PERCENTAGE`.

    1: the truth of a flight is 0. 2: the truth of a flight is below `NINETY_FIVE` bounds, so that it cannot be
    distinguished from 0. 0: percentages have a meaning.
    """
    truth, bound = dataset["truth"], dataset["bound"] if bound is None else bound
    below = (abs(truth) < NINETY_FIVE * bound).any("flight")
    return xr.where((truth == 0).any("flight"), 1, xr.where(below, 2, 0))


def estimator_error(dataset: xr.Dataset) -> xr.Dataset:
    """Root mean square error of converged flights: in `percent` of each flight's truth, and `absolute`."""
    return _both(dataset, error(dataset))


def bound_error(dataset: xr.Dataset) -> xr.Dataset:
    """The Cramer-Rao bound in the form of `estimator_error`: root mean square over all flights."""
    return _both(dataset, dataset["bound"])


def center_error(dataset: xr.Dataset) -> xr.Dataset:
    """The error of the bracket's centre, in the form of `estimator_error`; `reason` is by the smallest bound."""
    return _both(dataset, dataset["center"] - dataset["truth"], dataset["bound"].min("estimator"))


def normalised_error(dataset: xr.Dataset) -> xr.DataArray:
    """Error / Cramer-Rao bound of each flight; NaN if the bound is 0."""
    return error(dataset) / dataset["bound"].where(dataset["bound"] > 0)


def efficiency(dataset: xr.Dataset) -> xr.Dataset:
    """RMSE / bound of converged flights, each relative to its own bound, with a 95 % Monte-Carlo interval.

    1 is the best value for an unbiased estimator. `low` and `high`: of a Gaussian's standard deviation from `count`
    draws (chi-squared); NaN for fewer than two.
    """
    ratio = normalised_error(dataset)
    count = ratio.notnull().sum("flight")
    value = _rms(ratio)
    some = count.where(count > 1)
    low, high = (value * np.sqrt(some / scipy.special.chdtri(some, above)) for above in (0.025, 0.975))
    return xr.Dataset({"efficiency": value, "low": low, "high": high, "count": count})


def coverage(dataset: xr.Dataset) -> xr.Dataset:
    """The share of converged flights whose interval holds the truth, at each level, with a 95 % Wilson interval."""
    distance, half_width = abs(error(dataset)), dataset["half_width"]
    measured = distance.notnull() & half_width.notnull()
    return _share("coverage", (distance <= half_width) & measured, measured)


def mean_coverage(dataset: xr.Dataset) -> xr.Dataset:
    """`coverage` averaged over the parameters, with the interval of one draw for each flight: a conservative one."""
    each = coverage(dataset)
    return _wilson("coverage", each["coverage"].mean("parameter"), each["count"].min("parameter"))


def hit_rate(dataset: xr.Dataset) -> xr.Dataset:
    """The share of flights whose seed bracket contained the truth, with a 95 % Wilson interval; NaN without seeds."""
    hit = dataset["hit"]
    return _share("hit_rate", hit == 1, (hit >= 0) & was_run(dataset))


def mean_rollouts(dataset: xr.Dataset) -> xr.DataArray:
    """The mean number of simulated flights that one identification took."""
    return dataset["rollouts"].where(was_run(dataset)).mean("flight")


def accuracy(dataset: xr.Dataset) -> xr.DataArray:
    """One number for all parameters: the geometric mean of RMSE / the smallest bound of any estimator."""
    least = dataset["bound"].min("estimator")
    ratio = _rms(error(dataset) / least.where(least > 0))
    logarithm = xr.apply_ufunc(np.log, ratio.where(ratio > 0))
    return xr.apply_ufunc(np.exp, logarithm.mean("parameter", skipna=False))


def accuracy_interval(dataset: xr.Dataset) -> xr.Dataset:
    """`accuracy` by scale and estimator, with the conservative Monte-Carlo interval of one parameter."""
    found, value = efficiency(dataset), accuracy(dataset)
    low, high = (value * (found[end] / found["efficiency"]).mean("parameter").fillna(1) for end in ("low", "high"))
    return xr.Dataset({"accuracy": value, "low": low, "high": high}).transpose("scale", "estimator")


def _one_of(dataset: xr.Dataset, names: tuple[str, ...]) -> xr.DataArray:
    known = codes(dataset)
    return dataset["result"].isin([known[name] for name in names if name in known])


def _both(dataset: xr.Dataset, values: xr.DataArray, bound: xr.DataArray | None = None) -> xr.Dataset:
    truth, reason = dataset["truth"], no_percentage(dataset, bound)
    percent = (100 * values / abs(truth.where(truth != 0))).where(reason == 0)
    return xr.Dataset({"percent": _rms(percent), "absolute": _rms(values), "reason": reason})


def _rms(values: xr.DataArray) -> xr.DataArray:
    return (values**2).mean("flight") ** 0.5


def _share(name: str, yes: xr.DataArray, counted: xr.DataArray) -> xr.Dataset:
    count = counted.sum("flight")
    return _wilson(name, (yes & counted).sum("flight") / count.where(count > 0), count)


def _wilson(name: str, share: xr.DataArray, count: xr.DataArray) -> xr.Dataset:
    """A share of `count` draws, with Wilson's 95 % interval of the probability."""
    z2, some = NINETY_FIVE**2, count.where(count > 0)
    middle = (share + z2 / (2 * some)) / (1 + z2 / some)
    half = math.sqrt(z2) * np.sqrt(share * (1 - share) / some + z2 / (4 * some**2)) / (1 + z2 / some)
    low, high = (middle - half).clip(0, 1), (middle + half).clip(0, 1)
    return xr.Dataset({name: share, "low": low, "high": high, "count": count})
