"""What a study's Dataset says of its estimators: errors, efficiency, coverage, results, and what can be known at all.

Pure functions from a Dataset (or a selection of it) to labelled arrays. What is missing is NaN and is left out of
means; a mean over nothing is NaN. Only the flights that an estimator *told* count in errors: those of result
`successful`, and `unidentifiable`, whose numbers are real although the bracket knew as much.
"""

import math
from statistics import NormalDist

import numpy as np
import xarray as xr

SCENARIO = (
    "model",
    "airframe",
    "excitation",
    "duration",
    "method",
    "noise",
    "scale",
    "width",
    "channels",
    "estimator",
)
"""The dimensions that tell one cell of a study from another."""

TOLD = ("successful", "unidentifiable")
"""The results whose numbers count in errors."""

WITHOUT_RUN = ("failed", "not_run")
"""The results of flights that were not identified at all."""

NOISE_FLOOR = 1.96
"""A parameter smaller than this many standard deviations of the best possible estimate cannot be told from 0."""

NO_PERCENTAGE = ("", "the truth is 0", "below the noise floor")
"""Why a percentage means nothing, by the codes of `no_percentage`."""

# Of intervals for Monte-Carlo errors.
_CONFIDENCE = 0.95


def codes(dataset: xr.Dataset) -> dict[str, int]:
    """The codes of the results by name."""
    attributes = dataset["result"].attrs
    values = np.atleast_1d(attributes["flag_values"])
    return {name: int(value) for name, value in zip(attributes["flag_meanings"].split(), values, strict=True)}


def told(dataset: xr.Dataset) -> xr.DataArray:
    """Which flights count in errors."""
    return _one_of(dataset, TOLD)


def was_run(dataset: xr.Dataset) -> xr.DataArray:
    """Which flights were identified, with whatever result."""
    return ~_one_of(dataset, WITHOUT_RUN)


def result_counts(dataset: xr.Dataset) -> xr.DataArray:
    """How many flights ended with each result, along `code`."""
    known = codes(dataset)
    counts = [(dataset["result"] == value).sum("flight") for value in known.values()]
    return xr.concat(counts, dim=xr.DataArray(list(known), dims="code", name="code"))


def error(dataset: xr.Dataset) -> xr.DataArray:
    """Estimate - truth of each flight that was told, in the parameter's unit."""
    return (dataset["estimate"] - dataset["truth"]).where(told(dataset))


def no_percentage(dataset: xr.Dataset) -> xr.DataArray:
    """Where percentages mean nothing and why: an index into `NO_PERCENTAGE`, one for all flights of a cell.

    1 where the truth of any flight is 0, else 2 where that of any is below `NOISE_FLOOR` times its bound: relative to a
    number that no estimator can tell from 0, an error is as large as one likes.
    """
    return _no_percentage(dataset["truth"], dataset["bound"])


def percentage_error(dataset: xr.Dataset) -> xr.DataArray:
    """100 (estimate - truth) / |truth| of each flight, with its sign; NaN where `no_percentage` says so."""
    return _percent(error(dataset), dataset["truth"], no_percentage(dataset))


def estimator_error(dataset: xr.Dataset) -> xr.Dataset:
    """Root mean square over the flights told: `percent` of each flight's own truth, and `absolute`."""
    return _both(error(dataset), dataset["truth"], no_percentage(dataset))


def bound_error(dataset: xr.Dataset) -> xr.Dataset:
    """The Cramer-Rao bound as `estimator_error` has errors: root mean square over all flights."""
    return _both(dataset["bound"], dataset["truth"], no_percentage(dataset))


def center_error(dataset: xr.Dataset) -> xr.Dataset:
    """What the bracket's centre alone would give: the error that an estimator has before it sees a flight.

    `reason` is that of the estimator that sees most.
    """
    truth = dataset["truth"]
    reason = _no_percentage(truth, dataset["bound"].min("estimator"))
    return _both(dataset["center"] - truth, truth, reason)


def normalised_error(dataset: xr.Dataset) -> xr.DataArray:
    """Error of each flight in standard deviations of the best possible estimate; NaN where the bound is 0."""
    return error(dataset) / dataset["bound"].where(dataset["bound"] > 0)


def efficiency(dataset: xr.Dataset) -> xr.Dataset:
    """RMSE / bound over the flights told, each against its own bound, with a 95 % Monte-Carlo interval.

    1 is the best that an unbiased estimator can do. `low` and `high` are those of a Gaussian's standard deviation from
    `count` draws (chi-squared, quantiles by Wilson and Hilferty 1931); NaN below two flights.
    """
    ratio = normalised_error(dataset)
    count = ratio.notnull().sum("flight")
    value = _rms(ratio)
    some = count.where(count > 1)
    high, low = (value * np.sqrt(some / _chi_squared(some, tail)) for tail in _tails())
    return xr.Dataset({"efficiency": value, "low": low, "high": high, "count": count})


