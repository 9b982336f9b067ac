"""What the torque tells that the log does not: answers of a controller that knows more.

All of the torque is known before its sample, but for its *input innovation* v. Two things make v depend on what the
filter compares and estimates:

- If a sample lasts longer than the controller takes to answer, v holds answers to the noise of what is measured in it.
  With white noise in the log's rows, v depends on what is measured through the filter's innovation e alone. So
  e - gamma v is compared, with an unknown *feedthrough* gamma.
- A controller that runs faster than the log measures rates that the log lacks. Its answers tell of rates and
  disturbances, so that the estimates of the filter are corrected by unknown gains times v. Without these gains, the
  error of the filter correlates with the torque that follows, and all parameters are biased.

See `docs/method/filter_error.md`.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

FEEDTHROUGHS = 2
"""The largest number of input innovations of a body rate."""
_COUNTS = (2, 2, 1)  # about roll, pitch and yaw; a second one of yaw would hide the reaction of the rotors
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

    A linear regression on earlier samples of torque and rate about the same axis leaves combinations of the parts of a
    sample, in which most of the rest lies: two about roll and pitch, one about yaw (the second is 0). 0 at the
    beginning of a stretch.

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
        count = _COUNTS[axis]
        found[rows, :count, axis] = np.sqrt(len(rows)) * directions[:, :count]
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
