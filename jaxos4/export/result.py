"""Results of `jaxos4 estimate`, and vehicles drawn from the uncertainty of a result."""

import itertools
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._custom_types import as_constant
from ..airframe import AXES, INERTIAS, YAW
from ..closed_loop import ClosedLoop
from ..errors import InputError, named, printable
from ..flight import RATES, STATE_NAMES
from ..identification.results import Identification, VehicleIdentification
from ..models.flight_model import without_recording
from ..models.terms import STEEPEST
from ..result_file import ResultSource, vehicle_result
from .spread import DRAG, ESTIMATE, spread_of
from .vehicle import CARRIED, NOT_NEGATIVE, RigidVehicle, rigid_vehicle

# Why some parameters are not carried; notes on the rotors' inertia name alpha2 and alpha5. All others have one note.
_NOT_CARRIED = {
    ("voltage_exponent", "battery_fade"): "no simulator has the battery's voltage",
    ("motor_braking",): "is not carried: exported motors brake as they drive",
    ("battery_sag",): "is not carried: the exported battery has no internal resistance",
    ("p_bias", "q_bias", "r_bias", "ax_bias", "ay_bias", "az_bias"): "an error of a sensor, not of the vehicle",
    ("alpha1", "alpha4", "alpha7"): "replaced by the values that follow from Ix, Iy, Iz",
}

_BLOCK = 32  # draws made together: the usual vehicle needs one, and one with several dampings near 0 some dozens
# After so many draws, or so many that only lack a possible vehicle, an estimate counts as too uncertain.
_MAX_DRAWS, _MAX_IMPOSSIBLE = 1_000_000, 1000


class Identified(NamedTuple):
    """A vehicle from a result.

    - `source`: names the file, the estimator, the model and the result.
    - `identification`: the result itself.
    - `values`: all parameters by name, estimated or fixed.
    - `identifies_iz`: whether the flights show Iz, if the airframe's drag coefficient is right.
    - `notes`: differences between the result and the vehicle that simulators get; one line each.
    - `inertia_z`: the moment of inertia Iz [kg m^2] that the user gave in the place of the estimate.
    - `varying`, `root`: the Gaussian of the constants that differ in drawn vehicles, see `spread_of`.
    """

    source: str
    identification: VehicleIdentification
    values: dict[str, float]
    identifies_iz: bool
    notes: tuple[str, ...]
    inertia_z: float | None = None
    varying: dict[str, dict[str, Any]] = {}
    root: Float[np.ndarray, "n n"] = np.zeros((0, 0))

    @property
    def vehicle(self) -> RigidVehicle:
        """The vehicle with the estimated parameters."""
        return self._made(self.values)

    def _made(self, values: dict[str, float]) -> RigidVehicle:
        airframe = self.identification.airframe
        estimated = rigid_vehicle(airframe, values)
        ix, iy, iz = estimated.inertia
        if self.inertia_z is None or (self.identifies_iz and not iz > 0):
            return estimated
        rounding = 1e-9
        allowed = min(max(self.inertia_z, (1 + rounding) * abs(ix - iy)), (1 - rounding) * (ix + iy))
        vehicle = rigid_vehicle(airframe, {**values, YAW.inertia: allowed})
        if not self.identifies_iz:
            return vehicle
        # Flights show the yaw torque over Iz: another Iz means another drag coefficient.
        return vehicle._replace(drag_coefficient=vehicle.drag_coefficient * allowed / iz)

    def draw(self, number: int, *, seed: int) -> tuple[RigidVehicle, int]:
        """A vehicle drawn from the uncertainty of the estimate, and how many draws were repeated before it.

        Draws are repeated if a lag, delay, damping or drag is negative, or if no vehicle can be like them. The vehicle
        depends on its `number` and the seed alone. Raises `InputError` if hardly any draw is possible.
        """
        generator, names = np.random.default_rng([seed, number]), list(self.varying)
        positive = [place for place, name in enumerate(names) if name in NOT_NEGATIVE]
        mean, impossible = np.array([row["mean"] for row in self.varying.values()]), 0
        for before in range(0, _MAX_DRAWS, _BLOCK):
            rows = mean + generator.standard_normal((_BLOCK, len(names))) @ self.root.T
            for place in np.flatnonzero((rows[:, positive] >= 0).all(axis=1)).tolist():
                vehicle = self._made(self.values | dict(zip(names, rows[place].tolist(), strict=True)))
                if not vehicle.fault:
                    return vehicle, before + place
                impossible += 1
            if impossible >= _MAX_IMPOSSIBLE:
                break
        raise InputError(
            "`samples`: the estimate is too uncertain: hardly any draw is a possible vehicle; export without samples, "
            "or fly with more excitation."
        )

    @property
    def gaussian(self) -> dict[str, dict[str, Any]]:
        """Mean, standard deviation, unit and origin of each constant that varies, ready for JSON.

        Without Iz and what follows from it, if Iz was given.
        """
        given = () if self.inertia_z is None else (YAW.inertia, DRAG)
        return {name: row for name, row in self.varying.items() if name not in given}

    @property
    def notes_on_draws(self) -> tuple[str, ...]:
        """Why drawn vehicles differ by more than the estimate's uncertainty; one line each."""
        rows = {name: row for name, row in self.gaussian.items() if row["origin"] != ESTIMATE}
        sizes = {name: f"{row['std']:.3g} {row['unit']}".strip().removesuffix(" 1") for name, row in rows.items()}
        return tuple(f"{name}: varies by {sizes[name]} (std): {row['origin']}" for name, row in rows.items())


