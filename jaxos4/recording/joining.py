"""Several stretches of flight as one flight."""

from collections.abc import Sequence

import jax
import numpy as np

from ..flight import STATE_NAMES, Flight

# Sample times that differ by less than this share are equal.
_EQUAL_STEPS = 1e-6


def join(flights: Sequence[Flight], *, length: int) -> Flight:
    """Put stretches of flight one after the other, as one flight of whole windows.

    Samples at the end of a stretch that do not fill a window are dropped, as are stretches shorter than one window.
    Time becomes a count of samples from 0. Measurements do not change.

    **Arguments:**

    - `flights`: the stretches.
    - `length`: of a window, in samples.

    **Raises:** `ValueError` if the sample times differ, or if no stretch is as long as one window.
    """
    steps = np.array([float(flight.dt) for flight in flights])
    if steps.size and np.ptp(steps) > _EQUAL_STEPS * steps[0]:
        raise ValueError(f"`flights` must have one sample time, got {', '.join(f'{dt:.6g}' for dt in steps)} s.")
    counts = [flight.time.shape[0] // length * length for flight in flights]
    if not any(counts):
        raise ValueError(f"`flights` must hold at least `length` = {length} samples without a break.")
    kept = [(flight, n) for flight, n in zip(flights, counts, strict=True) if n]
    omega, states, channels = (_rows(kept, name) for name in ("omega", "states", "recorded"))
    force = channels[:, len(STATE_NAMES) :]
    velocity, voltage = (
        None if any(getattr(flight, name) is None for flight, _ in kept) else _rows(kept, name)
        for name in ("body_velocity", "voltage")
    )
    lengths = [n for n in counts if n]
    return Flight(
        time=steps[0] * np.arange(sum(counts)),
        omega=omega,
        states=states,
        specific_force=None if np.isnan(force).all() else force,
        body_velocity=velocity,
        stretch=jax.device_put(np.repeat(np.arange(len(lengths)), lengths)),
        commanded=any(flight.commanded for flight in flights),
        voltage=voltage,
    )


def _rows(kept: list[tuple[Flight, int]], name: str) -> np.ndarray:
    return np.concatenate([np.asarray(getattr(flight, name))[:n] for flight, n in kept])
