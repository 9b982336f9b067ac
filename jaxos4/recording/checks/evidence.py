"""The evidence of a log: its plausible values, its pieces in flight, and how its channels agree. Each is made once."""

import functools

import numpy as np
from jaxtyping import Float

from ...airframe import Airframe
from ...flight import RATES
from ...logs.sampling import held_regularly
from ..pieces import Recording, cut
from ..usable import SHORTEST, stretches
from .attitude import Turns, attitude_turns
from .finding import Limits, Measured
from .response import Response, rotor_response
from .values import Plausible, plausible
from .velocity import velocity_slopes

_HELD = 1.5  # samples; motors that keep their values for less have new ones in each sample
_FLYING, _CARRIED = 0.05, (0.5, 2.0)  # [rad/s], standard deviation of the rates; thrust as a share of the weight


class Evidence:
    """What the checks of one recording share. `airframe`: `None` if it is not known.

    **Arguments:** of `self_checks`.
    """

    def __init__(self, recording: Recording, airframe: Airframe | None, limits: Limits):
        self.logged, self.airframe, self.limits = recording, airframe, limits

    @functools.cached_property
    def plausible(self) -> Plausible:
        """The recording without faulty values."""
        return plausible(self.logged)

    @functools.cached_property
    def pieces(self) -> tuple[Recording, ...]:
        """The usable pieces of the flight."""
        recording = self.plausible.recording
        if recording.stretch is not None:  # joined flights are usable
            edges = np.flatnonzero(np.diff(recording.stretch)) + 1
            ends = zip([0, *edges], [*edges, recording.time.size], strict=True)
            return tuple(recording.rows(slice(int(begin), int(end))) for begin, end in ends)
        every = stretches(recording, self.airframe)
        return tuple(cut(recording, part) for part in every if not part.reason and part.length >= SHORTEST)

    @functools.cached_property
    def airborne(self) -> tuple[Recording, ...]:
        """The usable pieces; without any, the whole recording if its rotors carry the vehicle and it moves.

        A vehicle whose accelerometer is turned seems to lie on the ground.
        """
        whole = self.plausible.recording
        thrust = self.thrust(whole)
        if self.pieces or self.airframe is None or thrust is None:
            return self.pieces
        carried = float(np.median(thrust) / self.airframe.gravity)
        rates = whole.states[:, RATES]
        moves = max((np.std(x[np.isfinite(x)]) for x in rates.T if np.isfinite(x).any()), default=0.0) > _FLYING
        return (whole,) if moves and _CARRIED[0] < carried < _CARRIED[1] else ()

    def thrust(self, piece: Recording) -> Float[np.ndarray, " samples"] | None:
        """The thrust per mass that the airframe gives to the rotors [m/s^2]. `None`: the airframe does not know it."""
        if self.airframe is None or (piece.commanded and not self.airframe.has_full_scale):
            return None
        return float(self.airframe.thrust_coefficient / self.airframe.mass) * np.square(piece.omega).sum(axis=1)

    @functools.cached_property
    def force(self) -> Float[np.ndarray, "samples 3"]:
        """The specific force in flight [m/s^2]: measured samples only."""
        every = [piece.specific_force for piece in self.airborne if piece.specific_force is not None]
        force = np.concatenate(every) if every else np.empty((0, 3))
        return force[np.isfinite(force).all(axis=1)]

    @functools.cached_property
    def turns(self) -> Turns | None:
        """Attitude against gyro."""
        return attitude_turns(self.pieces)

    @functools.cached_property
    def velocity(self) -> Measured | None:
        """The horizontal acceleration by the velocity, along and across that by force and attitude, relative to it."""
        return velocity_slopes(self.pieces)

    @functools.cached_property
    def response(self) -> Response | None:
        """Gyro and accelerometer against the rotors. `None`: not known, as if motors keep their values for long."""
        if self.airframe is None or not self.pieces or self.motor_step > self.limits.held:
            return None
        return rotor_response(self.pieces, self.airframe)

    @functools.cached_property
    def motor_step(self) -> float:
        """The time between new motor values in flight [s]; 0 if they change in each sample, or at no fixed rate."""
        steps = [0.0]
        for piece in self.pieces:
            changes = piece.time[1:][(np.diff(piece.omega, axis=0) != 0).any(axis=1)]
            if held_regularly(changes):
                steps.append(float(np.median(np.diff(changes))))
        return max(steps) if max(steps) > _HELD * self.logged.dt else 0.0
