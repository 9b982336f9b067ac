"""Input innovations: the part of torque and thrust that the past does not predict.

The past predicts the torque of a sample except for its *input innovation* v, which matters to the filter in three ways:

- If a sample lasts longer than the controller takes to answer, v holds answers to the noise of measurements in it. With
  white noise in the log's rows, v depends on the measurements only through the filter's innovation e. So e - gamma v is
  compared, with an unknown *feedthrough* gamma.
- A controller that runs faster than the log measures rates that the log lacks. Its answers contain information about
  rates and disturbances, so the filter's estimates are corrected by unknown gains times v. Without these gains, the
  error of the filter correlates with the torque that follows, and all parameters are biased.
- Motors follow a command of the log until its next row, but the commands of such a controller change sooner. The torque
  is wrong by a share of v for as long as the motors take to follow, so the v of a few samples count (`lagged`).

See `docs/method/filter_error.md`.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..flight import filled

COUNTS = (2, 2, 1, 1)
"""The numbers of input innovations of roll, pitch, yaw and thrust. A second one of yaw would hide the reaction of the
rotors."""
FEEDTHROUGHS = max(COUNTS)
LAGGED_COUNTS = (3, 3, 3, 1)
"""The same if motors follow commands in short samples: the innovations of the sample and of samples before it. With
fewer, rotor_lag and rotor_delay have several minima; with more, the response of the motors is lost."""
MEANS = 0.1, 0.3, 1.0
"""Time constants [s] of the means in which a controller's integral of attitude shows."""
# A smaller share of a signal may be due to rounding.
_ROUNDING = 1e-6
# A slow signal is left out if it is missing in this share of the rows. Not 0: before a held-out part, a slower sensor
# ends some rows before the gyro.
_LOST = 0.01
# Rows of one matrix product. More would not fit the cache, and BLAS would divide so small a product among threads.
_BLOCK = 2048


def input_innovations(
    inputs: Float[np.ndarray, "samples parts"],
    measured: Float[np.ndarray, " samples"],
    stretch: Int[np.ndarray, " samples"],
    dt: float,
    count: int,
    *,
    speeds: Sequence[Float[np.ndarray, " samples"]] = (),
    memory: float = 0.1,
    means: Sequence[float] = (),
    slow: Sequence[Float[np.ndarray, " samples"]] = (),
    measured_first: bool = False,
) -> Float[np.ndarray, "samples count"]:
    """The part of the torque or thrust within each sample that the past does not predict, with mean square 1.

    The prediction is a linear regression on earlier samples of the input, of `measured` and of `speeds`, on the `slow`
    signals, and on exponential means of input and `measured` if these explain more than chance does by Schwarz's
    criterion. The result is the `count` combinations of the parts of a sample with most of the residual, with arbitrary
    signs. It is 0 in the first `memory` of a stretch, and where measurements in the memory are missing for as long as
    the memory, as held-out ones are: values in their place would distort the regression.

    - `inputs`: torque or thrust in equal parts of each sample, in any unit.
    - `measured`: the rate or specific force; NaN: missing. Shorter gaps than the memory are interpolated.
    - `stretch`: the number of the uninterrupted stretch of each sample.
    - `dt`: sample time [s]. `memory`: how far back single samples count [s]; at least three samples.
    - `speeds`: further inputs, such as the rotor speeds if the input is their squares.
    - `means`: time constants of the means [s]. In longer gaps, the mean of all measurements takes the place of a
      missing one.
    - `slow`: other signals to which a controller or a pilot responds, such as attitude and velocity; NaN: missing.
      Only the last value before a sample counts. A signal with gaps that are longer than the memory is left out.
    - `measured_first`: whether no torque before a sample's measurements can answer them. `measured` and `slow` of the
      sample itself then count as past, although half of its torque is earlier.

    Reference: Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978).
    """
    lags, (samples, parts) = max(round(memory / dt), 3), inputs.shape
    rows = np.arange(lags, samples)
    if measured_first:
        measured, *slow = (np.append(each[1:], each[-1]) for each in (measured, *slow))
    measured, missing = _without_gaps(measured, lags)
    earlier = np.append(0, np.cumsum(missing))  # how many were missing before each sample
    rows = rows[(stretch[rows] == stretch[rows - lags]) & (earlier[rows] == earlier[rows - lags])]
    series = np.column_stack([_standard(inputs), _standard(measured), *map(_standard, speeds), np.ones(samples)])
    # Gaps are not interpolated, because that would tell what comes later.
    known = [_standard(filled(x)) for x in slow if _without_gaps(x, lags)[1][rows - 1].mean() < _LOST]
    spare = len(rows) - 1 - lags * (series.shape[1] - 1) - len(known)  # degrees of freedom
    if spare <= 0:
        return np.zeros((samples, count))
    last = np.column_stack([np.zeros((samples, 0)), *known])
    rest = _unexplained(series, parts, rows, lags, last)
    if spare > 2 * len(means) > 0:
        last = np.column_stack([last, _exponential_means(series, parts, stretch, dt, means)])
        with_means = _unexplained(series, parts, rows, lags, last)
        power, power_with_means = (np.square(each.mean(axis=1)).mean() for each in (rest, with_means))
        if power_with_means < power * spare ** (-2 * len(means) / spare):
            rest = with_means
        del with_means
    _, sizes, directions = np.linalg.svd(np.linalg.qr(rest, mode="r"))
    is_signal = sizes > _ROUNDING * np.sqrt(len(rows))
    scaled = np.where(is_signal, directions.T, 0.0) / np.where(is_signal, sizes, 1.0)
    found = np.zeros((samples, count))
    found[rows] = np.sqrt(len(rows)) * rest @ scaled[:, :count]
    return found


