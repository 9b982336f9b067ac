"""The settings of a flight in closed loop: vehicle, air, controller and sensors.

Flights share one program if they have the same `log_every` and `logged`, and all or none of them have `air` and
`sensors`: all other settings are data.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._custom_types import Scalar, integer, setting
from ..airframe import MOTIONS, Airframe
from ..errors import check_choice
from ..models.rotors import Motor
from ..models.terms import STEEPEST
from ..noise import FORCE_SIGMA

PerAxis = Float[Array, "3"]
Pair = Float[Array, "2"]

LOGGED = ("commands", "speeds")
_XYZ, _XY, _TILT = ("x", "y", "z"), ("x", "y"), MOTIONS[:2]


class Air(eqx.Module):
    """The forces and moments of the air on a vehicle in closed loop. With the defaults there are none.

    The wind is a vector of Ornstein-Uhlenbeck processes along the axes of the body. The airspeed v is the velocity
    minus the wind. The air adds -drag_x v_x, -drag_y v_y, -inflow v_z to the specific force, flapping_roll v_y to the
    roll acceleration, and flapping_pitch v_x to the pitch acceleration.

    - `wind`: standard deviation along x, y, z [m/s]. `wind_time`: the correlation time [s].
    - `drag`: the drag of the rotors along x and y [1/s].
    - `inflow`: the thrust that rotors lose as they climb through the air [1/s].
    - `flapping`: moment over inertia and airspeed, in roll and pitch [1/(m s)], of either sign.

    **Raises:** `ValueError` that names the setting.
    """

    wind: PerAxis = eqx.field(converter=setting("wind", _XYZ), default=0.0)
    wind_time: Scalar = eqx.field(converter=setting("wind_time"), default=0.5)
    drag: Pair = eqx.field(converter=setting("drag", _XY), default=0.0)
    inflow: Scalar = eqx.field(converter=setting("inflow"), default=0.0)
    flapping: Pair = eqx.field(converter=setting("flapping", _TILT, low=-np.inf), default=0.0)


class Sensors(eqx.Module):
    """Effects of gyro, accelerometer and recorder besides white noise. With the defaults there are none.

    - `gyro_vibration` [rad/s], `force_vibration` [m/s^2]: amplitude of the sine that each rotor in hover adds to each
      axis, once for each revolution. The amplitude is proportional to the squared speed. Sampling causes aliasing.
    - `gyro_filter`, `force_filter`: time constants of the first-order low-pass filters before logging [s]. They filter
      the noise too.
    - `gyro_delay`: delay of the filtered gyro [s], in the log and for a controller that uses the log's gyro.
    - `speed_noise`, `speed_step`: standard deviation and rounding step of the logged rotor speeds or commands [rad/s].
    - `clock_offset`: delay of the logged rotors behind the gyro [s]; negative: the rotors are logged earlier.
    - `dropouts`: the shares of samples that gyro and accelerometer lose (NaN), independently.
    - `bad_samples`: the number of values `impossible` at random places of gyro and accelerometer.
    - `velocity_noise`: standard deviation of the measured velocity [m/s]. `None`: not measured. Needs `ClosedLoop.air`.
    - `controller_gyro_noise`: `None`: the controller uses the body rates of the log. A number: it uses a second gyro,
      with white noise of this standard deviation [rad/s] behind a filter with the time constant
      `controller_gyro_filter` [s].

    **Raises:** `ValueError` that names the setting.
    """

    impossible: ClassVar[float] = 1e6

    gyro_vibration: Scalar = eqx.field(converter=setting("gyro_vibration"), default=0.0)
    force_vibration: Scalar = eqx.field(converter=setting("force_vibration"), default=0.0)
    gyro_filter: Scalar = eqx.field(converter=setting("gyro_filter"), default=0.0)
    gyro_delay: Scalar = eqx.field(converter=setting("gyro_delay"), default=0.0)
    force_filter: Scalar = eqx.field(converter=setting("force_filter"), default=0.0)
    speed_noise: Scalar = eqx.field(converter=setting("speed_noise"), default=0.0)
    speed_step: Scalar = eqx.field(converter=setting("speed_step"), default=0.0)
    clock_offset: Scalar = eqx.field(converter=setting("clock_offset", low=-np.inf), default=0.0)
    dropouts: Pair = eqx.field(converter=setting("dropouts", ("gyro", "accelerometer"), high=1.0), default=0.0)
    bad_samples: Scalar = eqx.field(converter=setting("bad_samples"), default=0.0)
    velocity_noise: Scalar = eqx.field(converter=setting("velocity_noise", optional=True), default=None)
    controller_gyro_noise: Scalar = eqx.field(converter=setting("controller_gyro_noise", optional=True), default=None)
    controller_gyro_filter: Scalar = eqx.field(converter=setting("controller_gyro_filter"), default=0.0)


class ClosedLoop(eqx.Module):
    """A vehicle with its controller, its disturbances and its sensors. `fly_closed_loop` flies it.

    A setting "for each axis" is one number for all axes, or three for roll, pitch and yaw.

    The vehicle has the equations of `FlightModel` with the terms offset, damping, reaction, motor and delay, and the
    effects of `air`:

    - `airframe`: the true constants.
    - `rotor_lag`, `rotor_delay`: lag and delay of the rotors behind their commands [s], also in fractions of a sample.
    - `thrust_curve`, `motor_braking`: see `jaxos4.models.rotors`. With 1 and 1, rotors are first-order systems. Other
      values need `max_rotor_speed`.
    - `offset`: a constant torque over the inertia, for each axis [rad/s^2].
    - `damping`: a moment against the body rate, for each axis [1/s].
    - `sag`: the share of their thrust and drag that the rotors lose during the flight, linearly in time.
    - `load_sag`: the fall of the battery's voltage with the load, which is the mean cube of the rotor speeds relative
      to hover: the motors get the command times 1 - `load_sag` (load - 1).
    - `air`: wind, drag, inflow and flapping. `None`: no forces of the air; the velocity is not simulated.

    The gusts are Ornstein-Uhlenbeck processes:

    - `gust`: standard deviation of the disturbance torque over the inertia, for each axis [rad/s^2].
    - `thrust_gust`: standard deviation of the disturbance of the vertical specific force [m/s^2].
    - `gust_time`: the correlation time of both [s].

    The sensors have white noise:

    - `gyro_noise` [rad/s], `attitude_noise` [rad], `force_noise` (accelerometer) [m/s^2]: standard deviations.
    - `sensors`: vibration, filters, clocks, losses, and a second gyro for the controller. `None`: only white noise.

    The controller demands a body rate of attitude error x `attitude_gain`. From the error of the body rate, a PI
    controller demands an angular acceleration. The torque is this acceleration x `controller_inertia`. The thrust
    carries the weight, up to a tilt of 60 degrees, whose cosine is `steepest`. A rotor that would have to be slower
    than 0 or faster than its maximum saturates, and the integrators then stop.

    - `attitude_gain` [1/s], `rate_gain` [1/s], `integral_gain` [1/s^2]: for each axis.
    - `controller_inertia`: Ix, Iy, Iz that the controller assumes [kg m^2]; by default the true ones.
    - `log_every`: the controller runs this many times in each sample of the log.
    - `logged`: `"commands"`, or `"speeds"` for measured rotor speeds.

    **Raises:** `ValueError` that names the setting.
    """

    steepest: ClassVar[float] = 0.5

    airframe: Airframe
    rotor_lag: Scalar = eqx.field(converter=setting("rotor_lag"), default=0.05)
    rotor_delay: Scalar = eqx.field(converter=setting("rotor_delay"), default=0.01)
    thrust_curve: Scalar = eqx.field(converter=setting("thrust_curve", high=STEEPEST), default=1.0)
    motor_braking: Scalar = eqx.field(converter=setting("motor_braking", high=1.0), default=1.0)
    offset: PerAxis = eqx.field(converter=setting("offset", MOTIONS, low=-np.inf), default=0.0)
    damping: PerAxis = eqx.field(converter=setting("damping", MOTIONS, low=-np.inf), default=0.0)
    sag: Scalar = eqx.field(converter=setting("sag", high=1.0), default=0.0)
    load_sag: Scalar = eqx.field(converter=setting("load_sag", high=1.0), default=0.0)
    air: Air | None = None
    gust: PerAxis = eqx.field(converter=setting("gust", MOTIONS), default=0.0)
    thrust_gust: Scalar = eqx.field(converter=setting("thrust_gust"), default=0.0)
    gust_time: Scalar = eqx.field(converter=setting("gust_time"), default=0.25)
    gyro_noise: Scalar = eqx.field(converter=setting("gyro_noise"), default=0.02)
    attitude_noise: Scalar = eqx.field(converter=setting("attitude_noise"), default=0.002)
    force_noise: Scalar = eqx.field(converter=setting("force_noise"), default=FORCE_SIGMA)
    sensors: Sensors | None = None
    attitude_gain: PerAxis = eqx.field(converter=setting("attitude_gain", MOTIONS), default=(4.0, 4.0, 2.0))
    rate_gain: PerAxis = eqx.field(converter=setting("rate_gain", MOTIONS), default=(12.0, 12.0, 6.0))
    integral_gain: PerAxis = eqx.field(converter=setting("integral_gain", MOTIONS), default=(10.0, 10.0, 5.0))
    controller_inertia: PerAxis | None = eqx.field(
        converter=lambda x: None if x is None else setting("controller_inertia", MOTIONS)(x), default=None
    )
    log_every: int = eqx.field(static=True, converter=integer("log_every", 1, static=True), default=1)
    logged: str = eqx.field(static=True, default="commands")

    def __check_init__(self):
        check_choice("logged", self.logged, LOGGED)
        loaded = [x for x in (self.thrust_curve, self.motor_braking) if not isinstance(x, Tracer) and float(x) != 1]
        if loaded and not self.airframe.has_full_scale:
            raise ValueError("`airframe.max_rotor_speed` must be known for `thrust_curve` and `motor_braking`: set it.")

    @property
    def motor(self) -> Motor:
        """The motor of each rotor. If no full speed is known, it is 1 rad/s: a first-order system needs none."""
        full = jnp.where(jnp.isfinite(self.airframe.max_rotor_speed), self.airframe.max_rotor_speed, 1.0)
        return Motor(self.rotor_lag, self.thrust_curve, self.motor_braking, full)
