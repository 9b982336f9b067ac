"""The vehicle that simulators get: a rigid body with four rotors and the identified parameters."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..airframe import AXES, GRAVITY, INERTIAS, MOTIONS, PITCH, ROLL, Airframe
from ..analysis.inertia import center_of_mass

# Parameters that are 0 in a vehicle if they come out negative, and all that `rigid_vehicle` reads.
NOT_NEGATIVE = ("rotor_lag", "rotor_delay", *(f"{x}_damping" for x in MOTIONS), "x_drag", "y_drag", "z_drag")
CARRIED = (*(axis.inverse for axis in AXES), "thrust_gain", *(f"{x}_offset" for x in MOTIONS), *NOT_NEGATIVE)
CARRIED += ("roll_thrust", "pitch_thrust", "roll_velocity", "pitch_velocity", "rotor_reaction", "thrust_curve")


class RigidVehicle(NamedTuple):
    """A rigid body with four rotors, in a frame with x forward, y left, z up and the centre of mass at its origin.

    A rotor speed is the speed that makes the thrust b omega^2: see `thrust_curve`.

    - `mass` [kg], `gravity` [m/s^2], `inertia`: Ix, Iy, Iz [kg m^2].
    - `rotor_positions`: x and y of each rotor [m]. `rotor_spins`: 1 is counter-clockwise seen from above.
    - `thrust_coefficient`: b [N s^2/rad^2]. `drag_coefficient`: d, yaw torque = -spin d omega^2 [N m s^2/rad^2].
    - `rotor_inertia`: J_R [kg m^2].
    - `max_rotor_speed`: full scale [rad/s].
    - `lag`, `delay`: lag and delay of the rotors behind their commands [s].
    - `torque`: constant, about each axis [N m].
    - `damping`: torque against the body rate about each axis [N m s].
    - `drag`: force against the body velocity along each axis [N s/m]. Along z it is the inflow of the rotors.
    - `flapping`: roll torque from the body velocity along y, pitch torque from that along x [N s].
    - `thrust_curve`: c. A command u of full scale makes the speed w `max_rotor_speed` with c w + (1 - c) w^2 = u.
    """

    mass: float
    gravity: float
    inertia: Float[np.ndarray, "3"]
    rotor_positions: Float[np.ndarray, "4 2"]
    rotor_spins: Float[np.ndarray, "4"]
    thrust_coefficient: float
    drag_coefficient: float
    rotor_inertia: float
    max_rotor_speed: float
    lag: float
    delay: float
    torque: Float[np.ndarray, "3"]
    damping: Float[np.ndarray, "3"]
    drag: Float[np.ndarray, "3"]
    flapping: Float[np.ndarray, "2"]
    thrust_curve: float

    @property
    def arm(self) -> float:
        """The root mean square of the distances from the centre of mass to the rotors [m]."""
        return float(np.sqrt(np.square(self.rotor_positions).sum(axis=1).mean()))

    @property
    def hover_speed(self) -> float:
        """The rotor speed [rad/s] at which four equal rotors carry the weight."""
        return float(np.sqrt(self.mass * self.gravity / (4 * self.thrust_coefficient)))

    @property
    def torque_ratio(self) -> float:
        """The yaw torque of a rotor over its thrust [m]."""
        return self.drag_coefficient / self.thrust_coefficient

    @property
    def hover_thrust(self) -> Float[np.ndarray, "4"]:
        """The thrust of each rotor [N] that carries the weight and balances the constant torque."""
        x, y = self.rotor_positions.T
        yaw = -self.rotor_spins * self.drag_coefficient / self.thrust_coefficient
        return np.linalg.solve(np.stack([y, -x, yaw, np.ones(4)]), np.append(-self.torque, self.mass * self.gravity))

    @property
    def full_thrust(self) -> float:
        """The thrust of one rotor at full scale [N]."""
        return self.thrust_coefficient * self.max_rotor_speed**2

    @property
    def thrust_share(self) -> str:
        """Thrust over `full_thrust` as a formula of the command u (1: full scale). Empty if it is u^2."""
        c = self.thrust_curve
        return "" if c == 1 else f"(2 u / ({c:.4g} + sqrt({c * c:.4g} {'+-'[c > 1]} {4 * abs(1 - c):.4g} u)))^2"

    @property
    def rotor_drag(self) -> Float[np.ndarray, "2"]:
        """The drag of one rotor in its plane and along its axis, over its speed and velocity [N s^2/(rad m)].

        It makes the mean of `drag` along x and y, and that along z, when the rotors turn at the hover speed.
        """
        return np.array([self.drag[:2].mean(), self.drag[2]]) / (4 * self.hover_speed)

    @property
    def fault(self) -> str:
        """The reason why no vehicle can be like this. Empty if there is none."""
        for name, moment in zip(INERTIAS, self.inertia, strict=True):
            if not moment > 0:
                return f"{name} = {moment:.3g} kg m^2 is not positive"
            if 2 * moment > self.inertia.sum():
                return f"{name} = {moment:.3g} kg m^2 exceeds the sum of the other two moments of inertia"
        if not all((np.abs(each) < 1e9).all() for each in self):  # in SI units
            return "one of its constants is beyond those of every vehicle"
        if not self.thrust_coefficient > 0:
            return "the thrust is not positive"
        if not self.drag_coefficient > 0:
            return "the drag of the rotors is not positive"
        angles = np.sort(np.arctan2(*self.rotor_positions.T))
        if not np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.pi:
            return "the centre of mass lies outside the arms"
        if not 0 <= 4 * self.rotor_inertia < self.inertia[2]:
            return "the rotors have no inertia that a part of the vehicle can have"
        if not 0 < self.thrust_curve < 2:
            return f"thrust_curve = {self.thrust_curve:.3g} is no motor's; it must be between 0 and 2"
        for number, thrust in enumerate(self.hover_thrust, start=1):
            if not 0 <= thrust <= self.full_thrust:
                return f"rotor {number} can make 0 to {self.full_thrust:.3g} N, and hover needs {thrust:.3g} N of it"
        return ""


@np.errstate(all="ignore")  # `impossible` says what is not finite
def rigid_vehicle(airframe: Airframe, values: Mapping[str, float]) -> RigidVehicle:
    """The vehicle with parameters of a `FlightModel` by name, and else the airframe's. Offsets are averaged.

    `values` can have Ix, Iy, Iz instead of their alphas, and the airframe's `drag_coefficient` and `rotor_inertia`.
    """
    mass, gain = float(airframe.mass), values.get("thrust_gain", 1.0)
    inertia = np.array(airframe.inertia, dtype=float)
    for place, axis in enumerate(AXES):
        if axis.inertia in values:
            inertia[place] = values[axis.inertia]
        elif axis.inverse in values:
            # Torques exceed the airframe's by the same factor as thrust.
            inertia[place] = gain / values[axis.inverse]
    offsets = ([x for name, x in values.items() if name.startswith(f"{axis}_offset")] for axis in MOTIONS)
    offset = np.array([np.mean(of_axis or [0.0]) for of_axis in offsets])
    slopes = {name: values.get(name, 0.0) for name in ("roll_thrust", "pitch_thrust")}
    offset[:2] -= GRAVITY * np.array(list(slopes.values()))
    # The centre of mass, x and y, in the frame of the airframe's rotor positions [m].
    named = slopes | {ROLL.inverse: gain / inertia[0], PITCH.inverse: gain / inertia[1]}
    found = center_of_mass(tuple(named), np.array(list(named.values())), np.zeros((4, 4)), airframe)
    center = np.array([coordinate.value for coordinate in found])
    reaction = values.get("rotor_reaction")
    rotor_inertia = values.get("rotor_inertia", float(airframe.rotor_inertia))
    rotor_inertia = rotor_inertia if reaction is None else reaction * inertia[2]
    speed = float(airframe.max_rotor_speed)
    drag = np.array([values.get(f"{axis}_drag", 0.0) for axis in "xyz"])
    moment = [values.get(f"{axis}_velocity", 0.0) for axis in MOTIONS[:2]]
    vehicle = RigidVehicle(
        mass=mass,
        gravity=float(airframe.gravity),
        inertia=inertia,
        rotor_positions=np.asarray(airframe.rotor_positions, dtype=float) - center,
        rotor_spins=np.asarray(airframe.rotor_spins, dtype=float),
        thrust_coefficient=gain * float(airframe.thrust_coefficient),
        drag_coefficient=gain * values.get("drag_coefficient", float(airframe.drag_coefficient)),
        rotor_inertia=rotor_inertia,
        max_rotor_speed=speed,
        lag=values.get("rotor_lag", 0.0),
        delay=values.get("rotor_delay", 0.0),
        torque=inertia * offset,
        damping=inertia * np.array([values.get(f"{axis}_damping", 0.0) for axis in MOTIONS]),
        drag=mass * drag,
        flapping=inertia[:2] * moment,
        thrust_curve=values.get("thrust_curve", 1.0),
    )
    if not np.isfinite(speed) and gain > 0:
        return vehicle._replace(max_rotor_speed=2 * vehicle.hover_speed)  # a note says so
    # The load of the propeller shortens the lag of a motor: that of small changes in hover (`jaxos4.models.rotors`).
    curve, share = vehicle.thrust_curve, vehicle.hover_speed / speed if gain > 0 else 0.0
    return vehicle._replace(lag=vehicle.lag / (curve + 2 * (1 - curve) * share)) if 0 < curve < 2 else vehicle