def lagged(
    innovation: Float[np.ndarray, " samples"], stretch: Int[np.ndarray, " samples"], count: int
) -> Float[np.ndarray, "samples count"]:
    """The innovations of each sample and of the `count` - 1 samples before; 0 before the beginning of a stretch."""
    found = np.zeros((len(innovation), count))
    for lag in range(count):
        rows = np.arange(lag, len(innovation))
        found[rows, lag] = np.where(stretch[rows] == stretch[rows - lag], innovation[rows - lag], 0.0)
    return found


def _without_gaps(
    measured: Float[np.ndarray, " samples"], longest: int
) -> tuple[Float[np.ndarray, " samples"], Bool[np.ndarray, " samples"]]:
    """Interpolates gaps of less than `longest` samples. In longer ones, the second result, all values are the mean."""
    known = np.isfinite(measured)
    if known.all():
        return measured, ~known
    if not known.any():
        return np.zeros(len(measured)), ~known
    place = np.arange(len(measured))
    before = np.maximum.accumulate(np.where(known, place, -1))
    after = np.minimum.accumulate(np.where(known, place, len(measured))[::-1])[::-1]
    missing = after - before > longest
    between = np.interp(place, place[known], measured[known])
    return np.where(missing, measured[known].mean(), between), missing


def _standard(columns: Float[np.ndarray, "samples *columns"]) -> Float[np.ndarray, "samples *columns"]:
    """The columns minus their means, over their common standard deviation."""
    about = columns - columns.mean(axis=0)
    return about / (about.std() or 1.0)


def _exponential_means(
    series: Float[np.ndarray, "samples series"],
    parts: int,
    stretch: Int[np.ndarray, " samples"],
    dt: float,
    times: Sequence[float],
) -> Float[np.ndarray, "samples means"]:
    """Exponential means, up to each sample, of input and measurement, with time constants [s]; 0 before a stretch.

    `series`: the input in `parts`, then the measurement, with mean 0.
    """
    from scipy.linalg import solve_banded  # slow to import

    found = np.empty((len(series), 2, len(times)))
    for place, kept in enumerate(np.exp(-dt / np.asarray(times))):
        for which, signal in enumerate((series[:, :parts].mean(axis=1), series[:, parts])):
            # The recursion m[k] - kept m[k - 1] = (1 - kept) x[k], as a system of equations.
            bands = np.zeros((3, len(series)))
            bands[1], bands[2, :-1] = 1.0, np.where(stretch[1:] == stretch[:-1], -kept, 0.0)
            found[:, which, place] = solve_banded((1, 1), bands, (1 - kept) * signal, overwrite_ab=True)
    return found.reshape(len(series), -1)


