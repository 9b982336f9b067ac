"""The answer of a controller within a sample.

If a sample lasts longer than the controller takes to answer, its torque holds answers to the noise of what is measured
in it, and a likelihood that takes this torque for an input is biased. All of the torque is known before the sample, but
for its *input innovation* v. With white noise in the log's rows, v depends on what is measured through the filter's
innovation e alone. So e - gamma v is compared, with an unknown *feedthrough* gamma (`docs/method/filter_error.md`).
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

FEEDTHROUGHS = 2
"""The number of input innovations of a body rate."""
_ROUNDING = 1e-6


def input_innovations(
    torque: Float[np.ndarray, "samples parts 3"],
    rates: Float[np.ndarray, "samples 3"],
    stretch: Int[np.ndarray, " samples"],
    dt: float,
    *,
    memory: float = 0.1,
) -> Float[np.ndarray, "samples feedthroughs 3"]:
    """The part of the torque within each sample that the past does not tell, about each axis, of mean square 1.

    A linear regression on earlier samples of torque and rate about the same axis leaves `FEEDTHROUGHS` combinations of
    the parts of a sample, in which most of the rest lies. 0 at the beginning of a stretch.

    - `torque`: in equal parts of each sample, in any unit. `rates`: measured [rad/s]; NaN counts as 0.
    - `stretch`: the number of the uninterrupted stretch of each sample.
    - `dt`: sample time [s]. `memory`: how far back the past reaches [s], at least three samples.
    """
    lags = max(round(memory / dt), 3)
    rows = np.arange(lags, len(torque))
    rows = rows[stretch[rows] == stretch[rows - lags]]
    found = np.zeros((len(torque), FEEDTHROUGHS, 3))
    for axis in range(3):
        past = np.concatenate(list(_past(torque[:, :, axis], np.nan_to_num(rates[:, axis]), rows, lags)), axis=1)
        if len(past) <= past.shape[1]:
            break
        known = np.linalg.qr(past)[0]
        rest = torque[rows, :, axis] - known @ (known.T @ torque[rows, :, axis])
        directions, sizes, _ = np.linalg.svd(rest, full_matrices=False)
        directions = np.where(sizes > _ROUNDING * torque[:, :, axis].std(), directions, 0.0)
        found[rows, :, axis] = np.sqrt(len(rows)) * directions[:, :FEEDTHROUGHS]
    return found


def _past(
    torque: Float[np.ndarray, "samples parts"],
    rate: Float[np.ndarray, " samples"],
    rows: Int[np.ndarray, " rows"],
    lags: int,
) -> Iterator[Float[np.ndarray, "rows some"]]:
    scale = torque.std() or 1.0
    yield np.ones((len(rows), 1))
    for lag in range(1, lags + 1):
        yield torque[rows - lag] / scale
        yield rate[rows - lag, None]