_MAY_BE_POSITIVE = 2.0  # standard deviations below 0: one draw in 44 is positive


def read_result(found: ResultSource, *, inertia_z: float | None = None) -> Identified:
    """The vehicle of an identification, or of a file that `jaxos4 estimate --out` wrote.

    `inertia_z`: Iz [kg m^2] instead of the estimate, as far as a rigid body with these Ix and Iy can have it.

    **Raises:** `InputError`, one line, if the file is no result, has no estimate, or describes an impossible vehicle;
    `OSError` if it cannot be read.
    """
    if inertia_z is not None and not 0 < inertia_z < math.inf:
        raise InputError(f"`inertia_z`: must be positive, got {inertia_z:g}.")
    file = vehicle_result(found)
    with named("" if isinstance(found, Identification) else found):
        values, estimated, notes = _parts(file)
        negative = [name for name in NOT_NEGATIVE if values.get(name, 0.0) < 0]
        # One that may be positive is drawn, from the part of its Gaussian that is.
        never = [name for name in negative if values[name] < -_MAY_BE_POSITIVE * (file.parameters[name].std or 0.0)]
        varies = {name: "" if name in never else ", and above 0 in samples" for name in negative}
        notes += [f"{name}: came out negative, which is impossible; it is 0 here{varies[name]}" for name in negative]
        if not np.isfinite(file.airframe.max_rotor_speed):
            notes.append("max_rotor_speed: not in the airframe; it is twice the hover speed here")
        source = printable(", ".join(file.logs) if isinstance(found, Identification) else Path(found).name)
        exported = Identified(
            source=f"{source} ({file.estimator}, {file.model} model, {file.result})",
            identification=file,
            values=values | dict.fromkeys(negative, 0.0),
            identifies_iz=YAW.inverse in estimated,
            notes=tuple(notes),
            inertia_z=inertia_z,
        )
        if inertia_z is not None:
            own = tuple(note for note in exported.notes if not note.startswith("Iz: "))
            exported = exported._replace(notes=(*own, _given_note(exported, inertia_z)))
        if why := exported.vehicle.fault:
            guessed = inertia_z is None and not exported.identifies_iz and why.startswith(INERTIAS)
            guess = "; Iz was not identified and is a guess: give `inertia_z`" if guessed else ""
            raise InputError(
                f"no vehicle is like this: {why}{guess}; correct the airframe, or fly with more excitation."
            )
        drawn = [name for name in estimated if name not in never]
        varying, root = spread_of(file, values, drawn, rigid_vehicle(file.airframe, values))
        return exported._replace(varying=varying, root=root)


def _given_note(found: Identified, inertia_z: float) -> str:
    """A note on the difference of the vehicle from the result if the user gave Iz."""
    vehicle, note = found.vehicle, f"Iz: given, not estimated: {inertia_z:.4g} kg m^2"
    if not math.isclose(vehicle.inertia[2], inertia_z, rel_tol=1e-6):
        note += f"; a rigid body with these Ix and Iy allows {vehicle.inertia[2]:.4g}"
    if found.identifies_iz:
        estimated = found._replace(inertia_z=None).vehicle
        factor = vehicle.drag_coefficient / estimated.drag_coefficient
        note += f"; the drag coefficient is {factor:.4g} times the airframe's, so that it yaws as the flight showed"
    return note


