"""The model of a real vehicle: the corrected OS4 and the chosen terms."""

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from .._custom_types import Count, Numeric, Parameters, Scalar, as_float
from ..airframe import OS4, Airframe
from ..flight import Inputs
from .abstract import PARAMETER_NAMES, AbstractModel, ByRecording, OfAirframe, Parameter
from .os4 import CorrectedOS4
from .rotors import Batch, Grid, measured_speeds, of_stretches, squared
from .state import Forcing, Orientation, Rates, Samples, State, Translation, Vector, attitude_rates, to_body, to_earth
from .terms import COMMANDS, FULL_SCALE, TERMS, VELOCITY, VOLTAGE, Term, Values, clash, default_terms, required

DEFAULT_TERMS = default_terms(frozenset({COMMANDS}))

Row = tuple[Term, str, Parameter]
"""A row of the table of parameters: a term, the parameter's name in it, and the parameter of the model."""


class FlightModel(AbstractModel):
    """`CorrectedOS4` and the effects that real vehicles show. Each term is optional.

        p' = alpha1 q r - alpha2 Omega_r q + alpha3 d_roll + roll_offset + roll_thrust (U_c / m - 9.81)
             - roll_damping p + roll_velocity v_y
        q' = alpha4 p r + alpha5 Omega_r p + alpha6 d_pitch + pitch_offset + pitch_thrust (U_c / m - 9.81)
             - pitch_damping q + pitch_velocity v_x
        r' = alpha7 p q + alpha8 d_yaw + yaw_offset - yaw_damping r - rotor_reaction Omega_r'
        rotor_lag w_i' = g(u_i(t - rotor_delay) - thrust_curve w_i) - (1 - thrust_curve) w_i^2
        u_i = command_i (V / V_0)^voltage_exponent (1 - battery_fade t)
        a_z = thrust_gain U_c / m - z_drag v_z + az_bias,  a_x = ax_bias - x_drag v_x,  a_y = ay_bias - y_drag v_y

    The last line is the specific force, as an accelerometer at the centre of mass measures it. `jaxos4.models.rotors`
    explains the motors, whose speeds w_i = omega_i / `max_rotor_speed`.

    A centre of mass at (x_c, y_c) in the frame of the rotor positions gives the thrust U_c the torque (-y_c U_c, x_c
    U_c, 0): roll_thrust = -alpha3 m y_c and pitch_thrust = alpha6 m x_c (`jaxos4.center_of_mass`). Only thrust above
    hover counts, to distinguish it from a constant torque. Rotors of unequal thrust cause the same torque.

    - `terms`: the terms that are estimated, by their names in `jaxos4.TERMS`. `velocity`, `inflow` and `drag` need
      `Flight.body_velocity`, or states with a velocity; `gyro_bias` beside `offset` needs the attitude. Leave out
      `motor`, `lag` and `delay` if rotor speeds were measured.
    - `recordings`: for each stretch of the flight, the number of its recording, counted from 0; the last number holds
      for all stretches that follow. Each recording has its own offsets and gyro biases.
    - `battery_voltage`: V_0, the voltage at which a command gives the rotor speed in the flight [V].
    - `batch`: up to this many samples of a padded flight, or parts of them, are computed together.

    **Raises:** `ValueError` for terms that do not exist, are given twice or exclude each other, recordings that are not
    counted from 0, or a term that needs an unknown `airframe.max_rotor_speed` or `battery_voltage`.
    """

    batch: ClassVar[int] = 512

    airframe: Airframe
    terms: tuple[str, ...] = eqx.field(static=True)
    recordings: tuple[int, ...] = eqx.field(static=True)
    battery_voltage: Scalar | None

    def __init__(
        self,
        airframe: Airframe = OS4,
        *,
        terms: tuple[str, ...] = DEFAULT_TERMS,
        recordings: tuple[int, ...] = (0,),
        battery_voltage: Float[ArrayLike, ""] | None = None,
    ):
        unknown = [term for term in terms if term not in TERMS]
        if unknown or len(set(terms)) < len(terms):
            raise ValueError(f"`terms` must be some of {', '.join(TERMS)}, each once, got {', '.join(terms)}.")
        if why := clash(terms):
            raise ValueError(f"`terms`: {why}.")
        if not recordings or sorted(set(recordings)) != list(range(max(recordings) + 1)):
            raise ValueError(f"`recordings` must count from 0 and leave no number out, got {recordings}.")
        unscaled = [term for term in terms if FULL_SCALE in TERMS[term].needs]
        if unscaled and not airframe.has_full_scale:
            raise ValueError(f"`airframe.max_rotor_speed` must be known for the term {unscaled[0]}: set it.")
        powered = [term for term in terms if VOLTAGE in TERMS[term].needs]
        if powered and battery_voltage is None:
            raise ValueError(f"`battery_voltage` must be given for the term {powered[0]}: it is the usual voltage.")
        # All flights of one recording share a program, however many stretches they have.
        every = list(recordings)
        while every[-2:] == every[-1:] * 2:
            every.pop()
        self.airframe, self.terms, self.recordings = airframe, tuple(terms), tuple(every)
        self.battery_voltage = None if battery_voltage is None else as_float(battery_voltage)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """alpha_1..8, then the parameters of the terms in the order of `TERMS`."""
        return (*self._rigid_body.parameters, *(parameter for *_, parameter in self._table))

    @property
    def quantities(self) -> dict[str, list[str]]:
        """The quantities that the terms describe, with their parameters but without biases; see `Term.quantity`."""
        found: dict[str, list[str]] = {}
        for term, _, parameter in self._table:
            if term.quantity and parameter.force_axis is None:
                found.setdefault(term.quantity, []).append(parameter.name)
        return found

    @property
    @eqx.filter_jit  # one program instead of a dozen small ones
    def alpha(self) -> Parameters:
        """alpha_1..8 of the airframe, then the centres of the terms' parameters."""
        return jnp.concatenate([self._rigid_body.alpha, self._of_terms(lambda parameter: parameter.center)])

    @property
    def half_width(self) -> Parameters:
        """Half the width of a bracket for each parameter: our choice, for small and large quadrotors."""
        return jnp.concatenate([self._rigid_body.half_width, self._of_terms(lambda parameter: parameter.half_width)])

    def by_recording(self, stretch: Int[Numeric, " samples"] | None) -> ByRecording | None:
        """See `AbstractModel`."""
        if stretch is None or max(self.recordings) == 0 or list(self.recordings) != sorted(self.recordings):
            return None
        one, names = dataclasses.replace(self, recordings=(0,)), self.parameter_names
        places = [
            [names.index(name if name in names else f"{name}_{i + 1}") for name in one.parameter_names]
            for i in range(max(self.recordings) + 1)
        ]
        return ByRecording(one, np.array(places), of_stretches(self.recordings, stretch))

    @property
    def gyroscopic_factor(self) -> Scalar:
        """See `AbstractModel`."""
        return self._rigid_body.gyroscopic_factor

    @property
    def force_axes(self) -> tuple[int, ...]:
        """The axes that the terms predict, if one of the terms is an accelerometer."""
        if not any(term.accelerometer for term in self._terms):
            return ()
        return tuple(sorted({axis for term in self._terms for axis in term.force_axes}))

    @property
    def observes_states(self) -> bool:
        """Whether no term acts on the sensors."""
        return not any(term.gyro or term.accelerometer for term in self._terms)

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The chain from commands to torque and thrust, in which each term acts at its place. Padding takes no time."""
        if inputs.within is None:
            return self._beside(inputs, self._rotors(inputs, parameters))
        samples, parts, _ = inputs.within.shape
        last = samples - 1 if inputs.stretches is None else inputs.stretches.last[:, None]
        following = parts * np.arange(samples)[:, None] + parts // 2 + np.arange(parts)
        following = jnp.minimum(following, parts * last + parts - 1)
        fine = self._rotors(inputs.divided, parameters, parts=parts)
        return self._beside(inputs, jax.tree.map(lambda leaf: leaf[following].mean(axis=1), fine))

    def centered_forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The mean forcing of each sample, around its time like the rotor speeds in `Flight.within`."""
        if inputs.within is None:
            return self.forcing(inputs, parameters)
        samples, parts, _ = inputs.within.shape
        edges, length = np.linspace(0, 1, parts + 1), jnp.asarray(inputs.averaging_time) / inputs.dt
        after = jnp.clip(edges - (1 - length) / 2, 0, length)  # since the beginning of the window
        # The share of a measurement's rows that are later than a time, integrated over each part and doubled.
        rows = jnp.round(1 / jnp.sqrt(jnp.maximum(1 - length**2, 1e-6)))
        many = jnp.minimum(edges, (1 + length) / 2) - after**2 / jnp.where(length > 0, 2 * length, 1.0)
        few = sum(jnp.where(i < rows, jnp.minimum(edges, (i + 0.5) / rows), 0.0) / rows for i in range(parts - 1))
        left = 2 * jnp.diff(jnp.where(rows < parts, few, many))
        wide = jnp.maximum(length, 2 / parts)  # an instant counts as the parts before and after it
        seen = jnp.diff(jnp.clip(edges - (1 - wide) / 2, 0, wide)) / wide

        def averaged(fine: Forcing) -> Forcing:
            fine = jax.tree.map(lambda leaf: leaf.reshape(-1, parts), fine)
            whole = jax.tree.map(lambda leaf: leaf.mean(axis=1), fine)
            early = jax.tree.map(lambda leaf: leaf @ left, fine)
            return whole._replace(sensed_specific_thrust=fine.mean_specific_thrust @ seen, early=early)

        return self._beside(inputs, self._rotors(inputs.divided, parameters, parts=parts, of_parts=averaged))

    def _beside(self, inputs: Inputs, rotors: Forcing) -> Forcing:
        """The forcing by the rotors, with the recording and the velocity of each sample."""
        own, velocity = jnp.zeros(inputs.omega.shape[0], dtype=int), inputs.velocity
        if inputs.stretches is not None:
            own = of_stretches(self.recordings, inputs.stretches.number)
        shares = tuple((own == i).astype(rotors.roll.dtype) for i in range(max(self.recordings) + 1))
        return rotors._replace(recording=shares, velocity=None if velocity is None else tuple(velocity.T))

    def _rotors(
        self, inputs: Inputs, parameters, *, parts: int = 0, of_parts: Callable[[Forcing], Forcing] = lambda fine: fine
    ) -> Forcing:
        """The forcing by the rotors, transformed by `of_parts`. `parts`: parts per sample; 0: `inputs` are samples."""
        grid, samples = Grid.of(inputs, self.battery_voltage, self.recordings, are_parts=parts > 0), len(inputs.omega)
        before = jnp.zeros_like(inputs.omega[0])
        if inputs.length is None:
            return of_parts(self._rotor_forcing(inputs, Batch(grid, jnp.arange(samples), before), parameters)[0])
        # Batch after batch, so that padding takes no time. A batch holds all parts of its samples.
        rows = self.batch - self.batch % max(parts, 1)
        zeros = jnp.zeros(-(-samples // rows) * rows, float)
        nothing = of_parts(Forcing(zeros, zeros, zeros, zeros, zeros, zeros, zeros))
        many = nothing.roll.shape[0] * rows // zeros.shape[0]

        def fill(i: Count, carry: tuple[Forcing, Array]) -> tuple[Forcing, Array]:
            filled, before = carry
            batch = Batch(grid, jnp.minimum(i * rows + jnp.arange(rows), samples - 1), before)
            found, before = self._rotor_forcing(inputs, batch, parameters)
            place = functools.partial(jax.lax.dynamic_update_slice_in_dim, start_index=i * many, axis=0)
            return jax.tree.map(place, filled, of_parts(found)), before

        filled, _ = jax.lax.fori_loop(0, -(-inputs.length // rows), fill, (nothing, before))
        return jax.tree.map(lambda leaf: leaf[: samples * many // rows], filled)

    def _rotor_forcing(self, inputs: Inputs, batch: Batch, parameters) -> tuple[Forcing, Array]:
        """The forcing by the rotors over some samples, and the rotor speeds at the end of the last sample."""
        airframe = self.airframe

        def omega(rows: Int[Array, "*rows"]) -> Float[Array, "*rows 4"]:
            return inputs.omega[rows]

        for change, values in self._contributions("command", parameters):
            omega = change(omega, values, batch.grid)
        drive, values = next(iter(self._contributions("speed", parameters)), (None, {}))
        speeds = drive(omega(batch.rows), values, batch, airframe) if drive else measured_speeds(omega, batch)
        mean, around = squared(speeds, batch)
        roll, pitch, yaw, thrust = (mean @ airframe.mixer.T).T
        spins, mass = jnp.asarray(airframe.rotor_spins), airframe.mass
        found = Forcing(
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            mean_specific_thrust=thrust / mass,
            residual_speed=(speeds.begin + speeds.end) @ spins / 2,
            spin_up=speeds.change @ spins / inputs.dt,
            sensed_specific_thrust=around.sum(axis=1) * airframe.thrust_coefficient / mass,
        )
        return found, speeds.end[-1]

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """p', q', r' [rad/s^2] of the rigid body, with the contribution of each term."""
        total = self._rigid_body.angular_acceleration(rates, forcing, tuple(parameters[:8]))
        for add, values in self._contributions("angular_acceleration", parameters, forcing):
            total = add(total, values, rates, forcing)
        return total

    def specific_force(self, thrust: Samples, forcing: Forcing, parameters) -> Vector:
        """The specific force along the body's axes [m/s^2] from a specific thrust and the terms."""
        force = (jnp.zeros_like(thrust), jnp.zeros_like(thrust), thrust)
        for add, values in self._contributions("specific_force", parameters, forcing):
            force = add(force, values, forcing)
        return force

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """See `AbstractModel`. Terms use the measured body velocity, or else the velocity of the state."""
        t, orientation = state.translation, None if state.attitude is None else Orientation.of(state.attitude)
        forcing = self._with_velocity(forcing, t, orientation)
        rates = self.angular_acceleration(state.rates, forcing, parameters)
        angles = None if orientation is None else attitude_rates(state.rates, orientation)
        translation = None
        if orientation is not None and t is not None:
            ax, ay, az = to_earth(orientation, self.specific_force(forcing.mean_specific_thrust, forcing, parameters))
            translation = Translation(t.vx, ax, t.vy, ay, t.vz, az - self.airframe.gravity)
        return State(rates, angles, translation)

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """The states and the specific force along `force_axes`, as the sensors of the terms show them."""
        rates = state.rates
        for add, values in self._contributions("gyro", parameters, forcing):
            rates = add(rates, values)
        states = tuple(jax.tree.leaves(state._replace(rates=rates)))
        if not self.force_axes:
            return states
        orientation = None if state.attitude is None else Orientation.of(state.attitude)
        forcing = self._with_velocity(forcing, state.translation, orientation)
        thrust = required(forcing.sensed_specific_thrust, "`forcing` must come from `FlightModel.forcing`.")
        force = self.specific_force(thrust, forcing, parameters)
        for add, values in self._contributions("accelerometer", parameters, forcing):
            force = add(force, values)
        return (*states, *(force[axis] for axis in self.force_axes))

    @property
    def _rigid_body(self) -> CorrectedOS4:
        return CorrectedOS4(self.airframe)

    @property
    def _terms(self) -> tuple[Term, ...]:
        return tuple(TERMS[name] for name in TERMS if name in self.terms)

    @property
    def _table(self) -> tuple[Row, ...]:
        return _table(self._terms, self.force_axes, max(self.recordings) + 1)

    def _of_terms(self, constant: Callable[[Parameter], OfAirframe]) -> Parameters:
        """A constant of each row of the table, for this airframe."""
        # In the order of the table, because a set would order a program's operations by the addresses of functions.
        constants = [constant(parameter) for *_, parameter in self._table]
        values = {c: as_float(c(self.airframe) if callable(c) else c) for c in dict.fromkeys(constants)}
        return jnp.stack([values[c] for c in constants]) if constants else jnp.zeros(0)

    def _contributions(self, field: str, parameters, forcing: Forcing | None = None) -> list[tuple[Callable, Values]]:
        """The contributions of the terms to a field of `Term`, each with the values of its parameters."""
        acting = [(term, getattr(term, field)) for term in self._terms]
        return [(change, self._values(term, parameters, forcing)) for term, change in acting if change]

    def _values(self, term: Term, parameters, forcing: Forcing | None) -> Values:
        """The values of a term's parameters by name. In each sample, the values of its recording count."""
        found: dict[str, list[Scalar]] = {}
        for place, (owner, name, _) in enumerate(self._table, start=len(PARAMETER_NAMES)):
            if owner is term:
                found.setdefault(name, []).append(parameters[place])
        shares = forcing.recording if forcing else ()

        def own(values: list[Scalar]) -> Samples:
            each = (share * value for share, value in zip(shares, values, strict=True))
            return sum(each, as_float(0.0)) if len(values) > 1 else values[0]

        return {name: own(values) for name, values in found.items()}

    def _with_velocity(self, forcing: Forcing, t: Translation | None, orientation: Orientation | None) -> Forcing:
        """Take the body velocity from the state if a term needs it and it was not measured."""
        needed = any(VELOCITY in term.needs for term in self._terms)
        if not needed or forcing.velocity is not None or orientation is None or t is None:
            return forcing
        return forcing._replace(velocity=to_body(orientation, (t.vx, t.vy, t.vz)))


def without_recording(name: str) -> str:
    """The name of a parameter without the number of its recording."""
    return re.sub(r"_\d+$", "", name)


@functools.cache
def _table(terms: tuple[Term, ...], force_axes: tuple[int, ...], recordings: int) -> tuple[Row, ...]:
    """The parameters by term, and within a term by recording. Names count recordings from 1."""
    rows, numbers = [], [""] if recordings == 1 else [f"_{i + 1}" for i in range(recordings)]
    for term in terms:
        sources = [source for source in term.parameters if source.force_axis in (None, *force_axes)]
        named = [(source, "") for source in sources if not source.each_recording]
        named += [(source, number) for number in numbers for source in sources if source.each_recording]
        for source, number in named:
            rows.append((term, source.name, source._replace(name=source.name + number, in_forcing=term.in_forcing)))
    return tuple(rows)
