"""What real vehicles show beyond the corrected OS4: offsets, damping, rotors that lag, sensors that are biased."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int, Num

from .._custom_types import Parameters, RotorSpeeds, Scalar, as_float
from ..airframe import OS4, Airframe
from ..flight import STATE_NAMES, Flight, Inputs, fill_gaps
from ..trigonometry import sincos
from .abstract import PARAMETER_NAMES, AbstractModel, attitude_rates
from .corrected import CorrectedOS4
from .published import PublishedOS4
from .state import Attitude, Forcing, Rates, State, Translation

# The share of the torque that one pair of rotors makes in hover that an offset may be, and that 5 m/s may make.
_AUTHORITY = 0.2
_FAST = 5.0
# Where rotors' lag and delay are looked for [s]: small vehicles have 0.02 to 0.1 s.
_LAG, _LAG_WIDTH, _DELAY_WIDTH = 0.05, 0.03, 0.02
# What an accelerometer that was levelled before take-off may be off [m/s^2].
_BIAS = 0.3
# A rotor's lag below this share of a sample is none: the filter stays stable wherever a search looks.
_SHORTEST = 0.05
# Of the torque that pairs of rotors make in roll and pitch, the share that they make in yaw.
_YAW = 0.2
_VELOCITY = "velocity and drag need `Flight.body_velocity`"
_AXES = ("roll", "pitch", "yaw")


class Parameter(NamedTuple):
    """A parameter of a term: its name, its unit, and the recording that it belongs to where it is not the vehicle's."""

    kind: str
    unit: str
    recording: int | None = None

    @property
    def name(self) -> str:
        """With the number of its recording, counted from 1."""
        return self.kind if self.recording is None else f"{self.kind}_{self.recording + 1}"


TERMS = {
    "offset": "a constant torque about each axis, of each recording: roll_offset, pitch_offset, yaw_offset [rad/s^2]",
    "damping": "a moment against each body rate: roll_damping, pitch_damping, yaw_damping [1/s]",
    "velocity": "a moment with the body velocity: roll_velocity, pitch_velocity [rad/(m s)]",
    "flapping": "a moment with the measured lateral specific force: roll_flapping, pitch_flapping [rad/m]",
    "lag": "rotors follow their commands as first-order systems: rotor_lag [s]",
    "delay": "commands act later than they are recorded: rotor_delay [s]",
    "reaction": "the body's answer to rotors that accelerate: rotor_reaction = J_R / Iz",
    "curve": "thrust between linear (0) and quadratic (1) in the rotor speed: thrust_curve",
    "accelerometer": "specific force is measured: thrust_gain, and ax_bias, ay_bias, az_bias [m/s^2] where they count",
    "drag": "a force against the body velocity: x_drag, y_drag [1/s]",
    "gyro_bias": "rates are measured with an offset, of each recording: p_bias, q_bias, r_bias [rad/s]",
}
DEFAULT_TERMS = ("offset", "damping", "lag", "delay", "reaction")


