"""The physical constants of a quadrotor: presets, TOML files, and the conversion between inertia and alpha."""

import math
from dataclasses import MISSING, fields
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ._custom_types import Numeric, Scalar, as_constant
from ._files import read_toml
from .errors import InputError, named, shortened
from .rotations import rotation

GRAVITY, STANDARD_GRAVITY = 9.81, 9.80665
"""The gravity of an airframe that gives none, and the unit g [m/s^2]."""


class Axis(NamedTuple):
    """One axis of the body, with its names in motion, inertia and alpha.

    - `motion`: the rotation about it. `rate`, `inertia`: the names of the body rate and of the moment of inertia.
    - `coupling`, `inverse`: the alphas of its rate equation that are the gyroscopic coupling and 1 / `inertia`.
    - `place`: the index of `inverse` among alpha_1..8, counted from 0.
    """

    motion: str
    rate: str
    inertia: str
    coupling: str
    inverse: str
    place: int


AXES = ROLL, PITCH, YAW = (
    Axis("roll", "p", "Ix", "alpha1", "alpha3", 2),
    Axis("pitch", "q", "Iy", "alpha4", "alpha6", 5),
    Axis("yaw", "r", "Iz", "alpha7", "alpha8", 7),
)
MOTIONS, INERTIAS = tuple(axis.motion for axis in AXES), tuple(axis.inertia for axis in AXES)
INVERSES = [axis.place for axis in AXES]
"""The places of the alphas that are reciprocals of moments of inertia."""

ALTERNATING_SPINS = (1.0, -1.0, 1.0, -1.0)

GUESS = "guess"
"""In an airframe's file, instead of `inertia`, `drag_coefficient` or `rotor_inertia`: guessed from mass and rotors."""


class Airframe(eqx.Module):
    """A rigid quadrotor with any layout of four rotors, in a frame with x forward, y left and z up.

    - `mass`: [kg].
    - `inertia`: principal moments Ix, Iy, Iz [kg m^2].
    - `rotor_positions`: x and y of each rotor [m]. `plus_layout` makes those of the paper.
    - `rotor_spins`: +1 for counter-clockwise seen from above, -1 for clockwise.
    - `thrust_coefficient`: b, thrust = b omega^2 [N s^2/rad^2].
    - `drag_coefficient`: d, yaw torque = -spin d omega^2 [N m s^2/rad^2].
    - `rotor_inertia`: J_R [kg m^2].
    - `gravity`: g [m/s^2].
    - `max_rotor_speed`: full-scale rotor speed [rad/s]; infinite if unknown.
    - `sensor_rotation`: roll, pitch and yaw of the gyro and the accelerometer in the body [deg]; see `sensor_axes`.
    - `guessed`: the names of the constants that are guesses; see `load_airframe`.
    """

    mass: Float[Numeric, ""] = eqx.field(converter=as_constant)
    inertia: Float[Numeric, "3"] = eqx.field(converter=as_constant)
    rotor_positions: Float[Numeric, "4 2"] = eqx.field(converter=as_constant)
    rotor_spins: Float[Numeric, "4"] = eqx.field(converter=as_constant)
    thrust_coefficient: Float[Numeric, ""] = eqx.field(converter=as_constant)
    drag_coefficient: Float[Numeric, ""] = eqx.field(converter=as_constant)
    rotor_inertia: Float[Numeric, ""] = eqx.field(converter=as_constant)
    gravity: Float[Numeric, ""] = eqx.field(converter=as_constant, default=GRAVITY)
    max_rotor_speed: Float[Numeric, ""] = eqx.field(converter=as_constant, default=math.inf)
    sensor_rotation: Float[Numeric, "3"] = eqx.field(converter=as_constant, default=(0.0, 0.0, 0.0))
    guessed: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())

    @property
    def guesses_drag(self) -> bool:
        """Whether `drag_coefficient` is a guess. Then an estimate of Iz is proportional to this guess."""
        return "drag_coefficient" in self.guessed

    @property
    def sensor_axes(self) -> Float[Numeric, "3 3"]:
        """The axes of gyro and accelerometer in the body, as columns: R_z(yaw) R_y(pitch) R_x(roll)."""
        return rotation(self.sensor_rotation * (math.pi / 180))

    @property
    def mixer(self) -> Float[Numeric, "4 4"]:
        """The matrix that maps squared rotor speeds to roll, pitch and yaw torque [N m] and thrust [N].

        Reference: Eqs. (10)-(13), generalised to any layout:
        d_roll = sum y_i b w_i^2, d_pitch = -sum x_i b w_i^2, d_yaw = -d sum s_i w_i^2, U_c = sum b w_i^2.
        """
        (x, y), b, d = self.rotor_positions.T, self.thrust_coefficient, self.drag_coefficient
        rows = [b * y, -b * x, -d * self.rotor_spins, b * np.ones(4)]
        # Constants that are known need no compiled program.
        return np.stack(rows) if all(isinstance(row, np.ndarray) for row in rows) else jnp.stack(rows)

    @property
    def hover_speed(self) -> Float[Numeric, ""]:
        """The rotor speed [rad/s] at which four equal rotors carry the weight."""
        square = self.mass * self.gravity / (4 * self.thrust_coefficient)
        return jnp.sqrt(square) if isinstance(square, jax.Array) else np.asarray(np.sqrt(square))

    @property
    def has_full_scale(self) -> bool:
        """Whether `max_rotor_speed` is known. A traced value counts as known."""
        return isinstance(self.max_rotor_speed, Tracer) or bool(np.isfinite(self.max_rotor_speed))

    @property
    def hover_squares(self) -> Float[np.ndarray, "4"]:
        """The squared rotor speeds [rad^2/s^2] that carry the weight without torque; negative if none do."""
        return np.linalg.solve(np.asarray(self.mixer), [0.0, 0.0, 0.0, float(self.mass) * float(self.gravity)])


