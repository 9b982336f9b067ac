"""Logs of one vehicle, made ready to be fitted: usable stretches, evened samples, whole windows, a part held out."""

import math
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..airframe import Airframe
from ..errors import InputError
from ..flight import Flight, join
from ..logs import read_log
from ..models.rotation import with_body_velocity
from ..models.state import CASCADE_ORDER
from ..recording import stretches
from ..recording.averaging import averaged
from ..recording.stretches import Stretch, cut

# [s] of a window, and of a sample where a log has more: no quadrotor turns faster than these tell.
WINDOW, SAMPLE = 0.25, 0.004
# The share that is held out, where no other flight is there to be predicted.
HOLDOUT = 0.25
# What is held out comes in blocks of this length [s], so that every part of a flight is in both.
BLOCK = 5.0
_MOST_PARTS = 3
# Sample times that differ by less may be taken as one.
_NEARLY = 1.01


class Recorded(NamedTuple):
    """Logs, ready to be fitted.

    - `fitted`, `tested`: one flight each, of all stretches; NaN where the other has its part. `None`: nothing held out.
    - `recordings`: the log that each stretch is from.
    - `length`: of a window, in samples.
    - `force_axes`: along which of x, y, z every log measured the specific force.
    - `seconds`: fitted, and tested.
    """

    fitted: Flight
    tested: Flight | None
    recordings: tuple[int, ...]
    length: int
    force_axes: tuple[bool, bool, bool]
    seconds: tuple[float, float]
    notes: tuple[str, ...]

    @property
    def windows(self) -> int:
        """How many windows there are: none reaches from one stretch into the next."""
        return self.fitted.time.shape[0] // self.length


class Part(NamedTuple):
    """What of the logs is used: from and to [s], window and sample [s], the share that is held out."""

    begin: float | None
    end: float | None
    window: float
    sample: float | None
    holdout: float


def load_logs(paths: list[Path], airframe: Airframe, part: Part) -> Recorded:
    """Several logs as one flight of stretches that can be used, cut into whole windows."""
    _check(part)
    for number, path in enumerate(paths):
        if any(path.exists() and other.exists() and path.samefile(other) for other in paths[:number]):
            raise InputError(f"{path}: given twice; a log counts once.")
    notes: list[str] = []
    parts: list[tuple[int, Flight]] = []
    for number, path in enumerate(paths):
        flight, said = read_log(path, airframe)
        notes += [f"{path}: {note}" for note in said]
        if np.isnan(np.asarray(flight.states)[:, CASCADE_ORDER[:3]]).all(axis=0).any():
            raise InputError(f"{path}: a flight model needs p, q and r; log the gyro.")
        pieces, note = _pieces(path, flight, airframe, part)
        notes += [] if note is None else [f"{path}: {note}"]
        parts += [(number, piece) for piece in pieces]
    if len({piece.commanded for _, piece in parts}) > 1:
        raise InputError(f"{paths[0]}: some of these logs hold commands, others rotor speeds; fit them by themselves.")
    slowest = max(float(flight.dt) for _, flight in parts)
    step = max(SAMPLE if part.sample is None else part.sample, slowest)
    if part.sample is not None and step > part.sample * _NEARLY:
        raise InputError(f"--sample-time {part.sample:g}: there is a sample every {slowest:.4g} s only.")
    length = round(part.window / step)
    if length < 4:
        raise InputError(f"--window {part.window:g}: less than four samples of {step:g} s; give at least {4 * step:g}.")
    least = (length - 1) * step
    long = [(number, flight) for number, flight in parts if float(flight.time[-1] - flight.time[0]) >= least / _NEARLY]
    even = [(number, with_body_velocity(averaged(flight, step))) for number, flight in long]
    kept = [(number, flight) for number, flight in even if flight.time.shape[0] >= length]
    if not kept:
        raise InputError(f"{paths[0]}: no part is as long as --window {part.window:g}; give a shorter one.")
    numbers = sorted({number for number, _ in kept})
    lost = [paths[number] for number in range(len(paths)) if number not in numbers]
    if lost:
        raise InputError(
            f"{lost[0]}: no part is as long as --window {part.window:g}; leave it out or give a shorter one."
        )
    together = join([flight for _, flight in kept], length=length)
    fitted, tested = _held_out(together, length, part.holdout)
    seconds = tuple(0.0 if f is None else float((~jnp.isnan(f.states[:, 7])).sum() * f.dt) for f in (fitted, tested))
    axes = [
        all(not np.isnan(np.asarray(flight.channels)[:, 12 + axis]).all() for _, flight in kept) for axis in range(3)
    ]
    return Recorded(
        fitted,
        tested,
        tuple(number for number, _ in kept),
        length,
        (axes[0], axes[1], axes[2]),
        (seconds[0], seconds[1]),
        tuple(notes),
    )