class FlightModel(AbstractModel):
    """`CorrectedOS4` with what real vehicles show, each term of it optional.

        p' = alpha1 q r - alpha2 Omega_r q + alpha3 d_roll + roll_offset - roll_damping p + roll_velocity v_y
        q' = alpha4 p r + alpha5 Omega_r p + alpha6 d_pitch + pitch_offset - pitch_damping q + pitch_velocity v_x
        r' = alpha7 p q + alpha8 d_yaw + yaw_offset - yaw_damping r - rotor_reaction Omega_r'
        omega_i' = (command_i(t - rotor_delay) - omega_i) / rotor_lag
        a_z = thrust_gain U_c / m + az_bias,    a_x = ax_bias - x_drag v_x,    a_y = ay_bias - y_drag v_y

    The last line is what an accelerometer at the centre of mass measures: specific force.

    **Arguments:**

    - `terms`: of `jaxos4.TERMS`, which are estimated.
    - `recordings`: of each stretch of the flight, the recording that it belongs to, counted from 0. Offsets and gyro
      biases are those of a recording, all else is the vehicle's.

    `jaxos4.hold` takes parameters out of the estimation, at a value that is known. `velocity` and `drag` need
    `Flight.body_velocity`, `flapping` needs `Flight.specific_force`: the drag that rotors feel is proportional to the
    body velocity, and so is the moment that it makes; where velocity was not measured the force stands for it.
    `gyro_bias` can be told from offsets only where the attitude is compared too. Lag and delay do not apply to rotor
    speeds that were measured.

    **Raises:** `ValueError` for a term that does not exist or stands twice, recordings that are not counted from 0, or
    a thrust curve without `airframe.max_rotor_speed`.
    """

    airframe: Airframe
    terms: tuple[str, ...] = eqx.field(static=True)
    recordings: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        airframe: Airframe = OS4,
        *,
        terms: tuple[str, ...] = DEFAULT_TERMS,
        recordings: tuple[int, ...] = (0,),
    ):
        unknown = [term for term in terms if term not in TERMS]
        if unknown or len(set(terms)) < len(terms):
            raise ValueError(f"`terms` must be some of {', '.join(TERMS)}, each once, got {', '.join(terms)}.")
        if not recordings or sorted(set(recordings)) != list(range(max(recordings) + 1)):
            raise ValueError(f"`recordings` must count from 0 and leave none out, got {recordings}.")
        if "curve" in terms and not has_full_scale(airframe):
            raise ValueError("`airframe.max_rotor_speed` must be known for a thrust curve: set it or leave it out.")
        self.airframe, self.terms, self.recordings = airframe, tuple(terms), tuple(recordings)

    @property
    def _table(self) -> tuple[Parameter, ...]:
        return _parameters(self.terms, max(self.recordings) + 1)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """alpha_1..8, then those of the terms."""
        return (*PARAMETER_NAMES, *(parameter.name for parameter in self._table))

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of these."""
        return (*CorrectedOS4(self.airframe).parameter_units, *(parameter.unit for parameter in self._table))

    @property
    def alpha(self) -> Parameters:
        """What the airframe implies of alpha_1..8, and where the other parameters are looked for first."""
        airframe = self.airframe
        centers = {
            "rotor_reaction": airframe.rotor_inertia / jnp.asarray(airframe.inertia)[2],
            "rotor_lag": _LAG,
            "thrust_curve": 1.0,
            "thrust_gain": 1.0,
        }
        others = [as_float(centers.get(parameter.kind, 0.0)) for parameter in self._table]
        return jnp.concatenate([CorrectedOS4(airframe).alpha, jnp.stack(others) if others else jnp.zeros(0)])

    @property
    def half_width(self) -> Parameters:
        """Of a bracket for each parameter: our choice, as wide as small and large quadrotors need."""
        airframe = self.airframe
        arm = jnp.abs(jnp.asarray(airframe.rotor_positions)).mean()
        torque = 2 * arm * airframe.mass * airframe.gravity / 4
        roll, pitch, yaw = _AUTHORITY * torque * jnp.array([1.0, 1.0, _YAW]) / jnp.asarray(airframe.inertia)
        widths = {
            "roll_offset": roll,
            "pitch_offset": pitch,
            "yaw_offset": yaw,
            **dict.fromkeys(("roll_damping", "pitch_damping", "yaw_damping"), 5.0),
            "roll_velocity": roll / _FAST,
            "pitch_velocity": pitch / _FAST,
            "roll_flapping": roll,
            "pitch_flapping": pitch,
            "rotor_lag": _LAG_WIDTH,
            "rotor_delay": _DELAY_WIDTH,
            "rotor_reaction": 0.01 + airframe.rotor_inertia / jnp.asarray(airframe.inertia)[2],
            "thrust_curve": 1.0,
            "thrust_gain": 0.5,
            **dict.fromkeys(("ax_bias", "ay_bias", "az_bias"), _BIAS),
            **dict.fromkeys(("x_drag", "y_drag"), 1.0),
            **dict.fromkeys(("p_bias", "q_bias", "r_bias"), 0.1),
        }
        others = [as_float(widths[parameter.kind]) for parameter in self._table]
        return jnp.concatenate([CorrectedOS4(airframe).half_width, jnp.stack(others) if others else jnp.zeros(0)])

    @property
    def gyroscopic_factor(self) -> Scalar:
        """1: alpha2 = J_R / Ix."""
        return jnp.asarray(1.0)

    @property
    def is_linear(self) -> bool:
        """Where lag, delay and thrust curve are no terms."""
        return not self.forcing_parameters

    @property
    def forcing_parameters(self) -> tuple[int, ...]:
        """Lag, delay and thrust curve."""
        names = ("rotor_lag", "rotor_delay", "thrust_curve")
        return tuple(self._positions[name] for name in names if name in self._positions)

    @property
    def force_axes(self) -> tuple[int, ...]:
        """z, and where the drag is a term x and y."""
        if "accelerometer" not in self.terms:
            return ()
        return (0, 1, 2) if "drag" in self.terms else (2,)

    @property
    def observes_states(self) -> bool:
        """Unless there is an accelerometer, or a gyro's bias."""
        return not {"accelerometer", "gyro_bias"} & set(self.terms)

    @property
    def _positions(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.parameter_names)}

    def _value(self, parameters, name: str, otherwise: float = 0.0) -> Scalar:
        positions = self._positions
        return parameters[positions[name]] if name in positions else as_float(otherwise)

    def _of_recording(self, parameters, name: str, forcing: Forcing) -> Scalar:
        """A parameter of which each recording has its own, of the recording that a sample belongs to."""
        if max(self.recordings) == 0:
            return self._value(parameters, name)
        values = [self._value(parameters, f"{name}_{i + 1}") for i in range(len(forcing.recording))]
        return sum((share * value for share, value in zip(forcing.recording, values, strict=True)), as_float(0.0))

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """What rotors make of their commands: delayed, filtered, and turned into torque and thrust.

        Over a sample the filter's speed is taken as a straight line, whose mean square makes the mean torque.
        """
        omega, dt, stretches = inputs.omega, inputs.dt, inputs.stretches
        none = jnp.zeros(omega.shape[0], dtype=int)
        number, first, last = (none, none, none + omega.shape[0] - 1) if stretches is None else stretches
        if "delay" in self.terms:
            omega = _delayed(omega, self._value(parameters, "rotor_delay") / dt, first, last)
        here = following = omega
        # Speeds that are measured are those at the samples; the last row drives nothing.
        ahead = jnp.where((jnp.arange(omega.shape[0]) == last)[:, None], omega, jnp.roll(omega, -1, axis=0))
        if "lag" in self.terms:
            lag = jnp.maximum(self._value(parameters, "rotor_lag"), _SHORTEST * dt)
            here, following = _filtered(omega, jnp.exp(-dt / lag), first)
            ahead = following
        squares = (here * here + here * following + following * following) / 3
        at_sample = here * here
        if "curve" in self.terms:
            curve, full = (
                self._value(parameters, "thrust_curve"),
                jnp.asarray(self.airframe.max_rotor_speed),
            )
            squares = curve * squares + (1 - curve) * full * (here + following) / 2
            at_sample = curve * at_sample + (1 - curve) * full * here
        roll, pitch, yaw, thrust = (squares @ self.airframe.mixer.T).T
        spins, mass = jnp.asarray(self.airframe.rotor_spins), self.airframe.mass
        recording = jnp.asarray(self.recordings)[number]
        return Forcing(
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            thrust=thrust / mass,
            residual_speed=(here + following) @ spins / 2,
            spin_up=(ahead - here) @ spins / dt,
            specific_thrust=at_sample.sum(axis=1) * self.airframe.thrust_coefficient / mass,
            recording=tuple((recording == i).astype(omega.dtype) for i in range(max(self.recordings) + 1)),
            velocity=None if inputs.velocity is None else tuple(inputs.velocity.T),
            lateral=None if inputs.force is None or "flapping" not in self.terms else tuple(inputs.force.T[:2]),
        )

    def rotor_forcing(self, omega: RotorSpeeds) -> Forcing:
        """Of speeds that the rotors have: see `drive`, which is what commands need."""
        return CorrectedOS4(self.airframe).rotor_forcing(omega)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The first three equations of the class."""
        plain = Forcing(forcing.roll, forcing.pitch, forcing.yaw, forcing.thrust, forcing.residual_speed)
        rigid = CorrectedOS4(self.airframe).angular_acceleration(rates, plain, tuple(parameters[:8]))
        p, q, r = rigid
        if "offset" in self.terms:
            p, q, r = (
                value + self._of_recording(parameters, f"{axis}_offset", forcing)
                for axis, value in zip(_AXES, (p, q, r), strict=True)
            )
        if "damping" in self.terms:
            p, q, r = (
                value - self._value(parameters, f"{axis}_damping") * rate
                for axis, value, rate in zip(_AXES, (p, q, r), rates, strict=True)
            )
        if "velocity" in self.terms:
            vx, vy, _ = _known(forcing.velocity, _VELOCITY)
            p = p + self._value(parameters, "roll_velocity") * vy
            q = q + self._value(parameters, "pitch_velocity") * vx
        if "flapping" in self.terms:
            ax, ay = _known(forcing.lateral, "flapping needs `Flight.specific_force`")
            p = p + self._value(parameters, "roll_flapping") * ay
            q = q + self._value(parameters, "pitch_flapping") * ax
        if "reaction" in self.terms:
            r = r - self._value(parameters, "rotor_reaction") * _own(forcing.spin_up)
        return Rates(p, q, r)

    def specific_force(self, forcing: Forcing, thrust: Scalar, parameters) -> tuple[Scalar, Scalar, Scalar]:
        """Along the body's axes [m/s^2], of a specific thrust; without the accelerometer's biases."""
        vx, vy, _ = _known(forcing.velocity, _VELOCITY) if "drag" in self.terms else (jnp.zeros_like(thrust),) * 3
        gain = self._value(parameters, "thrust_gain", 1.0)
        return (
            -self._value(parameters, "x_drag") * vx,
            -self._value(parameters, "y_drag") * vy,
            gain * thrust,
        )

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """The time derivative of as much of the cascade as `state` holds.

        The body velocity is the one that was measured, where it was, else that of the state.
        """
        t, attitude = state.translation, state.attitude
        turn = None if attitude is None or t is None else _rotation(attitude)
        forcing = _with_velocity(forcing, state)
        rates = self.angular_acceleration(state.rates, forcing, parameters)
        angles = None if attitude is None else attitude_rates(state.rates, attitude)
        translation = None
        if turn is not None and t is not None:
            ax, ay, az = _turned(turn, self.specific_force(forcing, forcing.thrust, parameters))
            translation = Translation(t.vx, ax, t.vy, ay, t.vz, az - self.airframe.gravity)
        return State(rates, angles, translation)

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """Of the thrust alone; `cascade` has the whole."""
        return CorrectedOS4(self.airframe).acceleration(attitude, forcing)

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """The states, the rates with the gyro's bias; then the specific force with the accelerometer's."""
        p, q, r = state.rates
        if "gyro_bias" in self.terms:
            p, q, r = (
                value + self._of_recording(parameters, f"{rate}_bias", forcing)
                for rate, value in zip("pqr", (p, q, r), strict=True)
            )
        seen = tuple(jax.tree.leaves(state._replace(rates=Rates(p, q, r))))
        if not self.force_axes:
            return seen
        forcing = _with_velocity(forcing, state) if "drag" in self.terms else forcing
        force = self.specific_force(forcing, _own(forcing.specific_thrust), parameters)
        return (*seen, *(force[i] + self._value(parameters, f"a{'xyz'[i]}_bias") for i in self.force_axes))


def has_full_scale(airframe: Airframe) -> bool:
    """Whether `max_rotor_speed` is known; a traced one is taken to be."""
    return isinstance(airframe.max_rotor_speed, Tracer) or bool(np.isfinite(airframe.max_rotor_speed))


def with_body_velocity(flight: Flight) -> Flight:
    """The flight with `body_velocity`, where velocity and attitude were measured; untouched where they were not.

    What is missing between measurements is the one before.
    """
    columns = [STATE_NAMES.index(name) for name in ("phi", "theta", "psi", "vx", "vy", "vz")]
    if bool(jnp.isnan(flight.states[:, columns]).all(axis=0).any()):
        return flight
    *angles, vx, vy, vz = fill_gaps(flight.states[:, columns]).T
    velocity = _turned_back(_rotation(Attitude(*angles)), (vx, vy, vz))
    return eqx.tree_at(lambda f: f.body_velocity, flight, jnp.stack(velocity, axis=1), is_leaf=lambda x: x is None)


MODELS = {"published": PublishedOS4, "corrected": CorrectedOS4, "flight": FlightModel}


@functools.cache
def _parameters(terms: tuple[str, ...], recordings: int) -> tuple[Parameter, ...]:
    """Those of the terms, in the order of `TERMS`."""
    each = (None,) if recordings == 1 else range(recordings)
    forces = ("x", "y", "z") if "drag" in terms else ("z",)
    of_term = {
        "offset": [Parameter(f"{axis}_offset", "rad/s^2", i) for i in each for axis in _AXES],
        "damping": [Parameter(f"{axis}_damping", "1/s") for axis in _AXES],
        "velocity": [Parameter(f"{axis}_velocity", "rad/(m s)") for axis in _AXES[:2]],
        "flapping": [Parameter(f"{axis}_flapping", "rad/m") for axis in _AXES[:2]],
        "lag": [Parameter("rotor_lag", "s")],
        "delay": [Parameter("rotor_delay", "s")],
        "reaction": [Parameter("rotor_reaction", "1")],
        "curve": [Parameter("thrust_curve", "1")],
        "accelerometer": [Parameter("thrust_gain", "1"), *(Parameter(f"a{axis}_bias", "m/s^2") for axis in forces)],
        "drag": [Parameter(f"{axis}_drag", "1/s") for axis in forces[:2]],
        "gyro_bias": [Parameter(f"{rate}_bias", "rad/s", i) for i in each for rate in "pqr"],
    }
    return tuple(parameter for term in TERMS if term in terms for parameter in of_term[term])


def _known(values: tuple[Scalar, ...] | None, what: str) -> tuple[Scalar, ...]:
    if values is None:
        raise ValueError(f"`terms`: {what}, which this flight lacks: leave the term out.")
    return values


def _own(value: Scalar | None) -> Scalar:
    if value is None:
        raise ValueError("`forcing` must be what this model's `drive` makes of a flight.")
    return value


def _delayed(
    omega: RotorSpeeds, samples: Scalar, first: Int[Array, " samples"], last: Int[Array, " samples"]
) -> RotorSpeeds:
    """Commands `samples` later, between samples by cubics that join smoothly (Catmull and Rom 1974).

    A delay of whole samples is exact, and the derivative in the delay has no jumps that a search could end at. What a
    stretch does not hold is its first command, or its last.
    """
    count = omega.shape[0]
    whole = jnp.floor(jax.lax.stop_gradient(samples))
    f = samples - whole
    weights = (
        f * (-0.5 + f - f * f / 2),
        1 + f * f * (1.5 * f - 2.5),
        f * (0.5 + 2 * f - 1.5 * f * f),
        f * f * (f - 1) / 2,
    )
    # One slice holds all four taps; what it takes from beyond a stretch is replaced.
    whole = jnp.clip(whole, -count, count).astype(int)
    around = jnp.pad(omega, ((count + 2, count + 2), (0, 0)))
    near = jax.lax.dynamic_slice_in_dim(around, count - whole, count + 3)
    begin, end = omega[first], omega[last]
    row = jnp.arange(count) - whole
    total = jnp.zeros_like(omega)
    for weight, ahead in zip(weights, (1, 0, -1, -2), strict=True):
        tap = near[2 + ahead : 2 + ahead + count]
        tap = jnp.where((row + ahead < first)[:, None], begin, tap)
        total += weight * jnp.where((row + ahead > last)[:, None], end, tap)
    return total


def _filtered(omega: RotorSpeeds, decay: Scalar, first: Int[Array, " samples"]) -> tuple[RotorSpeeds, RotorSpeeds]:
    """Speeds at each sample and at the next, of rotors that begin each stretch at their command.

    w_{k+1} = a w_k + (1 - a) u_k in blocks: what each makes from rest, all of them at once, then what those before
    leave to it. The square root of the samples are the steps, instead of as many as there are.
    """
    samples = omega.shape[0]
    length = max(int(np.sqrt(samples)), 1)
    blocks = -(-samples // length)

    def in_blocks(x: Num[Array, "samples columns"]) -> Num[Array, "length blocks columns"]:
        padded = jnp.pad(x, ((0, blocks * length - samples), (0, 0)))
        return jnp.swapaxes(padded.reshape(blocks, length, x.shape[1]), 0, 1)

    # The row that begins a stretch forgets, and takes its command: as if it were the step before it.
    starts = (first == jnp.arange(samples))[:, None]
    before = jnp.concatenate([omega[:1], omega[:-1]])
    rows = in_blocks(jnp.where(starts, 0.0, decay)), in_blocks(jnp.where(starts, omega, (1 - decay) * before))

    def within(speed, row):
        speed = row[0] * speed + row[1]
        return speed, speed

    made, all_made = jax.lax.scan(within, jnp.zeros((blocks, omega.shape[1]), omega.dtype), rows)
    # Of what a block makes, later ones get what has not been forgotten on the way to their begin.
    begins = length * np.arange(blocks)
    stretch_begins = in_blocks(first[:, None])[:, :, 0]
    apart = np.maximum(begins[:, None] - begins, 0) - length
    reaches = (apart >= 0) & (stretch_begins[0][:, None] < begins + length)
    left = jnp.where(reaches, decay ** np.maximum(apart, 0), 0.0) @ made
    kept = jnp.where(stretch_begins < begins, decay ** np.arange(1, length + 1)[:, None], 0.0)
    here = jnp.swapaxes(all_made + kept[:, :, None] * left, 0, 1).reshape(blocks * length, -1)[:samples]
    return here, decay * here + (1 - decay) * omega


def _rotation(attitude: Attitude) -> tuple[Scalar, ...]:
    """Sines and cosines of roll, pitch and yaw."""
    return (*sincos(attitude.phi), *sincos(attitude.theta), *sincos(attitude.psi))


def _with_velocity(forcing: Forcing, state: State) -> Forcing:
    """The body velocity that was measured, else that of the state where it holds one."""
    t, attitude = state.translation, state.attitude
    if forcing.velocity is not None or attitude is None or t is None:
        return forcing
    return forcing._replace(velocity=_turned_back(_rotation(attitude), (t.vx, t.vy, t.vz)))


def _turned(turn: tuple[Scalar, ...], body: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
    """A vector from the body's axes to the earth's: R_z(psi) R_y(theta) R_x(phi)."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = turn
    x, y, z = body
    y, z = y * cos_phi - z * sin_phi, y * sin_phi + z * cos_phi
    x, z = x * cos_theta + z * sin_theta, -x * sin_theta + z * cos_theta
    return x * cos_psi - y * sin_psi, x * sin_psi + y * cos_psi, z


def _turned_back(turn: tuple[Scalar, ...], earth: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
    """The inverse of `_turned`."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = turn
    x, y, z = earth
    x, y = x * cos_psi + y * sin_psi, -x * sin_psi + y * cos_psi
    x, z = x * cos_theta - z * sin_theta, x * sin_theta + z * cos_theta
    return x, y * cos_phi + z * sin_phi, -y * sin_phi + z * cos_phi