def plus_layout(arm: float) -> list[tuple[float, float]]:
    """Rotor positions of the paper's cross: 1 front, 2 right, 3 rear, 4 left, each `arm` [m] from the centre."""
    return [(arm, 0.0), (0.0, -arm), (-arm, 0.0), (0.0, arm)]


def _preset(
    arm: float, mass: float, inertia: tuple[float, ...], b: float, d: float, rotor: float, gravity: float = GRAVITY
) -> Airframe:
    return Airframe(mass, inertia, plus_layout(arm), ALTERNATING_SPINS, b, d, rotor, gravity)


# Table 1 of the paper is not available to us. These values are from public literature and code: the OS4 thesis, the
# simulator that its authors published, and the quadrotor of H. Voos.
OS4 = _preset(0.23, 0.650, (7.5e-3, 7.5e-3, 1.3e-2), 3.13e-5, 7.5e-7, 6e-5)
OS4_SIMULATOR = _preset(0.232, 0.53, (6.228e-3, 6.228e-3, 1.121e-2), 3.13e-5, 7.5e-7, 6.01e-5, gravity=9.806)
VOOS = _preset(0.2, 0.5, (4.85e-3, 4.85e-3, 8.81e-3), 2.92e-6, 1.12e-7, 3.36e-5)
PRESETS = {"os4": OS4, "os4-simulator": OS4_SIMULATOR, "voos": VOOS}


def alpha_from_inertia(inertia: Float[ArrayLike, "3"], gyroscopic: Float[ArrayLike, ""]) -> Float[Array, "8"]:
    """alpha_1..8 of a rigid body with the moments Ix, Iy, Iz [kg m^2], by the definitions below Eq. (13).

    `gyroscopic`: the numerator of alpha2 and alpha5: J_R d in the published model, J_R in the corrected model.
    """
    ix, iy, iz = jnp.asarray(inertia)
    return jnp.stack(alpha_scalars(ix, iy, iz, jnp.asarray(gyroscopic)))


