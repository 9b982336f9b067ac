"""`jaxos4.predict`: the whole flight, open loop, from many starts, by the vehicle of a result."""

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._custom_types import as_float
from ..airframe import MOTIONS
from ..analysis.prediction import Filtered
from ..bracket import Bracket
from ..errors import InputError, named, printable, shortened
from ..flight import ANGLES, FORCE_NAMES, Flight
from ..identification import Identification
from ..linalg import covariance_root
from ..logs import Recording, Source, as_recording
from ..models.flight_model import FlightModel, without_recording
from ..models.terms import COMMANDS, FULL_SCALE, TERMS, VOLTAGE
from ..recording.prepared import Prepared, prepare
from ..result_file import ResultSource, vehicle_result
from ..rotations import rotated
from ..shooting import capacity_of, pad_flight
from ..shooting.gains import Covariance, LogNoise
from .flight_prediction import FlightPrediction
from .measured import Measured, constant_rates, regressed
from .motion import PARTS, PUSH, Futures, fly_chunk, known_at_samples, settled

DRAWS = 64  # futures of a start for the band
HALF_BAND = 1.9977  # standard deviations of this many futures from the middle of a 95 % band to its end (Student)
SETTLED = 512  # rows after which the covariance of a filter no longer changes
CHUNK = 32  # starts that fly in one call of a program


class Vehicle(NamedTuple):
    """The vehicle that predicts.

    - `name`: the name of the result's file, or the estimator and the model.
    - `model`: for one recording.
    - `parameters`, `covariance`: estimates of the model's parameters; their mean, if each recording had its own value.
    - `offset`: how much the offsets of p', q', r' vary from recording to recording, as standard deviations [rad/s^2];
      0 if the model has none.
    - `noise`: levels of the body rates, then of the specific forces along `model.force_axes`.
    - `sample_time`: sample time of the fit [s].
    - `result`: the name of the result code.
    - `notes`: why the estimate cannot be trusted, and which parameters were not identified; one line each.
    """

    name: str
    model: FlightModel
    parameters: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    offset: Float[np.ndarray, "3"]
    noise: LogNoise
    sample_time: float
    result: str
    notes: tuple[str, ...]


def vehicle_of(found: ResultSource) -> Vehicle:
    """The vehicle of an identification or a file of `jaxos4 estimate --out`. Raises `InputError` or `OSError`."""
    file = vehicle_result(found)
    given = isinstance(found, Identification)
    name = f"{file.estimator}, {file.model} model" if given else printable(Path(found).name)
    with named("" if given else found):
        used = file.provenance
        if unknown := [term for term in used.terms or () if term not in TERMS]:
            raise InputError(
                f"the term {shortened(unknown[0], 40)} is not of this version; run `jaxos4 estimate` again."
            )
        model = FlightModel(file.airframe, terms=tuple(used.terms or ()), battery_voltage=used.battery_voltage or None)
        known = {row: each.estimate for row, each in file.parameters.items() if each.estimate is not None}
        known |= {row: each.value for row, each in file.held.items()}
        bracket = Bracket.default(model)
        center, half_width = (np.asarray(each).tolist() for each in (bracket.center, bracket.half_width))
        names, listed = model.parameter_names, [*file.parameters, *file.held]
        if missing := [name for name in names if name not in map(without_recording, listed)]:
            raise InputError(f"has no {', '.join(missing)}; run `jaxos4 estimate` again.")
        # Each parameter is the mean of its rows: one, or one for each recording.
        rows = [[row for row in listed if row in known and without_recording(row) == name] for name in names]
        values = [np.mean([known[row] for row in own]) if own else each for own, each in zip(rows, center, strict=True)]
        shares = np.array([[(row in own) / max(len(own), 1) for row in file.parameters] for own in rows])
        guessed = [name for name, own in zip(names, rows, strict=True) if not own]
        notes = [f"not identified, and predicted with the centre of the bracket: {', '.join(guessed)}"] * bool(guessed)
        width = dict(zip(names, half_width, strict=True))
        predicted = (*"pqr", *(FORCE_NAMES[axis] for axis in model.force_axes))
        if lacking := [each for each in predicted if each not in file.disturbances]:
            raise InputError(f"does not say the disturbance of {lacking[0]}; run `jaxos4 estimate` again.")
        levels = [file.disturbances[each] for each in predicted]
        table = np.array([(each.strength, each.time_constant, each.sensor, each.smoothing or 0.0) for each in levels])
        return Vehicle(
            name,
            model,
            np.array(values),
            shares @ np.array(file.covariance) @ shares.T,
            np.array([width.get(f"{axis}_offset", 0.0) for axis in MOTIONS]),
            LogNoise(*np.log(np.maximum(table, 1e-9)).T),  # finite
            used.sample_time,
            file.result,
            (*file.warnings, *notes),
        )


# Inputs that no prediction can replace.
_INPUTS = frozenset({COMMANDS, FULL_SCALE, VOLTAGE})


