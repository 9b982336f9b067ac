"""RotorPy: the dictionary of parameters of `rotorpy.vehicles.multirotor.Multirotor`, as a Python file."""

from collections.abc import Sequence

from .vehicle import DRAG_OF_ROTORS, NO_ROTOR_INERTIA, RigidVehicle, differences

# The gravity that RotorPy has [m/s^2].
_GRAVITY = 9.81
# RotorPy divides by the lag: this one is too short to notice [s].
_NO_LAG = 1e-3


def rotorpy_limits(vehicle: RigidVehicle) -> tuple[str, ...]:
    """The effects that RotorPy does not have, or has differently."""
    return differences(
        (vehicle.rotor_inertia, NO_ROTOR_INERTIA),
        (vehicle.thrust_share, vehicle.curve("rotor speed = rotor_speed_max x sqrt({})")),
        (vehicle.torque.any(), "offsets: not carried: RotorPy has no constant torque"),
        (vehicle.damping.any(), "damping: not carried: RotorPy has no torque against the body rates"),
        (vehicle.drag.any(), DRAG_OF_ROTORS),
        (vehicle.delay, f"rotor_delay: not carried: give commands {vehicle.delay:.4g} s late"),
        (not vehicle.lag, f"rotor_lag: none was identified; tau_m is {_NO_LAG:g} s, because RotorPy needs one"),
        (
            vehicle.gravity != _GRAVITY,
            f"gravity: RotorPy has {_GRAVITY:g} m/s^2, the airframe {vehicle.gravity:g}",
        ),
    )


def rotorpy_text(vehicle: RigidVehicle, comments: Sequence[str]) -> str:
    """The Python file. It defines `quad_params`."""
    arm = vehicle.arm
    moments = dict(zip(("Ixx", "Iyy", "Izz"), vehicle.inertia.tolist(), strict=True))
    positions = [
        f'        "r{number}": np.array([{x!r}, {y!r}, 0.0]),'
        for number, (x, y) in enumerate(vehicle.rotor_positions.tolist(), start=1)
    ]
    # The sign of each rotor's yaw torque. A rotor that turns counter-clockwise turns the body clockwise.
    directions = (-vehicle.rotor_spins).tolist()
    numbers = {
        "k_eta": vehicle.thrust_coefficient,
        "k_m": vehicle.drag_coefficient,
        "k_d": vehicle.rotor_drag,
        **dict.fromkeys(("k_z", "k_h", "k_flap", "c_Dx", "c_Dy", "c_Dz"), 0.0),
        "tau_m": vehicle.lag or _NO_LAG,
        "rotor_speed_min": 0.0,
        "rotor_speed_max": vehicle.max_rotor_speed,
        "motor_noise_std": 0.0,
        "rotor_radius": arm / 2,
    }
    masses = {"mass": vehicle.mass, **moments, **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0)}
    lines = [
        *(f"# {line}" for line in comments),
        "",
        "import numpy as np",
        "",
        "quad_params = {",
        *(f'    "{name}": {float(value)!r},' for name, value in masses.items()),
        '    "num_rotors": 4,',
        '    "rotor_pos": {',
        *positions,
        "    },",
        f'    "rotor_directions": np.array({directions!r}),',
        '    "rI": np.zeros(3),',
        *(f'    "{name}": {float(value)!r},' for name, value in numbers.items()),
        "}",
    ]
    return "\n".join(lines) + "\n"
