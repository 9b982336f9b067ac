"""The terms of the vehicle model: one object for each effect of real vehicles that the corrected OS4 lacks.

A new term is one more `Term` in `TERMS`, or an entry point of another package in the group `jaxos4.terms`. Nothing else
needs to be changed.
"""

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._custom_types import RotorSpeeds, Scalar
from .._registry import Registry
from ..airframe import GRAVITY, MOTIONS, Airframe
from .abstract import Contradiction, Parameter
from .rotors import Batch, Commands, Grid, Motor, Speeds, commanded_speeds, delayed
from .state import Forcing, Rates, Samples, Vector

# The data that a term can need from the logs or from the airframe.
COMMANDS = "commands"
VELOCITY = "velocity"
MEASURED_VELOCITY = "measured velocity"
LATERAL_FORCE = "lateral specific force"
VERTICAL_FORCE = "vertical specific force"
FULL_SCALE = "full scale"
VOLTAGE = "battery voltage"

STEEPEST = 1.2
"""The largest `thrust_curve` of a propeller."""
_SCALES = "correct `mass`, `thrust_coefficient` or `max_rotor_speed`"
_FORCE_BIASES = ("ax_bias", "ay_bias", "az_bias")
VERTICAL_BIAS = _FORCE_BIASES[2]
"""The parameter for the constant error of the accelerometer along z."""
SAG, VOLTAGE_EXPONENT = "battery_sag", "voltage_exponent"
"""The share of the battery's voltage that the load of hover takes; the exponent of the logged voltage."""

T = TypeVar("T")
Values = Mapping[str, Float[Array, "..."]]
Places = Int[Array, "*rows"]


@dataclass(frozen=True, eq=False)
class Term:
    """One effect of the vehicle model.

    - `description`: the effect, its parameters and their units.
    - `parameters`: the table of its parameters.
    - `needs`: the data that logs or airframe must have, named by the constants at the top of this file.
    - `by_default`: whether an estimate uses the term if the user names none, as a function of the available data.
    - `force_axes`: the axes along which the term makes the specific force predictable: 0, 1, 2 for x, y, z.
    - `quantity`: what its parameters describe together; it gets a verdict, see `Identification.verdicts`. Empty: none.

    The other fields are contributions; a term has at least one. A contribution is a function of the value without the
    term, and of the term's parameters by name. It returns the value with the term. Contributions act in this order:

    - `command(omega, values, grid)`: the commands [rad/s], a function of the numbers of the samples.
    - `speed(omega, values, batch, airframe)`: the rotor speeds that follow the commands over some samples. Only one of
      the terms in use may have it.
    - `angular_acceleration(total, values, rates, forcing)`: p', q', r' [rad/s^2].
    - `specific_force(force, values, forcing)`: along the body's axes [m/s^2].
    - `gyro(rates, values)`: the measured body rates [rad/s].
    - `accelerometer(force, values)`: the measured specific force [m/s^2]. It makes specific force a measurement.

    `values` holds the values for the sample's recording. The first two contributions act before recordings are
    distinguished: `ValueError` if a parameter of such a term has a separate value for each recording.
    """

    description: str
    parameters: tuple[Parameter, ...]
    needs: frozenset[str] = frozenset()
    by_default: Callable[[frozenset[str]], bool] = lambda available: True
    force_axes: tuple[int, ...] = ()
    quantity: str = ""
    command: Callable[[Commands, Values, Grid], Commands] | None = None
    speed: Callable[[RotorSpeeds, Values, Batch, Airframe], Speeds] | None = None
    angular_acceleration: Callable[[Rates, Values, Rates, Forcing], Rates] | None = None
    specific_force: Callable[[Vector, Values, Forcing], Vector] | None = None
    gyro: Callable[[Rates, Values], Rates] | None = None
    accelerometer: Callable[[Vector, Values], Vector] | None = None

    def __post_init__(self):
        if self.in_forcing and any(parameter.each_recording for parameter in self.parameters):
            raise ValueError("`parameters` of a term that acts on the forcing must be the vehicle's own.")

    @property
    def in_forcing(self) -> bool:
        """Whether the forcing depends on the term's parameters."""
        return any((self.command, self.speed))

    @property
    def changes_rates(self) -> bool:
        """Whether predictions of the body rates need the term."""
        return self.in_forcing or self.angular_acceleration is not None or self.gyro is not None


def _authority(axis: int, per: float = 1.0) -> Callable[[Airframe], Scalar]:
    """A fifth of the hover torque of two rotors (in yaw 1/25) over the inertia [rad/s^2], divided by `per`."""

    def share(airframe: Airframe) -> Scalar:
        arm = jnp.abs(jnp.asarray(airframe.rotor_positions)).mean()
        torque = 2 * arm * airframe.mass * airframe.gravity / 4
        return (0.2 * torque * jnp.array([1.0, 1.0, 0.2]) / jnp.asarray(airframe.inertia))[axis] / per

    return share