def predict(
    found: ResultSource | Vehicle,
    flight: Source,
    *,
    horizon: float = 0.5,
    sample_time: float | None = None,
    spacing: float = 0.1,
    seed: int = 0,
) -> FlightPrediction:
    """Predict position, velocity, attitude and body rates from many starts of a flight, with its rotor speeds.

        prediction = jaxos4.predict("found.json", "flight.csv")
        prediction.quality["attitude"].error       # by horizon [rad]

    A prediction begins with the measured position, velocity and attitude, and with the rates and disturbances that
    Kalman filters know from the measurements until then. After that it knows rotor speeds or commands, and the
    battery's voltage if the model needs it. The 95 % band holds what will be measured: it comes from 64 futures, of
    parameters, starts and disturbances, and from how far position, velocity and attitude are from dead reckoning.

    - `found`: the identification of a vehicle, the file that `jaxos4 estimate --out` wrote, or its
      `jaxos4.forecast.vehicle_of`.
    - `flight`: or the path of a log. It has body rates and attitude at least. Without a velocity, predictions begin
      with one from dead reckoning, or at rest; what was not measured is not compared.
    - `horizon`: how far ahead [s]. `spacing`: the time between two starts [s]; 0: at each sample.
    - `sample_time`: the log is averaged to it [s]; by default to the sample time of the fit.
    - `seed`: random seed of the draws.

    The regression for comparison is fitted to the flight of an identification, or else to the first half of `flight`.

    **Raises:** `InputError`, one line, for a result without a vehicle, a flight that cannot be predicted, or unusable
    arguments; `OSError` if `found` cannot be read.
    """
    for name, value, least in (("horizon", horizon, "positive"), ("spacing", spacing, "at least 0")):
        if not math.isfinite(value) or value < 0 or (value == 0 and name == "horizon"):
            raise InputError(f"`{name}`: must be a number of seconds, {least}, got {value:g}.")
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"`seed`: must be an integer of at least 0, got {seed!r}.")
    vehicle = found if isinstance(found, Vehicle) else vehicle_of(found)
    recording = as_recording(flight, airframe=vehicle.model.airframe)
    name, prepared = recording.name, _prepare(vehicle, recording, sample_time)
    measured = Measured.of(prepared.fitted)
    dt, steps = measured.dt, max(round(horizon / measured.dt), 1)
    for option, value in (("horizon", horizon), ("spacing", spacing)):
        if 0 < value < dt / 2:
            raise InputError(f"`{option}` {value:g}: {name} is predicted in samples of {dt:.4g} s; give at least that.")
    missing = tuple(part for part in ("position", "velocity") if not measured.has(part))
    start = _starts(measured, name, steps, max(round(spacing / dt), 1), missing)
    # White noise of longer samples is smaller.
    noise = vehicle.noise._replace(sensor=vehicle.noise.sensor + math.log(vehicle.sample_time / dt) / 2)
    begin, states, spread = _predict_states(vehicle, prepared.fitted, measured, start, missing, noise, steps, seed)
    fitted = found.problem if isinstance(found, Identification) else None
    trained = measured.first_half if fitted is None else Measured.of(fitted.flight)
    ahead, gravity = start[:, None] + np.arange(1, steps + 1), float(vehicle.model.airframe.gravity)
    gyro = np.broadcast_to(np.exp(noise.sensor[:3]), (steps, 3))
    sensors = np.concatenate([measured.contradictions(start, steps, gravity), gyro], axis=1)
    return FlightPrediction(
        found=vehicle.name,
        flight=name,
        time=prepared.time[start],
        horizons=dt * np.arange(1, steps + 1),
        begin=begin,
        predicted=states[:, 0],
        unaware=states[:, 1],
        half_width=HALF_BAND * np.sqrt(spread**2 + sensors**2),
        measured=measured.states[ahead],
        constant=constant_rates(begin, steps, dt),
        regression=regressed(trained, begin, measured.omega[ahead - 1], dt, gravity),
        missing=missing,
        seed=seed,
        notes=(*vehicle.notes, *prepared.notes),
    )


def _prepare(vehicle: Vehicle, recording: Recording, sample_time: float | None) -> Prepared:
    """The usable parts of a log, averaged to the sample time of the fit if the log's is shorter."""
    name, airframe = recording.name, vehicle.model.airframe
    if np.isnan(recording.states[:, ANGLES]).all(axis=0).any():
        raise InputError(f"{name}: a prediction begins with the attitude; log phi, theta and psi.")
    if sample_time is not None and not sample_time >= 0.99 * recording.dt:
        raise InputError(f"`sample_time` {sample_time:g}: {name} has one sample every {recording.dt:.4g} s; give that.")
    step = max(vehicle.sample_time, recording.dt) if sample_time is None else sample_time
    (prepared,) = prepare([recording], airframe, sample_time=step, holdout=0.0, predicted=True)
    for term in vehicle.model.terms:
        if lacking := (TERMS[term].needs & _INPUTS) - prepared.available:
            raise InputError(f"{name}: has no {' and '.join(sorted(lacking))}, which the term {term} needs; log it.")
    return prepared