def coverage(dataset: xr.Dataset) -> xr.Dataset:
    """The share of flights told whose interval holds the truth, at each level, with a 95 % Wilson interval."""
    distance, half_width = abs(error(dataset)), dataset["half_width"]
    there = distance.notnull() & half_width.notnull()
    return _share((distance <= half_width) & there, there).rename({"share": "coverage"})


def mean_coverage(dataset: xr.Dataset) -> xr.Dataset:
    """`coverage` averaged over the parameters; its interval is that of as many draws as there are flights.

    The parameters of one flight err together, so that this interval is on the safe side.
    """
    each = coverage(dataset)
    share, count = each["coverage"].mean("parameter"), each["count"].min("parameter")
    low, high = _wilson(share, count.where(count > 0))
    return xr.Dataset({"coverage": share, "low": low, "high": high, "count": count})


def hit_rate(dataset: xr.Dataset) -> xr.Dataset:
    """The share of flights whose seed bracket held the truth, with a 95 % Wilson interval; NaN where there is none."""
    hit = dataset["hit"]
    return _share(hit == 1, (hit >= 0) & was_run(dataset)).rename({"share": "hit_rate"})


def mean_rollouts(dataset: xr.Dataset) -> xr.DataArray:
    """Simulated flights spent on one identification, on average over those that were run."""
    return dataset["rollouts"].where(was_run(dataset)).mean("flight")


def accuracy(dataset: xr.Dataset) -> xr.DataArray:
    """One number for all parameters: the geometric mean of RMSE / the least bound of any estimator.

    Other than `efficiency` this does not forgive an estimator that looks at few channels.
    """
    least = dataset["bound"].min("estimator")
    ratio = _rms(error(dataset) / least.where(least > 0))
    logarithm = xr.apply_ufunc(np.log, ratio.where(ratio > 0))
    return xr.apply_ufunc(np.exp, logarithm.mean("parameter", skipna=False))


def frontier(dataset: xr.Dataset) -> xr.DataArray:
    """The noise scale below which a parameter can be told from 0: where |truth| is `NOISE_FLOOR` bounds.

    The bound grows in proportion to the scale, so that each flight tells of it; this is their median. 0: never.
    """
    bound = dataset["bound"].where(dataset["bound"] > 0)
    return (dataset["scale"] * abs(dataset["truth"]) / (NOISE_FLOOR * bound)).median(("scale", "flight"))


def _one_of(dataset: xr.Dataset, names: tuple[str, ...]) -> xr.DataArray:
    known = codes(dataset)
    return dataset["result"].isin([known[name] for name in names if name in known])


def _no_percentage(truth: xr.DataArray, bound: xr.DataArray) -> xr.DataArray:
    zero = (truth == 0).any("flight")
    below = (abs(truth) < NOISE_FLOOR * bound).any("flight")
    return xr.where(zero, 1, xr.where(below, 2, 0))


def _percent(values: xr.DataArray, truth: xr.DataArray, reason: xr.DataArray) -> xr.DataArray:
    return (100 * values / abs(truth.where(truth != 0))).where(reason == 0)


def _both(values: xr.DataArray, truth: xr.DataArray, reason: xr.DataArray) -> xr.Dataset:
    percent = _rms(_percent(values, truth, reason))
    return xr.Dataset({"percent": percent, "absolute": _rms(values), "reason": reason})


def _rms(values: xr.DataArray) -> xr.DataArray:
    return (values**2).mean("flight") ** 0.5


def _share(yes: xr.DataArray, there: xr.DataArray) -> xr.Dataset:
    count = there.sum("flight")
    some = count.where(count > 0)
    share = (yes & there).sum("flight") / some
    low, high = _wilson(share, some)
    return xr.Dataset({"share": share, "low": low, "high": high, "count": count})


def _tails() -> tuple[float, float]:
    """Standard deviations at the two ends of a Gaussian's 95 % interval."""
    end = NormalDist().inv_cdf((1 + _CONFIDENCE) / 2)
    return -end, end


def _wilson(share: xr.DataArray, count: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """Wilson's interval of a probability from a share of `count` draws."""
    z2 = _tails()[1] ** 2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = math.sqrt(z2) * np.sqrt(share * (1 - share) / count + z2 / (4 * count**2)) / (1 + z2 / count)
    return (middle - half).clip(0, 1), (middle + half).clip(0, 1)


def _chi_squared(freedom: xr.DataArray, deviations: float) -> xr.DataArray:
    """The quantile of chi-squared that lies where a Gaussian's lies `deviations` from its mean."""
    part = 2 / (9 * freedom)
    return freedom * (1 - part + deviations * np.sqrt(part)) ** 3