def _reaction(airframe: Airframe) -> Scalar:
    return jnp.asarray(airframe.rotor_inertia) / jnp.asarray(airframe.inertia)[2]


def _unsure_reaction(airframe: Airframe) -> Scalar:
    """Twice the airframe's value, because rotors' moments of inertia are estimates; a wide default if it has none."""
    known = _reaction(airframe)
    return jnp.where(known > 0, 2 * known, 0.01)


def _limits(*limits: tuple[float, float, str, str]) -> Contradiction:
    """The cause and the remedy of the first limit (least, most, cause, remedy) broken by more than the error."""

    def contradiction(value: float, error: float) -> tuple[str, str] | None:
        broken = ((why, so) for least, most, why, so in limits if value + error < least or value - error > most)
        return next(broken, None)

    return contradiction


_INF, _LATE = float("inf"), "s is negative: rotors cannot answer before their command"
_CLOCKS = "if the log holds measured rotor speeds, name the columns omega1..4; else check the time stamps"
_GAINS = (
    (0.0, _INF, "(the accelerometer answers thrust with the opposite sign)", "its z axis points down: change its sign"),
    (0.2, _INF, "(the accelerometer does not follow the thrust)", "check that it is switched on and in m/s^2"),
    # A gain beyond 2, or below 1/2, is no error of a scale.
    (-_INF, 2.0, "(the accelerometer shows more thrust than the airframe has)", _SCALES),
    (0.5, _INF, "(the accelerometer shows less thrust than the airframe has)", _SCALES),
)
_BENT = f"is not between 0 (thrust linear in the command) and {STEEPEST:g}: no motor with a propeller is like this"
_CLIMB = "check that the commands are shares of full speed, and fly climbs and descents, or leave out the term `motor`"
_GROWS = "is negative: no inflow makes thrust grow with the velocity along z"
_CLIMBS = _limits((0.0, _INF, _GROWS, "check the z axes of the log and `mass`, and fly climbs and descents"))
DAMPED = "1/s is more than rotors give (1)"
"""The cause of a damping that contradicts physics."""
_SPARSE = DAMPED, "log motors at 100 Hz or more, on board; else the model lacks an effect"
# The search of yaw_damping ends at 2.5 1/s.
_DAMPED = [_limits((-_INF, most, *_SPARSE)) for most in (2.5, 2.5, 2.0)]
_OFF = "m/s^2: a levelled accelerometer is off by less than 0.6, so the thrust does not match the weight"
_LEVEL = _limits((-0.6, 0.6, _OFF, "correct `mass` or `gravity`, or calibrate the accelerometer"))


def _torque(name: str, per_unit: Callable[[Rates, Forcing], tuple]) -> Callable[[Rates, Values, Rates, Forcing], Rates]:
    """Adds the parameter of this name times a number to each axis. `per_unit` may omit the last axes."""

    def add(total: Rates, values: Values, rates: Rates, forcing: Forcing) -> Rates:
        axes = zip(MOTIONS, total, (*per_unit(rates, forcing), None), strict=False)
        return Rates(*(old if x is None else old + values[f"{axis}_{name}"] * x for axis, old, x in axes))

    return add


def _add_reaction(total: Rates, values: Values, rates: Rates, forcing: Forcing) -> Rates:
    spin_up = required(forcing.spin_up, "`forcing` must come from `FlightModel.forcing`.")
    return total._replace(r=total.r - values["rotor_reaction"] * spin_up)


def _scaled(share: Callable[[Values, Grid, Places], Samples]) -> Callable[[Commands, Values, Grid], Commands]:
    """The commands times a share, which is given for some samples of the flight."""
    return lambda omega, values, grid: lambda rows: omega(rows) * share(values, grid, rows)[..., None]


def _drive(omega: RotorSpeeds, values: Values, batch: Batch, airframe: Airframe) -> Speeds:
    full = jnp.asarray(airframe.max_rotor_speed)
    lag, curve, braking, sag = (values[p] for p in ("rotor_lag", "thrust_curve", "motor_braking", SAG))
    return commanded_speeds(omega, Motor(lag, curve, braking, full, sag, jnp.asarray(airframe.hover_speed)), batch)


def _velocity(forcing: Forcing):
    return _known(forcing.velocity, VELOCITY, "body_velocity")


def _add_drag(force: Vector, values: Values, forcing: Forcing) -> Vector:
    """Subtracts drag times velocity along each axis that has a drag parameter."""
    drags = (values.get(f"{axis}_drag") for axis in "xyz")
    each = zip(force, drags, _velocity(forcing), strict=True)
    x, y, z = (a if drag is None else a - drag * v for a, drag, v in each)
    return x, y, z