def _starts(
    measured: Measured, name: str, steps: int, every: int, missing: tuple[str, ...]
) -> Int[np.ndarray, " starts"]:
    """The samples at which the state is measured, and that have this many samples after them."""
    start = np.arange(0, len(measured.stretch) - steps, every)
    start = start[measured.stretch[start] == measured.stretch[start + steps]]
    if not start.size:
        longest = (np.bincount(measured.stretch).max() - 1) * measured.dt
        raise InputError(f"{name}: no part is longer than `horizon`; give at most {longest:.3g}.")
    needed = np.concatenate([places for part, places in PARTS.items() if part not in missing])
    start = start[np.isfinite(measured.states[start][:, needed]).all(axis=1)]
    if not start.size:
        raise InputError(f"{name}: rates and attitude are nowhere measured together; log both at one rate.")
    return start


def _predict_states(
    vehicle: Vehicle,
    flight: Flight,
    measured: Measured,
    start: Int[np.ndarray, " starts"],
    missing: tuple[str, ...],
    noise: LogNoise,
    steps: int,
    seed: int,
) -> tuple[
    Float[np.ndarray, "starts 13"], Float[np.ndarray, "starts 2 steps 13"], Float[np.ndarray, "starts steps 12"]
]:
    """The states at the starts; those ahead, with and without the filters' knowledge; and the spread of the futures.

    Without measurements, the position is 0, and the velocity comes from dead reckoning and has no offset of the force.
    """
    if flight.body_velocity is None:  # the model's forcing has one
        flight = dataclasses.replace(flight, body_velocity=np.zeros((flight.time.size, 3)))
    if (capacity := capacity_of(flight.time.size)) != flight.time.size:
        flight = pad_flight(flight, capacity)
    generator, channels, dt = np.random.default_rng(seed), noise.strength.size, flight.dt
    root = covariance_root(vehicle.covariance)
    drawn = vehicle.parameters + generator.standard_normal((DRAWS, len(root))) @ root.T
    parameters = as_float(np.concatenate([[vehicle.parameters] * 2, drawn]))
    state, samples, noise = measured.states.copy(), len(measured.stretch), jax.tree.map(as_float, noise)
    if "velocity" in missing:
        reckoned = np.asarray(flight.body_velocity)[:samples].T
        state[:, PARTS["velocity"]] = np.stack(rotated(state[:, PARTS["attitude"]].T, reckoned), 1)
    if "position" in missing:
        state[:, PARTS["position"]] = 0.0
    accelerations = measured.accelerations(float(vehicle.model.airframe.gravity))
    padding = ((0, flight.time.size - samples), (0, 0))
    rows, changes = (as_float(np.pad(x, padding, constant_values=np.nan)) for x in (state, accelerations))
    prior = as_float(np.append(vehicle.offset, [PUSH * ("velocity" not in missing)] * 3))
    seen, length = (rows, changes, as_float(measured.noise[3:6])), jax.device_put(np.asarray(samples))
    known, forcing, offset = known_at_samples(vehicle.model, flight, length, parameters, seen, noise, prior)

    after, added, absorbed = jax.tree.map(np.asarray, settled(noise, dt, SETTLED))
    errors = _pairs(after, generator.standard_normal((DRAWS, channels, 2)))
    gusts = _pairs(added, generator.standard_normal((DRAWS, steps, channels, 2)))
    off = generator.standard_normal((DRAWS, 6))
    drawn = errors, np.stack([off, -np.append(absorbed[:3], np.zeros(3)) * off], axis=1), gusts
    certain = jax.tree.map(lambda x: as_float(np.concatenate([np.zeros((2, *x.shape[1:])), x])), drawn)
    futures = Futures(parameters, forcing, offset, jnp.asarray(np.arange(len(parameters)) != 1), *certain)

    chunks = (np.minimum(np.arange(i, i + CHUNK), start.size - 1) for i in range(0, start.size, CHUNK))
    found = [fly_chunk(vehicle.model, futures, known, jnp.asarray(start[rows]), noise, dt) for rows in chunks]
    states, spread = (np.concatenate([np.asarray(each[i]) for each in found])[: start.size] for i in range(2))
    return state[start], states, spread


def _pairs(covariance: Covariance, normal: Float[np.ndarray, "*batch channels 2"]) -> Filtered:
    """Rates or forces, and disturbances, with this covariance, from independent numbers of variance 1."""
    driven = np.sqrt(np.maximum(covariance.driven, 0.0))
    slope = np.divide(covariance.cross, driven, out=np.zeros_like(driven), where=driven > 0)
    own = np.sqrt(np.maximum(covariance.disturbance - slope**2, 0.0))
    return Filtered(driven * normal[..., 0], slope * normal[..., 0] + own * normal[..., 1])