def alpha_scalars(ix: Scalar, iy: Scalar, iz: Scalar, gyroscopic: Scalar) -> tuple[Scalar, ...]:
    """`alpha_from_inertia` with scalars in and out, for use inside a scan."""
    return ((iy - iz) / ix, gyroscopic / ix, 1 / ix, (iz - ix) / iy, gyroscopic / iy, 1 / iy, (ix - iy) / iz, 1 / iz)


def load_airframe(source: str | PathLike[str]) -> Airframe:
    """Load an airframe by the name of a preset, or from a TOML file.

    Presets: `os4`, `os4-simulator`, `voos`; `crazyflie`, `crazyflie-brushless` and `x500` are vehicles to start from,
    whose files (`jaxos4/airframes`) say where each number is from.

    The keys of a file, in SI units: `mass`, `inertia = [Ix, Iy, Iz]`, `thrust_coefficient`, or `hover_speed`, at which
    the rotors carry the weight [rad/s], `drag_coefficient`, `rotor_inertia`; `arm` (plus layout) or `rotor_positions =
    [[x1, y1], ...]`; optionally `rotor_spins`, `gravity`, `max_rotor_speed`, `sensor_rotation`.

    `inertia`, `drag_coefficient` and `rotor_inertia` can be `"guess"`, good enough to begin a search: with the mass m
    and the root mean square distance r of the rotors from the centre, m r^2 [0.3, 0.3, 0.5], 0.1 r times the thrust
    coefficient, and 0.001 m r^2. `guessed`, a list of names, marks numbers that are guesses of this kind.

    **Raises:** `InputError` with one line that names the wrong key; `OSError` if the file cannot be read.
    """
    if source in PRESETS:
        return PRESETS[str(source)]
    files = {path.stem: path for path in sorted(Path(__file__).with_name("airframes").glob("*.toml"))}
    try:
        table = read_toml(files.get(str(source), source))
    except FileNotFoundError:
        presets = ", ".join((*PRESETS, *files))
        raise InputError(f"{source}: neither a file nor a preset; give a TOML file or one of {presets}.") from None
    with named(source):
        return airframe_from_table(table)


_VECTORS = {"inertia": (3,), "rotor_positions": (4, 2), "rotor_spins": (4,), "sensor_rotation": (3,)}
_GUESSED = "guessed"
_CONSTANTS = [field for field in fields(Airframe) if field.name != _GUESSED]
_SHAPES: dict[str, tuple[int, ...]] = {field.name: _VECTORS.get(field.name, ()) for field in _CONSTANTS}
_REQUIRED = tuple(field.name for field in _CONSTANTS if field.default is MISSING)
_REPLACES = {"arm": "rotor_positions", "hover_speed": "thrust_coefficient"}
_GUESSABLE = ("inertia", "drag_coefficient", "rotor_inertia")
# The least and the largest value, if they are not those of the other constants.
_SIZES = {"rotor_positions": (-1e3, 1e3), "rotor_spins": (-1e3, 1e3), "rotor_inertia": (0.0, 1e3)}
_SIZES |= {"max_rotor_speed": (1e-15, math.inf), "hover_speed": (1e-3, 1e6), "sensor_rotation": (-360.0, 360.0)}