def _add_force_bias(force: Vector, values: Values) -> Vector:
    x, y, z = (a + values[name] if name in values else a for a, name in zip(force, _FORCE_BIASES, strict=True))
    return x, y, z


# Rotors of 2 to 15 inches have lags of 0.01 to 0.08 s. A lag of less than -0.002 s is neither chance nor rounding.
_LAG = Parameter("rotor_lag", "s", 0.035, center=0.045, contradiction=_limits((-0.002, _INF, _LATE, _CLOCKS)))

_OWN: dict[str, Term] = {
    "offset": Term(
        "a constant torque about each axis, for each recording: roll_offset, pitch_offset, yaw_offset [rad/s^2]",
        tuple(Parameter(f"{x}_offset", "rad/s^2", _authority(i), each_recording=True) for i, x in enumerate(MOTIONS)),
        angular_acceleration=_torque("offset", lambda rates, forcing: (1.0, 1.0, 1.0)),
    ),
    "center_of_mass": Term(
        "a torque proportional to thrust above hover, from an offset centre of mass: roll_thrust, pitch_thrust [rad/m]",
        # The bracket is an offset of 10 % of the arm.
        tuple(Parameter(f"{x}_thrust", "rad/m", _authority(i, GRAVITY)) for i, x in enumerate(MOTIONS[:2])),
        angular_acceleration=_torque("thrust", lambda rates, forcing: (forcing.mean_specific_thrust - GRAVITY,) * 2),
        quantity="center of mass",
    ),
    "damping": Term(
        "a moment against each body rate: roll_damping, pitch_damping, yaw_damping [1/s]",
        # Thrust damps roll and pitch. Yaw is damped by the drag of rotors, about 0.3 1/s, times m r^2 / Iz, about 2.
        tuple(
            Parameter(f"{x}_damping", "1/s", half_width, center=center, nonnegative=True, contradiction=most)
            for x, center, half_width, most in zip(MOTIONS, (0.0, 0.0, 0.5), (5.0, 5.0, 0.5), _DAMPED, strict=True)
        ),
        angular_acceleration=_torque("damping", lambda rates, forcing: (-rates.p, -rates.q, -rates.r)),
        quantity="damping",
    ),
    "velocity": Term(
        "a moment proportional to the body velocity: roll_velocity, pitch_velocity [rad/(m s)]",
        # The bracket reaches the authority at 2 m/s.
        tuple(Parameter(f"{x}_velocity", "rad/(m s)", _authority(i, 2.0)) for i, x in enumerate(MOTIONS[:2])),
        needs=frozenset({VELOCITY}),
        # Along y the vehicle rolls, along x it pitches.
        angular_acceleration=_torque("velocity", lambda rates, forcing: _velocity(forcing)[1::-1]),
    ),
    "voltage": Term(
        "rotor speeds follow the battery's voltage to the power of voltage_exponent: 1 without compensation, 0 with it",
        (Parameter(VOLTAGE_EXPONENT, "1", 0.5, center=0.5),),
        needs=frozenset({VOLTAGE, COMMANDS}),
        command=_scaled(
            lambda values, grid, rows: _known(grid.voltage, VOLTAGE, "voltage")[rows] ** values[VOLTAGE_EXPONENT]
        ),
    ),
    "fade": Term(
        "commands lose effect as the battery empties: battery_fade [1/s], the share of rotor speed lost in a second",
        (Parameter("battery_fade", "1/s", 3e-3),),
        needs=frozenset({COMMANDS, VERTICAL_FORCE}),
        # A logged voltage already shows the fade.
        by_default=lambda available: VOLTAGE not in available,
        command=_scaled(lambda values, grid, rows: 1 - values["battery_fade"] * grid.elapsed[rows]),
    ),
    "motor": Term(
        "motors follow their commands under the load of the propellers: rotor_lag [s], thrust_curve, motor_braking, "
        "battery_sag: the share of the voltage that the load of hover takes",
        (
            _LAG,
            Parameter("thrust_curve", "1", 0.1, center=0.85, contradiction=_limits((0.0, STEEPEST, _BENT, _CLIMB))),
            Parameter("motor_braking", "1", 0.6, center=0.5, nonnegative=True, nominal=1.0),
            # Lithium cells have 8 to 30 mOhm Ah, and vehicles hover at 7 to 10 C: 2 to 6 % of 3.8 V.
            Parameter(SAG, "1", 0.04, center=0.04, nonnegative=True),
        ),
        # Only a measured specific force separates the load of the propellers from their thrust.
        needs=frozenset({COMMANDS, FULL_SCALE, VERTICAL_FORCE}),
        speed=_drive,
        quantity="motors",
    ),
    "lag": Term(
        "rotors follow their commands as first-order systems: rotor_lag [s]; for logs without the data for `motor`",
        (_LAG,),
        by_default=lambda available: COMMANDS in available and not {FULL_SCALE, VERTICAL_FORCE} <= available,
        speed=lambda omega, values, batch, airframe: commanded_speeds(omega, Motor(values["rotor_lag"]), batch),
        quantity="motors",
    ),
    "delay": Term(
        "motors act later than they are recorded, or earlier if negative: rotor_delay [s]",
        # The delay of the motors plus an offset between the clocks of motors and gyro, which may have either sign.
        (Parameter("rotor_delay", "s", 0.02, center=0.005),),
        command=lambda omega, values, grid: delayed(omega, values["rotor_delay"], grid),
        quantity="motors",
    ),
    "reaction": Term(
        "the yaw moment of rotors that accelerate: rotor_reaction = J_R / Iz",
        (Parameter("rotor_reaction", "1", _unsure_reaction, center=_reaction, nonnegative=True),),
        angular_acceleration=_add_reaction,
    ),
    "accelerometer": Term(
        "specific force is measured: thrust_gain, and ax_bias, ay_bias, az_bias [m/s^2] along the predicted axes",
        (
            Parameter("thrust_gain", "1", 0.5, center=1.0, scales_torque=True, contradiction=_limits(*_GAINS)),
            # A sensor that was levelled before take-off has a smaller bias.
            *(
                Parameter(name, "m/s^2", 0.3, force_axis=axis, contradiction=_LEVEL if axis == 2 else None)
                for axis, name in enumerate(_FORCE_BIASES)
            ),
        ),
        needs=frozenset({VERTICAL_FORCE}),
        force_axes=(2,),
        specific_force=lambda force, values, forcing: (force[0], force[1], values["thrust_gain"] * force[2]),
        accelerometer=_add_force_bias,
        quantity="thrust",
    ),
    "inflow": Term(
        "thrust falls with the velocity along z, which changes the inflow of the rotors: z_drag [1/s]",
        # g over twice the induced velocity, which is 4 to 10 m/s in hover.
        (Parameter("z_drag", "1/s", 0.5, center=0.7, nonnegative=True, contradiction=_CLIMBS),),
        needs=frozenset({VELOCITY, VERTICAL_FORCE}),
        specific_force=_add_drag,
        quantity="drag",
    ),
    "drag": Term(
        "a force against the body velocity: x_drag, y_drag [1/s]",
        (Parameter("x_drag", "1/s", 1.0), Parameter("y_drag", "1/s", 1.0)),
        needs=frozenset({VELOCITY, MEASURED_VELOCITY, LATERAL_FORCE, VERTICAL_FORCE}),
        force_axes=(0, 1),
        specific_force=_add_drag,
        quantity="drag",
    ),
    "gyro_bias": Term(
        "rates are measured with an offset, for each recording: p_bias, q_bias, r_bias [rad/s]",
        tuple(Parameter(f"{rate}_bias", "rad/s", 0.1, each_recording=True) for rate in "pqr"),
        by_default=lambda available: False,
        gyro=lambda rates, values: Rates(*(a + values[f"{rate}_bias"] for a, rate in zip(rates, "pqr", strict=True))),
    ),
}