def _pieces(path: Path, flight: Flight, airframe: Airframe, part: Part) -> tuple[list[Flight], str | None]:
    """The stretches that can be used, or what `--from` and `--to` say, and what is told of it."""
    first, last = float(flight.time[0]), float(flight.time[-1])
    if part.begin is not None or part.end is not None:
        asked = Stretch(first if part.begin is None else part.begin, last if part.end is None else part.end)
        try:
            return [cut(flight, asked)], None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    every = stretches(flight, airframe)
    usable = [each for each in every if not each.reason]
    refused = [each for each in every if each.reason]
    if not usable:
        why = max(refused, key=lambda each: each.length)
        raise InputError(
            f"{path}: no stretch of it can be used (from {why.begin:.1f} s to {why.end:.1f} s: {why.reason}); say "
            "--from and --to to use one all the same."
        )
    if not refused:
        return [flight], None
    longest = sorted(refused, key=lambda each: -each.length)[:_MOST_PARTS]
    told = "; ".join(f"{each.begin:.1f} to {each.end:.1f} s: {each.reason}" for each in longest)
    seconds = sum(each.length for each in usable)
    return [cut(flight, each) for each in usable], (
        f"{seconds:.1f} of {last - first:.1f} s are used, in {len(usable)} stretches; not used: {told}"
        f"{'; ...' if len(refused) > _MOST_PARTS else ''} (--from and --to override)"
    )


def _held_out(flight: Flight, length: int, share: float) -> tuple[Flight, Flight | None]:
    """The flight without the measurements of every so many blocks of whole windows, and with those alone."""
    if not share:
        return flight, None
    windows = flight.time.shape[0] // length
    period = round(1 / share)
    block = max(min(round(BLOCK / (length * float(flight.dt))), windows // (2 * period)), 1)
    aside = np.repeat((np.arange(windows) // block) % period == period - 1, length)
    if not aside.any() or aside.all():
        return flight, None

    def without(where: np.ndarray, flight: Flight, *, force: bool) -> Flight:
        blank = eqx.tree_at(lambda f: f.states, flight, jnp.where(where[:, None], jnp.nan, flight.states))
        if not force or flight.specific_force is None:
            return blank
        return eqx.tree_at(lambda f: f.specific_force, blank, jnp.where(where[:, None], jnp.nan, flight.specific_force))

    return without(aside, flight, force=True), without(~aside, flight, force=False)


def _check(part: Part) -> None:
    if not (math.isfinite(part.window) and part.window > 0):
        raise InputError(f"--window: must be a positive number of seconds, got {part.window:g}.")
    if part.sample is not None and not (math.isfinite(part.sample) and part.sample > 0):
        raise InputError(f"--sample-time: must be a positive number of seconds, got {part.sample:g}.")
    if not 0 <= part.holdout <= 0.5:
        raise InputError(f"--holdout: must be a share from 0 to 0.5, got {part.holdout:g}.")
    if part.begin is not None and part.end is not None and not part.begin < part.end:
        raise InputError(f"--from {part.begin:g} --to {part.end:g}: must be in this order.")