def _unexplained(
    series: Float[np.ndarray, "samples series"],
    targets: int,
    rows: Int[np.ndarray, " rows"],
    lags: int,
    others: Float[np.ndarray, "samples others"],
) -> Float[np.ndarray, "rows targets"]:
    """The residual of the first `targets` series at these rows, after a regression on what came before.

    Regressors are `lags` samples of all series, and the `others` of the sample before. It uses normal equations,
    because the matrix of the regression would not fit into memory. A ridge keeps them regular if series differ by
    rounding only. A second pass removes the errors of the first by ridge and rounding.
    """
    from scipy.linalg import cho_factor, cho_solve  # slow to import

    rest = series[rows, :targets]
    starts = np.flatnonzero(np.diff(rows, prepend=-1) > 1)
    firsts = np.concatenate([np.arange(*ends, _BLOCK) for ends in zip(starts, [*starts[1:], len(rows)], strict=True)])
    blocks, rows_of_blocks = (np.split(each, firsts[1:]) for each in (rest, rows))
    windows = [series[block[0] - lags : block[-1] + 1] for block in rows_of_blocks]
    pasts = [[window[lags - lag : -lag] for lag in range(1, lags + 1)] for window in windows]
    last = [others[block[0] - 1 : block[-1]] for block in rows_of_blocks]
    pasts = [[*past, own] for past, own in zip(pasts, last, strict=True)]
    sizes = [*[series.shape[1]] * lags, others.shape[1]]
    products = np.pad(_lagged_products(windows, lags), (0, others.shape[1]))
    products[:, sum(sizes[:-1]) :] = _products(pasts, last)
    products.flat[:: len(products) + 1] += _ROUNDING**2 * len(rows)
    factor = cho_factor(products)
    for _ in range(2):
        coefficients = np.split(cho_solve(factor, _products(pasts, blocks)), np.cumsum(sizes)[:-1])
        for past, block in zip(pasts, blocks, strict=True):
            block -= sum(map(np.matmul, past, coefficients))
    return rest


def _products(
    pasts: list[list[Float[np.ndarray, "_ _"]]], blocks: list[Float[np.ndarray, "_ columns"]]
) -> Float[np.ndarray, "regressors columns"]:
    """The products of all regressors with the columns, summed over the rows of all blocks."""
    every = [[part.T @ block for part in past] for past, block in zip(pasts, blocks, strict=True)]
    return np.concatenate([sum(own) for own in zip(*every, strict=True)])


def _lagged_products(windows: list[Float[np.ndarray, "_ series"]], lags: int) -> Float[np.ndarray, "columns columns"]:
    """The upper triangle of the normal equations: products of the samples 1 to `lags` before a row, summed over rows.

    A window holds `lags` samples and then its rows. If both factors are taken one sample earlier, the sum differs only
    at the edges of the windows.
    """
    width, most = windows[0].shape[1], lags - 1
    products, edges = np.zeros((lags, width, lags, width)), np.zeros((most, width, most, width))
    for window in windows:
        for lag in range(lags):
            products[0, :, lag] += window[most:-1].T @ window[most - lag : -1 - lag]
        first, last = window[:most][::-1], window[-lags:-1][::-1]
        edges += np.multiply.outer(first, first) - np.multiply.outer(last, last)
    for lag in range(most):
        products[lag + 1, :, 1:] = products[lag, :, :-1] + edges[lag]
    return products.reshape(lags * width, -1)