TERMS: Registry[Term] = Registry("jaxos4.terms", _OWN)
"""The terms by name. A term of another package (an entry point in the group `jaxos4.terms`) is used only by name."""


def default_terms(available: frozenset[str]) -> tuple[str, ...]:
    """The terms that an estimate uses if the user names none, given what the logs and the airframe provide."""
    return tuple(name for name, term in TERMS.data.items() if term.needs <= available and term.by_default(available))


def follows_commands(terms: Iterable[str]) -> bool:
    """Whether a model with these terms computes rotor speeds from commands."""
    return any(COMMANDS in TERMS[term].needs for term in terms)


def clash(terms: Container[str]) -> str:
    """Why these terms cannot be used together; empty if they can."""
    first, *others = [name for name in TERMS if name in terms and TERMS[name].speed] or [""]
    return f"{first} already models how rotors follow commands; leave out {', '.join(others)}" if others else ""


def required(value: T | None, message: str) -> T:
    """`value`, or `ValueError` with `message` if there is none."""
    if value is None:
        raise ValueError(message)
    return value


def _known(value: T | None, need: str, field: str) -> T:
    names = ", ".join(name for name, term in TERMS.items() if need in term.needs)
    return required(value, f"`terms`: {names} need `Flight.{field}`, which is not given; leave them out.")
