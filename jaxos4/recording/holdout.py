"""The part of a flight that is not fitted, so that it can be predicted."""

import equinox as eqx
import numpy as np

from .._custom_types import as_float
from ..flight import Flight

# Length of a block that is held out [s]: each part of a flight then has blocks of both kinds.
_BLOCK = 5.0


def hold_out(flight: Flight, length: int, share: float) -> tuple[Flight, Flight | None]:
    """Split a flight into measurements to fit and measurements to predict, in alternating blocks of whole windows.

    **Arguments:**

    - `flight`: whole windows, see `jaxos4.join`.
    - `length`: of a window, in samples.
    - `share`: of the windows to hold out, 0 to 0.5.

    **Returns:** two flights of the same samples: in each, the measurements of the other are missing (NaN). The second
    keeps the specific force everywhere, because a model may use it as an input. `None`: nothing is held out.
    """
    if not share:
        return flight, None
    windows = flight.time.shape[0] // length
    period = round(1 / share)
    block = max(min(round(_BLOCK / (length * float(flight.dt))), windows // (2 * period)), 1)
    held_out = np.repeat((np.arange(windows) // block) % period == period - 1, length)
    if not held_out.any() or held_out.all():
        return flight, None
    return _without(held_out, flight, force=True), _without(~held_out, flight, force=False)


def _without(rows: np.ndarray, flight: Flight, *, force: bool) -> Flight:
    blank = eqx.tree_at(lambda f: f.states, flight, as_float(np.where(rows[:, None], np.nan, flight.states)))
    if not force or flight.specific_force is None:
        return blank
    blank_force = as_float(np.where(rows[:, None], np.nan, flight.specific_force))
    return eqx.tree_at(lambda f: f.specific_force, blank, blank_force)