# Standard deviations of an inertia of the rotors from 0, and of a thrust curve from 1, with which they are exported.
_SIGNIFICANT = 3.0


def _parts(file: VehicleIdentification) -> tuple[dict[str, float], list[str], list[str]]:
    """Values by name, the names of those that were estimated, and notes."""
    rows, constants, notes = file.parameters, file.rigid_body.constants, []
    found = {name: (row.estimate, row.std or 0.0) for name, row in rows.items() if row.estimate is not None}
    for axis in AXES:
        if constants and axis.inertia not in constants:
            found.pop(axis.inverse, None)  # the estimate says that this one is not to be trusted
    if "rotor_reaction" in found and not found["rotor_reaction"][0] > _SIGNIFICANT * found["rotor_reaction"][1]:
        del found["rotor_reaction"]
    if "rotor_reaction" not in found and "rotor_reaction" in (*rows, *file.held):
        notes.append("rotor_reaction: below noise; the inertia of the rotors is the airframe's")
    curve, error = found.get("thrust_curve", (1.0, 0.0))
    if abs(curve - 1) < _SIGNIFICANT * error:
        del found["thrust_curve"]
    values = {name: value for name, (value, _) in found.items()}
    values = {name: row.value for name, row in file.held.items() if name != "rotor_reaction"} | values
    for axis in AXES:
        if axis.inverse not in found:
            notes.append(f"{axis.inertia}: not identified; a guess, from the airframe or from the bracket")
    if "rotor_lag" not in values:
        notes.append(
            "rotor_lag: unknown, because the log has measured rotor speeds; rotors follow commands at once here"
        )
    for names, why in _NOT_CARRIED.items():
        some = [name for name in found if without_recording(name) in names]
        if some:
            notes.append(f"{', '.join(some)}: {why}")
    noted = {"alpha2", "alpha5", *CARRIED, *itertools.chain(*_NOT_CARRIED)}
    if lost := [name for name in rows if without_recording(name) not in noted]:
        notes.append(f"{', '.join(lost)}: not carried: an exported vehicle of this version has no such parameters")
    if any(name.startswith("roll_offset_") for name in values):
        notes.append("offsets: the mean of the recordings")
    zero = [name for name in (*(axis.inverse for axis in AXES), "thrust_gain") if values.get(name) == 0]
    if zero:
        raise InputError(f"no vehicle is like this: {zero[0]} is 0; fly with more excitation.")
    return values, list(found), notes


# What of the vehicle and of its motors flies in closed loop.
_FOUND = ("inertia", "rotor_inertia", "thrust_coefficient", "drag_coefficient")
_TIMES = ("rotor_lag", "rotor_delay")
# They need a full scale. With their largest values in a `ClosedLoop`; random errors may put an estimate beyond.
_SHAPES = {"thrust_curve": STEEPEST, "motor_braking": 1.0}


def found_loop(path: str | os.PathLike[str], **settings: Any) -> ClosedLoop:
    """The vehicle of a file of `jaxos4 estimate --out`, with its rotors, damping and gusts, and a controller.

    An estimate beyond what a motor can be is moved to its limit.

    `settings`: of a `ClosedLoop`, instead of those that were found. Raises as `read_result` does.
    """
    found = read_result(path)
    vehicle, gusts = found.vehicle, found.identification.disturbances
    airframe = eqx.tree_at(
        lambda airframe: tuple(getattr(airframe, name) for name in _FOUND),
        found.identification.airframe,
        tuple(as_constant(getattr(vehicle, name)) for name in _FOUND),
    )
    values = found.values
    known: dict[str, Any] = {name: values[name] for name in _TIMES if values.get(name, 0.0) > 0}
    if airframe.has_full_scale:
        known |= {name: min(values[name], most) for name, most in _SHAPES.items() if name in values}
    rates = [gusts[name] for name in (STATE_NAMES[column] for column in RATES) if name in gusts]
    if len(rates) == 3:
        known |= {"gust": [each.strength for each in rates], "gust_time": np.mean([x.time_constant for x in rates])}
    known |= {"damping": vehicle.damping / vehicle.inertia}
    known |= {"logged": "commands" if "rotor_lag" in found.values and airframe.has_full_scale else "speeds"}
    return ClosedLoop(airframe, **known | settings)