def airframe_from_table(table: dict[str, Any]) -> Airframe:
    """The airframe of a table with the keys of `load_airframe`. Raises `InputError` that names the wrong key."""
    table = {"rotor_spins": ALTERNATING_SPINS} | table
    for short, whole in _REPLACES.items():
        if {short, whole} <= table.keys():
            raise InputError(f"`{short}` and `{whole}` exclude each other; keep one of them.")
    given = table.keys() | {_REPLACES.get(name) for name in table}
    if missing := [name for name in _REQUIRED if name not in given]:
        listed = ", ".join(f"`{name}`" for name in missing)
        are, them = ("is", "it") if len(missing) == 1 else ("are", "them")
        instead = " (`hover_speed` can replace `thrust_coefficient`)" if "thrust_coefficient" in missing else ""
        raise InputError(f"{listed} {are} missing; write {them} into the airframe, in SI units{instead}.")
    keys = (*_REPLACES, *_SHAPES, _GUESSED)
    if unknown := [name for name in table if name not in keys]:
        raise InputError(f"`{unknown[0]}` is not a known key; the keys are {', '.join(keys)}.")
    noted = table.pop(_GUESSED, [])
    if not isinstance(noted, list) or not all(isinstance(name, str) and name in _GUESSABLE for name in noted):
        raise InputError(f"`{_GUESSED}` must be a list of some of {', '.join(_GUESSABLE)}.")
    guessed = [name for name in _GUESSABLE if isinstance(table[name], str) and table[name] == GUESS]
    constants = {name: _numbers(name, value) for name, value in table.items() if name not in guessed}
    if "arm" in constants:
        constants["rotor_positions"] = np.asarray(plus_layout(constants.pop("arm").item()))
    if "hover_speed" in constants:
        weight = constants["mass"] * constants.get("gravity", GRAVITY)
        constants["thrust_coefficient"] = np.asarray(weight / (4 * constants.pop("hover_speed").item() ** 2))
    square = (constants["rotor_positions"] ** 2).sum(axis=1).mean()
    guesses = {  # the constants of published quadrotors are within 40 %
        "inertia": constants["mass"] * square * np.array([0.3, 0.3, 0.5]),
        "drag_coefficient": constants["thrust_coefficient"] * np.sqrt(square) * 0.1,
        "rotor_inertia": constants["mass"] * square * 1e-3,
    }
    all_guessed = tuple(name for name in _GUESSABLE if name in (*guessed, *noted))
    airframe = Airframe(**constants | {name: guesses[name] for name in guessed}, guessed=all_guessed)
    inertia, mixer = np.asarray(airframe.inertia), np.asarray(airframe.mixer)
    if 2 * inertia.max() > inertia.sum():
        raise InputError(
            f"`inertia` {inertia.tolist()} breaks the triangle inequality: no moment may exceed the sum of the others."
        )
    scale = np.abs(mixer).max(axis=1, keepdims=True)
    if np.linalg.matrix_rank(mixer / np.where(scale > 0, scale, 1)) < 4:
        raise InputError(
            "`rotor_positions` and `rotor_spins` cannot produce roll, pitch, yaw and thrust independently; correct one."
        )
    return airframe


def airframe_table(airframe: Airframe) -> dict[str, Any]:
    """The constants of an airframe as numbers and lists: the inverse of `airframe_from_table`."""
    table = {name: np.asarray(getattr(airframe, name)) for name in _SHAPES}
    constants = {name: value.tolist() for name, value in table.items() if np.isfinite(value).all()}
    return constants | ({_GUESSED: list(airframe.guessed)} if airframe.guessed else {})


def _numbers(name: str, value: Any) -> np.ndarray:
    """A constant of a table as an array. Raises `InputError` if no quadrotor has it."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):  # rows of several lengths, or an integer of more than 64 bits
        array = np.asarray(None)
    shape, (least, most) = _SHAPES.get(name, ()), _SIZES.get(name, (1e-15, 1e6))
    if array.dtype.kind not in "iuf" or array.shape != shape or np.isnan(array).any():
        wanted = f"finite numbers of shape {list(shape)}" if shape else "one finite number"
    elif not ((array >= least) & (array <= most)).all():
        sign = "" if least < 0 else "not negative and " if least == 0 else "positive and "
        wanted = f"{sign}of a quadrotor's size in SI units"
    elif name == "rotor_spins" and (np.abs(array) != 1).any():
        wanted = "1 (counter-clockwise) or -1"
    else:
        return array.astype(float)
    raise InputError(f"`{name}` must be {wanted}, got {shortened(repr(value), 80)}.")
